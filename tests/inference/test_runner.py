"""The history of a run, its attention and stages; a frame whose numbers are not finite is told."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from memory_drive import MemoryDrive, WithoutImages, make_rig
from stepping import CPU, run

from bevcli.errors import InputError, WeightsError
from bevcli.geometry.cameras import NUSCENES_YAWS_DEG
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import Runner, RunnerState
from bevcli.model.bevformer import BEVFormer
from bevcli.model.pillar_projection import project_pillars
from bevcli.model.prepare import prepare_for_inference


def test_history_matters(mini_model):
    sequence = MemoryDrive(2)
    with_history, without = run(mini_model, sequence)[0][1], run(mini_model, sequence, temporal=False)[0][1]
    assert (with_history.bev - without.bev).abs().max() > 1e-3
    assert (with_history.started_anew, str(without.started_anew)) == (None, "history is off")


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

    hook = model.get_submodule(module).register_forward_hook(spoil)
    try:
        found = predictions_of(model, frames=1)[0]
    finally:
        hook.remove()
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

    hook = mini_model.neck.output[0].register_forward_hook(spoil_second)
    try:
        predictions = predictions_of(mini_model, frames=4)
    finally:
        hook.remove()
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
