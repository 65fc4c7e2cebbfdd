"""A step and an overlapped run on a GPU that is simulated: every tensor is on the right device, and the CPU waits for
it a stated number of times. A simulated device stops what a real one would stop (tests/simulated_device.py)."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from memory_drive import MemoryDrive, WithoutImages
from simulated_device import OnDevice, pinned, simulated

from bevcli.config import known_models, load_config
from bevcli.errors import InputError
from bevcli.frame import Prediction
from bevcli.inference.load import Model
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import Runner, StepOptions
from bevcli.inference.tracking import TrackerConfig
from bevcli.model.config import ModelConfig
from bevcli.model.deformable_attention import GridSampling
from bevcli.model.network import Network
from bevcli.model.prepare import methods_on_device, prepare_for_inference
from bevcli.model.step import PreparedFrame
from bevcli.runs.run_into_folder import run_into_folder
from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.workshop.benchmark.versions import made_up_model
from bevcli.workshop.bevformer_v2 import BEVFormerV2Config
from bevcli.workshop.uniad.uniad import UniADConfig

CPU = torch.device("cpu")
FRAMES = 3
REPEATS = 3  # of the last frame: as ever, captured, replayed
MODELS = known_models()


def small_version(name: str) -> ModelConfig:
    """A known model with all its parts, on smaller images and with fewer cells, blocks, layers and channels."""
    config = load_config(name)
    segmentation = replace(config.segmentation, thing_queries=6, feed_forward_width=32)
    smaller = {"fusion": replace(config.fusion, width=32)} if isinstance(config, BEVFormerV2Config) else {}
    return replace(
        config,
        **smaller,
        image=replace(config.image, size=(160, 96), crop=None),
        bev_grid=replace(config.bev_grid, rows=12, columns=10),
        channels=48 if config.encoder.attention_heads == 6 else 32,
        backbone=replace(config.backbone, blocks=(1, 1, 1, 1), width=8),
        encoder=replace(config.encoder, layers=2, feed_forward_width=32),
        decoder=replace(config.decoder, layers=2, queries=20, feed_forward_width=32, max_boxes=10),
        segmentation=segmentation,
    )


def frames(config: ModelConfig, *, same_projection: bool = False) -> list[PreparedFrame]:
    """The frames of a drive, whose images are taken between the frames' times.

    same_projection: all frames have the projections of the first one.
    """
    drive, preprocess = MemoryDrive(count=FRAMES), Preprocessor(config)
    prepared = []
    for place in range(FRAMES):
        frame = drive.load(place)
        at = dict.fromkeys(frame.rig.names, drive.pose(place + 0.1))
        prepared.append(preprocess(replace(frame, world_from_ego_at=at)))
    if same_projection:
        return [replace(frame, image_from_bev=prepared[0].image_from_bev) for frame in prepared]
    return prepared


def run(model: Network, device: torch.device, prepared: list[PreparedFrame], waits: list[str]) -> list[Prediction]:
    """Each frame's prediction. The step of the last frame is made three times, so that the last one is a replay of a
    CUDA graph. The device's waits are forgotten before it."""
    runner = Runner(model, device)
    ahead = model.config.later_frames
    state, predictions = None, []
    for place, frame in enumerate(prepared):
        before = state
        for _ in range(REPEATS if place == len(prepared) - 1 else 1):
            waits.clear()
            state, prediction = runner.step(before, frame, prepared[place + 1 : place + 1 + ahead])
        predictions.append(prediction)
    return predictions


def sample_plainly(values, shapes, locations, weights, ends, out, queries, maps, cells, **constants):
    """The Triton kernel's numbers, from the plain module."""
    for tensor in (values, shapes, locations, weights, ends, out):
        assert isinstance(tensor, OnDevice)
        assert tensor.is_contiguous()
    assert values.shape[:2] == (maps, cells)
    counts = np.diff([0, *ends.held.tolist()]).tolist()
    sizes = tuple(map(tuple, shapes.held.tolist()))
    found = GridSampling()(values.held, sizes, locations.held, weights.held, counts)
    out.held.copy_(found.view(out.shape))


@pytest.mark.parametrize(
    ("name", "device_name"),
    [
        ("demo", "cuda:1"),
        *(pytest.param(name, "cuda:1", marks=pytest.mark.slow) for name in MODELS if name != "demo"),
        *(pytest.param(name, "mps", marks=pytest.mark.slow) for name in ("demo", "v2-t1")),
    ],
)
def test_a_step_computes_on_its_device_and_waits_for_results(name, device_name, monkeypatch):
    """The device part of the last step is a replay of a CUDA graph, in whose capture nothing may wait. Only the tracks
    of a UniAD are chosen on the CPU, which reads them several times a frame."""
    config = small_version(name)
    model, prepared = made_up_model(config), frames(config)
    expected = run(model, CPU, prepared, [])
    with simulated(device_name, monkeypatch, sample_plainly) as device:
        fast = prepare_for_inference(model, device.device)
        found = run(fast, device.device, prepared, device.waits)
    used = set(methods_on_device(type(fast)))
    used -= {"find_image_boxes"} if model.image_detector is None else set()
    used -= {"find_slopes"} if model.horizon is None else set()
    for name in used if device_name == "cuda:1" else ():
        part = getattr(fast, name)
        assert part.failure is None
        assert any(part.graphs.values())
    for ours, theirs in zip(expected, found, strict=True):
        np.testing.assert_allclose(theirs.boxes.centers, ours.boxes.centers, atol=1e-3)
        np.testing.assert_allclose(theirs.boxes.scores, ours.boxes.scores, atol=1e-4)
        if ours.segmentation is not None:
            assert (theirs.segmentation.cells == ours.segmentation.cells).mean() > 0.999
    if device_name == "cuda:1" and not isinstance(config, UniADConfig):
        levels = config.horizon or config.hybrid_queries.level  # the rig, before pillars are projected
        slope = ["copy to the CPU"] * levels
        assert device.waits == [*slope, "event"]


@pytest.mark.slow
def test_a_step_uploads_once_and_reads_back_once(monkeypatch):
    config = replace(small_version("demo"), horizon=False)
    model, prepared = made_up_model(config), frames(config, same_projection=True)
    copied = []
    with simulated("cuda:0", monkeypatch, sample_plainly) as device:
        fast = prepare_for_inference(model, device.device)
        prepared = [replace(frame, images=device.tensor(frame.images)) for frame in prepared]  # were uploaded ahead
        for name in ("bevcli.model.upload.pinned", "bevcli.inference.pipeline.pinned_place"):
            function = pinned if name.endswith("pinned") else lambda x: pinned(torch.empty(x.shape, dtype=x.dtype))
            monkeypatch.setattr(name, lambda x, name=name, function=function: copied.append(name) or function(x))
        runner = Runner(fast, device.device)
        state, _ = runner.step(None, prepared[0])
        for frame in (*prepared, *prepared):
            copied.clear()
            state, _ = runner.step(state, frame)
    assert copied == ["bevcli.model.upload.pinned", "bevcli.inference.pipeline.pinned_place"]


@pytest.mark.slow
def test_the_attention_of_a_step_is_observed_on_its_device(monkeypatch):
    config = small_version("demo")
    model, (frame, *_) = made_up_model(config), frames(config)
    options = StepOptions(attention=True, probes=((3.0, 4.0),))
    _, expected = Runner(model, CPU, options).step(None, frame)
    with simulated("cuda:1", monkeypatch, sample_plainly) as device:
        _, found = Runner(prepare_for_inference(model, device.device), device.device, options).step(None, frame)
    (ours,), (theirs,) = expected.attention.probes, found.attention.probes
    assert ours.cameras.keys() == theirs.cameras.keys()
    for camera, samples in ours.cameras.items():
        np.testing.assert_allclose(theirs.cameras[camera].pixels, samples.pixels, atol=0.1)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU")
@pytest.mark.parametrize("name", ["demo", "base"])
def test_a_real_gpu_is_waited_for_as_often_as_the_simulated_one(name, monkeypatch):
    """PyTorch reports every wait but those for events, of which the results have one."""
    config, device = small_version(name), torch.device("cuda:0")
    runner = Runner(prepare_for_inference(made_up_model(config), device), device)
    *first, last = frames(config)
    state, waits, events, wait = None, [], [], torch.cuda.Event.synchronize
    monkeypatch.setattr(torch.cuda.Event, "synchronize", lambda event: (events.append(event), wait(event)))
    for frame in first:
        state, _ = runner.step(state, frame)
    for _ in range(REPEATS):
        events.clear()
        torch.cuda.synchronize()
        torch.cuda.set_sync_debug_mode("warn")
        with warnings.catch_warnings(record=True) as reported:
            warnings.simplefilter("always")
            runner.step(state, last)
        torch.cuda.set_sync_debug_mode("default")
        waits = [str(warning.message) for warning in reported if "synchroniz" in str(warning.message)]
    assert runner.model.compute.failure is None
    assert not waits
    assert len(events) == 1


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU")
def test_uploading_images_ahead_changes_no_box():
    config, device = small_version("demo"), torch.device("cuda:0")
    model, drive = prepare_for_inference(made_up_model(config), device), MemoryDrive(count=FRAMES)
    preprocess = Preprocessor(config)
    in_turn = run(model, device, [preprocess(drive.load(place)) for place in range(FRAMES)], [])
    ahead = Runner(model, device).run(drive)
    for expected, (_, prediction, _) in zip(in_turn, ahead, strict=True):
        np.testing.assert_allclose(prediction.boxes.centers, expected.boxes.centers, atol=1e-4)


OVERLAPPED = 6
TRACKER = TrackerConfig(birth_score=0.0, keep_score=0.0)


class MadeDrive(WithoutImages):
    """A drive of two scenes, with a frame without images. A frame `broken` cannot be read."""

    broken = OVERLAPPED

    def __init__(self):
        super().__init__({1: "all"}, count=OVERLAPPED, scenes="aaaabb")

    def load(self, place):
        if place == self.broken:
            raise InputError(f"frame {place}: is broken")
        return super().load(place)


@pytest.fixture
def overlapping(monkeypatch):
    monkeypatch.setattr(Runner, "overlap", 1)


def steps_of(model, change=lambda prepared: prepared, broken=OVERLAPPED):
    """The steps of a run, and the message of the error that ended it. change: of each frame before its step."""
    runner, drive = Runner(model, CPU, tracker=TRACKER), MadeDrive()
    runner.prepare = lambda frame: change(runner.preprocess(frame))
    drive.broken, steps = broken, []
    try:
        for step in runner.run(drive):
            steps.append(step)
    except (InputError, RuntimeError) as error:
        return steps, str(error)
    return steps, ""


def assert_same(found, expected):
    for (frame, ours, after), (their_frame, theirs, their_after) in zip(found, expected, strict=True):
        assert frame.stamp == their_frame.stamp == ours.stamp
        assert (ours.skipped, ours.not_finite) == (theirs.skipped, theirs.not_finite)
        assert str(ours.started_anew) == str(theirs.started_anew)
        assert ours.bev is theirs.bev is None or torch.equal(ours.bev, theirs.bev)
        for column in ("centers", "scores", "instances"):
            assert np.array_equal(getattr(ours.boxes, column), getattr(theirs.boxes, column))
        assert list(ours.stage_seconds) == list(theirs.stage_seconds)
        assert after.stamp == their_after.stamp
        assert np.array_equal(after.tracks.tracks.numbers, their_after.tracks.tracks.numbers)


def spoilt(index):
    """A change of the frame of an index, whose images become NaN."""
    return lambda x: replace(x, images=x.images * float("nan")) if x.frame.stamp.index == index else x


def cut(index):
    """A change of the frame of an index, whose images get a shape that the model refuses."""
    return lambda x: replace(x, images=x.images[:, :, :1]) if x.frame.stamp.index == index else x


@pytest.mark.parametrize(
    ("asked", "count"),
    [
        ({}, OVERLAPPED),
        pytest.param({"change": spoilt(2)}, OVERLAPPED, marks=pytest.mark.slow),
        ({"change": spoilt(OVERLAPPED - 1)}, OVERLAPPED),
        ({"change": cut(3)}, 3),
        pytest.param({"broken": 3}, 3, marks=pytest.mark.slow),
        ({"broken": 0}, 0),
    ],
    ids=["whole", "not finite", "not finite at the end", "error in a step", "error in reading", "error at once"],
)
def test_an_overlapped_run_equals_one_step_after_the_other(mini_model, monkeypatch, asked, count):
    expected, error = steps_of(mini_model, **asked)
    monkeypatch.setattr(Runner, "overlap", 1)
    found, same_error = steps_of(mini_model, **asked)
    assert len(found) == count
    assert_same(found, expected)
    assert same_error == error
    assert bool(error) == (count < OVERLAPPED)


def test_an_error_of_a_finished_step_ends_the_run(mini_model, monkeypatch, overlapping):
    decode, calls = mini_model.decode, []

    def fail_second(outputs):
        calls.append(outputs)
        if len(calls) == 2:
            raise RuntimeError("cannot be decoded")
        return decode(outputs)

    monkeypatch.setattr(mini_model, "decode", fail_second)
    steps, error = steps_of(mini_model)
    assert [prediction.skipped for _, prediction, _ in steps] == [False, True]
    assert error == "cannot be decoded"
    assert len(calls) == 2


def interrupt_and_resume(model, out):
    """A run that ends at a frame that cannot be read, then at the next one, then with the drive."""
    drive = MadeDrive()
    for drive.broken in (4, 5):
        with pytest.raises(InputError, match=f"frame {drive.broken}"):
            run_into_folder(model, drive, out, resume=drive.broken == 5)
        assert len(read_boxes(out / "predictions.json").frames) == drive.broken
    drive.broken = OVERLAPPED
    run_into_folder(model, drive, out, resume=True)


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked_recordings")
def test_an_interrupted_overlapped_run_has_all_frames(mini_model, tmp_path, overlapping):
    model = Model(mini_model, tracker=TRACKER)
    run_into_folder(model, MadeDrive(), tmp_path / "whole")
    interrupt_and_resume(model, tmp_path / "out")
    for name in ("predictions.json", "tracks.csv"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked_recordings")
def test_an_interrupted_run_on_a_gpu_has_all_frames(mini_model, tmp_path, monkeypatch):
    run_into_folder(Model(mini_model, tracker=TRACKER), MadeDrive(), tmp_path / "cpu")
    with simulated("cuda:0", monkeypatch, sample_plainly) as device:
        interrupt_and_resume(Model(mini_model, device.device, tracker=TRACKER), tmp_path / "gpu")
    found, expected = (read_boxes(tmp_path / name / "predictions.json").frames for name in ("gpu", "cpu"))
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.stamp == theirs.stamp
        np.testing.assert_allclose(ours.boxes.centers, theirs.boxes.centers, atol=1e-3)
        np.testing.assert_array_equal(ours.boxes.instances, theirs.boxes.instances)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["demo", "v2-t8", "vad-tiny", "tiny"])
def test_a_gpu_gets_the_next_frame_before_results_are_waited_for(name, monkeypatch):
    """Each frame waits once, for its own results: what the device copies has no numbers before. The slopes of the road,
    where the horizon tells them, are waited for before a frame is launched."""
    config, count = small_version(name), 4  # the first ones warm up and are captured
    model, drive = made_up_model(config), MemoryDrive(count)
    expected = list(Runner(model, CPU, tracker=TRACKER).run(drive))
    with simulated("cuda:1", monkeypatch, sample_plainly) as device:
        fast = prepare_for_inference(model, device.device)
        upload = lambda prepared: replace(prepared, images=device.tensor(prepared.images))  # noqa: E731
        monkeypatch.setattr("bevcli.inference.runner.image_uploader", lambda device: upload)
        runner = Runner(fast, device.device, tracker=TRACKER)
        begin = runner.begin
        monkeypatch.setattr(runner, "begin", lambda *given: (begin(*given), device.waits.append("launched"))[0])
        found = list(runner.run(drive))
    order = device.waits[device.waits.index("launched") :]
    slope = ["copy to the CPU"] * config.horizon
    assert order == ["launched", *[*slope, "launched", "event"] * (count - 1), "event"]
    for (_, ours, _), (_, theirs, _) in zip(found, expected, strict=True):
        assert ours.stamp == theirs.stamp
        np.testing.assert_allclose(ours.boxes.centers, theirs.boxes.centers, atol=1e-3)
        np.testing.assert_array_equal(ours.boxes.instances, theirs.boxes.instances)
