"""A step on a GPU that is simulated: every tensor is on the right device, and the CPU waits for it a stated number
of times. A simulated device stops what a real one would stop (tests/simulated_device.py)."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from memory_drive import MemoryDrive
from simulated_device import OnDevice, SimulatedDevice, pinned, simulated

from bevcli.config import known_models, load_config
from bevcli.frame import Prediction
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import Runner, StepOptions
from bevcli.model.config import ModelConfig
from bevcli.model.deformable_attention import GridSampling
from bevcli.model.network import Network
from bevcli.model.prepare import methods_on_device, prepare_for_inference
from bevcli.model.step import PreparedFrame
from bevcli.workshop.benchmark.made_up import made_up_model
from bevcli.workshop.bevformer_v2.window import BEVFormerV2Config
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
    for name in methods_on_device(type(fast)) if device_name == "cuda:1" else ():
        part = getattr(fast, name)
        assert part.failure is None
        assert any(part.graphs.values())
    for ours, theirs in zip(expected, found, strict=True):
        np.testing.assert_allclose(theirs.boxes.centers, ours.boxes.centers, atol=1e-3)
        np.testing.assert_allclose(theirs.boxes.scores, ours.boxes.scores, atol=1e-4)
        if ours.segmentation is not None:
            assert (theirs.segmentation.cells == ours.segmentation.cells).mean() > 0.999
    if device_name == "cuda:1" and not isinstance(config, UniADConfig):
        assert device.waits == ["event"]


def test_with_the_same_projections_only_results_are_waited_for(monkeypatch):
    config = small_version("demo")
    model, prepared = made_up_model(config), frames(config, same_projection=True)
    with simulated("cuda:0", monkeypatch, sample_plainly) as device:
        run(prepare_for_inference(model, device.device, "bf16"), device.device, prepared, device.waits)
    assert device.waits == ["event"]


def test_a_step_uploads_once_and_reads_back_once(monkeypatch):
    config = small_version("demo")
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


def test_a_step_with_a_tensor_on_another_device_is_stopped():
    device = SimulatedDevice("cuda:1")
    with device:
        there = torch.zeros(3, device=device.device)
        with pytest.raises(RuntimeError, match="on cuda:1 and on the CPU"):
            there + torch.ones(3)
        with pytest.raises(RuntimeError, match="the model is on cuda:1"):
            torch.ones(3, device="cuda")
        assert device.waits == []
        there[[0, 2]], there.sum().item(), there.cpu(), there[there > 0]
        assert device.waits == ["index of the CPU", "item", "cpu", "index of a mask"]
        device.waits.clear()
        count = there.sum().int()
        there[count], there[:count], there[0, ...], 1.0 in there, f"{count}", there.to(CPU), range(count)
        assert device.waits == [
            "index of one element", "index of one element", "__contains__", "__format__", "copy to the CPU", "__index__"
        ]  # fmt: skip
        there.to(CPU, non_blocking=True), torch.cat([there, there])  # to pinned memory
        assert len(device.waits) == 6
    with SimulatedDevice("mps"), pytest.raises(TypeError, match="no float64"):
        torch.zeros(3, device="mps").double()


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
