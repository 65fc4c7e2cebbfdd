"""The history of a run, its attention and stages, numbers that are not finite; reading ahead and writing behind."""

import copy
import threading
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch
from memory_drive import MemoryDrive, WithoutImages, make_rig
from stepping import CPU, run

from bevcli.config import load_config
from bevcli.errors import InputError, WeightsError
from bevcli.geometry.cameras import NUSCENES_YAWS_DEG
from bevcli.inference.pipeline import read_ahead, write_behind
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import AHEAD_BYTES, Runner, RunnerState, frames_ahead
from bevcli.model.bevformer import BEVFormer
from bevcli.model.hybrid_queries import HybridQueriesConfig
from bevcli.model.nanodet import NanoDetConfig
from bevcli.model.pillar_projection import project_pillars
from bevcli.model.prepare import prepare_for_inference
from bevcli.model.road_slopes import RoadSlopes


def test_history_matters(mini_model):
    sequence = MemoryDrive(2)
    with_history, without = run(mini_model, sequence)[0][1], run(mini_model, sequence, temporal=False)[0][1]
    assert (with_history.bev - without.bev).abs().max() > 1e-3
    assert (with_history.started_anew, str(without.started_anew)) == (None, "history is off")


def test_points_are_followed_ahead_of_the_step_that_they_are_for(mini_config):
    hybrid = HybridQueriesConfig(8, level=True)
    config = replace(mini_config, image_detector=NanoDetConfig(max_boxes=4), hybrid_queries=hybrid)
    first, second = (prepared for prepared, _ in Runner(BEVFormer(config), CPU).frames(MemoryDrive(2), range(2)))
    points = second.points
    assert (first.points, points.view, points.pose) == (None, first.grey, first.frame.world_from_ego)
    assert points.told is None  # of noise
    known = replace(points, told=(np.diag([0, 0, 1e8, 1e8]), np.array([0, 0, 1e6, -1e6])))
    memory = BEVFormer.history_after(first, torch.zeros(1), RoadSlopes.unknown())
    slopes = BEVFormer.slopes_before(replace(second, points=known), memory)
    assert slopes.mean[0].tolist() == pytest.approx([0.01, -0.01], abs=1e-5)
    for other in (replace(memory, pose=MemoryDrive(1).pose(0)), memory):  # an odometry knows better; no points
        frame = second if other is memory else replace(second, points=known)
        assert not BEVFormer.slopes_before(frame, other).mean.any()


def test_autocast_around_a_run_has_no_effect(mini_model):
    prepared = prepare_for_inference(mini_model, CPU)
    expected, _ = run(prepared, MemoryDrive(2))
    with torch.autocast("cpu", torch.bfloat16):
        found, _ = run(prepared, MemoryDrive(2))
    assert torch.equal(found[1].bev, expected[1].bev)
    assert np.array_equal(found[1].boxes.centers, expected[1].boxes.centers)


@pytest.mark.parametrize(
    "yaws", [{"CAM_FRONT": 0.0}, dict(list(NUSCENES_YAWS_DEG.items())[:5]), {**NUSCENES_YAWS_DEG, "seventh": 90.0}]
)
def test_any_number_of_cameras_runs(mini_model, yaws):
    predictions, _ = run(mini_model, MemoryDrive(2, rig=make_rig(yaws)))
    assert all(np.isfinite(p.boxes.centers).all() and len(p.boxes) == 20 for p in predictions)


def test_the_probe_answers_in_pixels_and_shares(mini_model):
    predictions, _ = run(mini_model, MemoryDrive(2), attention=True, probes=((0.0, 12.0),))
    view = predictions[1].attention
    assert predictions[0].attention.history_weight is None
    assert view.history_weight.shape == (12, 10)
    assert view.history_weight.min() >= 0
    assert view.history_weight.max() <= 1
    samples = view.probes[0].cameras["CAM_FRONT"]
    assert sum(camera.weights.sum() for camera in view.probes[0].cameras.values()) == pytest.approx(1)
    # Freshly made offsets stay near the pillar, which stands ahead of the camera: near the image's middle column.
    assert np.average(samples.pixels[:, 0], weights=samples.weights) == pytest.approx(160, abs=60)


def test_a_probe_outside_the_map_is_a_mistake(mini_model):
    with pytest.raises(InputError, match="outside the BEV map"):
        run(mini_model, MemoryDrive(1), attention=True, probes=((100.0, 0.0),))


def test_every_stage_is_timed(mini_model):
    prediction = run(mini_model, MemoryDrive(1))[0][0]
    assert list(prediction.stage_seconds) == ["backbone", "neck", "encoder", "decoder", "box_decoding"]
    assert all(seconds > 0 for seconds in prediction.stage_seconds.values())


def test_a_segmentation_head_fills_the_prediction(mini_config):
    torch.manual_seed(0)
    model = BEVFormer(replace(mini_config, heads=("detection", "segmentation")))
    predictions, _ = run(model, MemoryDrive(2))
    # Four cells of the map along each side of a BEV cell; there are 12 x 10 of those.
    assert [prediction.segmentation.cells.shape for prediction in predictions] == [(48, 40)] * 2
    assert list(predictions[0].stage_seconds)[-3:] == ["segmentation_head", "box_decoding", "map_merging"]


def test_removing_a_camera_changes_only_the_cells_that_it_saw(mini_model):
    """After the first spatial cross-attention; later layers spread the change."""
    seen = {}

    def keep(module, inputs, output):
        seen["queries"] = output

    runner = Runner(mini_model, CPU)
    handle = runner.model.encoder.layers[0].spatial_cross_attention.register_forward_hook(keep)
    preprocess = Preprocessor(mini_model.config)
    whole = preprocess(MemoryDrive(1).load(0))
    runner.step(None, whole)
    with_camera = seen["queries"]
    runner.step(None, preprocess(WithoutImages({0: ["CAM_FRONT_LEFT"]}, count=1).load(0)))
    handle.remove()
    changed = (seen["queries"] - with_camera).abs().amax(-1)[0] > 1e-6
    projection = project_pillars(whole.image_from_bev, mini_model.pillars.points, (96, 160), whole.has_image)
    hits = projection.hit[0, mini_model.config.cameras.index("CAM_FRONT_LEFT")]
    assert changed.any()
    assert not (changed & ~hits).any()
    assert (changed == hits).float().mean() > 0.99


def test_runners_leave_no_hooks_on_a_model(mini_model):
    """Several runners in turn, as in training, and one whose step fails."""
    for _ in range(3):
        run(mini_model, MemoryDrive(1), attention=True, probes=((0.0, 12.0),))
    runner = Runner(mini_model, CPU)
    prepared = Preprocessor(mini_model.config)(MemoryDrive(1).load(0))
    with pytest.raises(RuntimeError):
        runner.step(None, replace(prepared, images=prepared.images[:, :, :1]))
    assert not any(module._forward_hooks or module._forward_pre_hooks for module in mini_model.modules())


def predictions_of(model, frames=3):
    steps = Runner(model, CPU).run(MemoryDrive(frames))
    return [prediction for _, prediction, _ in steps]


@pytest.mark.parametrize(
    ("module", "where"),
    [
        ("backbone", "backbone"),
        ("neck", "neck"),
        ("encoder.layers.1.norms.0", "encoder layer 1 (encoder.layers.1.norms.0)"),
        ("decoder.layers.1", "decoder layer 1"),
    ],
)
@pytest.mark.parametrize(
    ("prepared", "value"), [(False, float("inf")), (True, float("nan"))], ids=["plain", "prepared"]
)
def test_the_module_where_numbers_stop_being_finite_is_named(mini_model, module, where, value, prepared):
    model = prepare_for_inference(mini_model, CPU) if prepared else mini_model

    def spoil(module, arguments, output):
        first = output[0] if isinstance(output, tuple | list) else output
        first[0] = value

    with model.get_submodule(module).register_forward_hook(spoil):
        found = predictions_of(model, frames=1)[0]
    assert where in found.not_finite
    assert not len(found.boxes)
    assert found.bev is None
    assert not found.skipped


def test_frames_after_a_failed_one_are_those_of_a_fresh_start(mini_model):
    sequence, calls = MemoryDrive(4), []

    def spoil_second(module, arguments, output):
        calls.append(module)
        if len(calls) in (2, 3):  # the second frame, and the search in it
            output.fill_(float("nan"))

    with mini_model.neck.output[0].register_forward_hook(spoil_second):
        predictions = predictions_of(mini_model, frames=4)
    assert [bool(p.not_finite) for p in predictions] == [False, True, False, False]
    runner = Runner(mini_model, CPU)
    fresh = [p for _, p, _ in runner.run(sequence, range(2, 4))]
    for after, expected in zip(predictions[2:], fresh, strict=True):
        assert torch.equal(after.bev, expected.bev)


@pytest.mark.parametrize("prepared_model", [False, True], ids=["plain", "prepared"])
def test_an_input_that_is_not_finite_is_named(mini_model, prepared_model):
    model = prepare_for_inference(mini_model, CPU) if prepared_model else mini_model
    runner, preprocessor, sequence = Runner(model, CPU), Preprocessor(mini_model.config), None
    sequence = MemoryDrive(1)
    prepared = preprocessor(sequence.load(0))
    images = prepared.images.clone()
    images[0, 0, 0, 0, 0] = float("nan")
    state, prediction = runner.step(None, replace(prepared, images=images))
    assert state == RunnerState()
    assert prediction.not_finite == "input images"


def test_a_batch_norm_of_negative_variance_is_refused_at_once(mini_model):
    model = copy.deepcopy(mini_model)
    model.backbone.bn1.running_var[3] = -1.0  # finite, but its root is not
    with pytest.raises(WeightsError, match=r"backbone\.conv1\.weight: has NaN or infinity"):
        prepare_for_inference(model, CPU)


def test_several_threads_keep_the_order():
    late = threading.Event()

    def work(item):
        if item == 0:
            late.wait(5)  # the first item is done after the second
        else:
            late.set()
        return item

    assert list(read_ahead(work, range(6), depth=4, threads=3)) == list(range(6))


def test_an_error_is_raised_at_its_item_and_not_before():
    results = read_ahead(lambda x: 1 / (2 - x), range(5))
    assert [next(results), next(results)] == [0.5, 1.0]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_it_works_ahead_of_the_consumer_but_only_so_far():
    started = []
    reached = threading.Event()

    def work(item):
        started.append(item)
        if item == 3:
            reached.set()
        return item

    results = read_ahead(work, range(100), depth=3)
    assert next(results) == 0
    assert reached.wait(5)
    assert max(started) == 3


def test_items_are_loaded_in_order_in_one_thread_of_their_own():
    loaded, threads = [], set()

    def load(item):
        loaded.append(item)
        threads.add(threading.get_ident())
        return item + 1

    results = list(read_ahead(lambda x: (x, threading.get_ident()), range(12), depth=5, threads=3, load=load))
    assert [x for x, _ in results] == list(range(1, 13))
    assert loaded == list(range(12))
    assert len(threads) == 1
    assert threads.isdisjoint(thread for _, thread in results)


@pytest.mark.parametrize("cameras", [1, 6, 60])
def test_frames_ahead_of_a_gpu_are_bounded_by_their_memory(cameras):
    image = load_config("base").image
    width, height = image.padded_size
    depth, threads = frames_ahead(image, cameras, cores=16)
    assert depth == 2 or depth * cameras * width * height * 3 * 4 <= AHEAD_BYTES
    assert 1 <= threads <= 16
    assert frames_ahead(image, cameras, cores=1)[1] == 1


def test_every_item_is_written_in_order():
    assert list(write_behind(range(20), lambda item: 2 * item)) == list(range(0, 40, 2))
    assert list(write_behind([], lambda item: item)) == []


def test_items_are_made_while_the_first_one_is_written():
    made, all_made = [], threading.Event()

    def items():
        for item in range(4):
            made.append(item)
            yield item
        all_made.set()

    assert all(write_behind(items(), lambda item: all_made.wait(5), depth=3))
    assert made == list(range(4))


def test_what_was_made_is_written_where_the_caller_stops():
    made, written = [], []
    steps = write_behind((made.append(item) or item for item in range(1000)), written.append, depth=4)
    list(islice(steps, 3))
    steps.close()
    assert written == made
    assert 3 <= len(made) <= 9


@pytest.mark.parametrize("kind", [OSError, KeyboardInterrupt])
def test_made_items_are_written_before_the_failure_of_the_next(kind):
    written = []

    def items():
        yield from range(3)
        raise kind("no image")

    with pytest.raises(kind, match="no image"):
        list(write_behind(items(), written.append))
    assert written == [0, 1, 2]


def test_nothing_is_written_after_an_error():
    written = []

    def write(item):
        written.append(item)
        return 1 / (1 - item)

    with pytest.raises(ZeroDivisionError):
        list(write_behind(range(1000), write))
    assert written == [0, 1]
