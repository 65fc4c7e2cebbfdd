"""Batches are the same whoever makes them, clip by clip, and images travel as bytes without a loss that matters.

The drawing of clips.
"""

import pickle
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from memory_drive import MemoryDrive
from painted_drives import CONFIG, PaintedDrive, PaintedDrives
from simulated_device import simulated
from torch import Tensor

from bevcli.errors import InputError
from bevcli.inference.preprocess import write_network_image
from bevcli.model.config import ImageConfig
from bevcli.workshop.synth.drives import FrameMemory
from bevcli.workshop.training.augmentation import AugmentationConfig, noisy
from bevcli.workshop.training.job import free_memory
from bevcli.workshop.training.samples import (
    BatchMaker,
    Clip,
    ClipConfig,
    draw_clip,
    draw_frames,
    images_from_bytes,
    loaded_batches,
    write_bytes,
)

NOTHING, NOISE = AugmentationConfig(0, 0), AugmentationConfig(0.5, 0.5, exposure=1.0, noise=6.0, calibration_share=0.5)
LITE = ImageConfig((64, 48), mean=(123.675, 116.28, 103.53), std=(58.395, 57.12, 57.375), color_order="rgb")
CLIPS = ClipConfig(frames=2, batch=3, learn="all", short_share=0.0)


def maker(augmentation: AugmentationConfig = NOISE, *, in_bytes: bool = False) -> BatchMaker:
    drives = PaintedDrives(3, all_labelled=True)
    return BatchMaker(drives, CONFIG, CLIPS, augmentation, 0, 0, with_gap=False, plain=True, in_bytes=in_bytes)


def tensors(part: Any) -> Iterator[Tensor]:
    """All tensors of a batch, in a fixed order."""
    if isinstance(part, Tensor):
        yield part
    elif isinstance(part, tuple):
        for one in part:
            yield from tensors(one)
    elif hasattr(part, "__dataclass_fields__"):
        yield from tensors(tuple(vars(part).values()))


def assert_equal(one: Any, other: Any) -> None:
    pairs = list(zip(tensors(one), tensors(other), strict=True))
    assert len(pairs) > 10
    assert all(a.dtype == b.dtype and a.shape == b.shape for a, b in pairs)
    assert all(np.array_equal(a.numpy(), b.numpy(), equal_nan=a.is_floating_point()) for a, b in pairs)


@pytest.mark.parametrize("loaders", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_batches_are_equal_for_any_number_of_loaders(loaders: int) -> None:
    turns, made = [(0, 0), (1, 0), (2, 0)], maker(in_bytes=True)
    with closing(loaded_batches(made, turns, loaders)) as batches:
        for turn, batch in zip(turns, batches, strict=True):
            assert batch.inputs[0].images.dtype == torch.uint8
            assert_equal(batch, made(*turn))


def test_a_clip_is_the_same_alone_and_in_its_batch() -> None:
    batch, made = maker()(4, 0), maker()
    for place in range(CLIPS.batch):
        clip = made.clip(4, 0, place)
        for alone, together in zip(clip.inputs, batch.inputs, strict=True):
            assert torch.equal(alone.images[0], together.images[place])
            assert torch.equal(alone.image_from_bev[0], together.image_from_bev[place])
        for own, of_batch in zip(clip.targets, batch.targets, strict=True):
            count = own.detection.counts[0]
            assert count == of_batch.detection.counts[place]
            assert torch.equal(own.detection.labels[0], of_batch.detection.labels[place, : max(1, count)])


@pytest.mark.parametrize("in_bytes", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_batches_of_kept_images_are_those_of_images_read_anew(in_bytes: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    worst = replace(NOISE, corrupted_share=0.6, lost_cameras_share=0.5, drop_image=0.2, white_balance=0.2)
    plain, turns, reads, load = maker(worst, in_bytes=in_bytes), [(0, 0), (1, 0), (2, 0)], [], PaintedDrive.load
    frame_bytes = sum(image.pixels_bgr.nbytes for image in plain.drives.open(0).load(0).images.values())
    monkeypatch.setattr(PaintedDrive, "load", lambda drive, place: reads.append(place) or load(drive, place))
    expected, counts = [plain(*turn) for turn in turns], []
    for kept_frames in (0, 3, 100):
        made = replace(plain, memory=FrameMemory(kept_frames * frame_bytes))
        reads.clear()
        for turn, batch in zip(turns, expected, strict=True):
            assert_equal(made(*turn), batch)
        counts.append(len(reads))
    assert counts[0] == len(turns) * CLIPS.batch * CLIPS.frames
    assert counts[0] > counts[1] > counts[2] == 6  # three drives of two frames


def test_kept_frames_stay_in_their_process() -> None:
    drive, kept = PaintedDrives(1, all_labelled=True).open(0), FrameMemory(10**9)
    first = kept.load(drive, 0, 0)
    assert kept.load(drive, 0, 0) is first
    copied = pickle.loads(pickle.dumps(kept))
    assert len(pickle.dumps(kept)) < 10**5
    again = copied.load(drive, 0, 0)
    assert np.array_equal(again.images["CAM_FRONT"].pixels_bgr, first.images["CAM_FRONT"].pixels_bgr)


def test_free_memory_is_within_the_limit_of_a_container(tmp_path: Path) -> None:
    groups = tmp_path / "sys/fs/cgroup"
    for folder in (tmp_path / "proc", groups / "memory"):
        folder.mkdir(parents=True)
    assert free_memory(tmp_path) == 0
    (tmp_path / "proc/meminfo").write_text("MemTotal: 9000 kB\nMemAvailable:    8000 kB\n")
    assert free_memory(tmp_path) == 8_192_000
    (groups / "memory.max").write_text("max\n")
    assert free_memory(tmp_path) == 8_192_000
    (groups / "memory.max").write_text("5000000\n")
    (groups / "memory.current").write_text("4000000\n")
    (groups / "memory.stat").write_text("anon 1000000\ninactive_file 2500000\nactive_file 500000\n")
    assert free_memory(tmp_path) == 3_500_000
    (groups / "memory.current").write_text("9000000\n")
    assert free_memory(tmp_path) == 0


def test_images_in_bytes_are_distorted_where_they_are_normalised() -> None:
    """The same draws, so that only the rounding differs; what is masked stays grey."""
    changes = AugmentationConfig(0.7, 0.7, exposure=0.5)
    floats, in_bytes = maker(changes)(0, 0), maker(changes, in_bytes=True)(0, 0)
    normalised = in_bytes.normalised(CONFIG.image)
    undistorted = replace(in_bytes, distortions=()).normalised(CONFIG.image)
    std = torch.tensor(CONFIG.image.std).view(3, 1, 1)
    for own, other, before in zip(floats.inputs, normalised.inputs, undistorted.inputs, strict=True):
        errors = (own.images - other.images).abs() * std
        assert errors.quantile(0.99) <= 1.01
        assert ((own.images == 0) == (other.images == 0)).float().mean() > 0.99
        assert ((own.images - before.images).abs() * std).mean() > 5


def test_a_gpu_distorts_and_normalises_without_a_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    batch = maker(AugmentationConfig(1.0, 0.5), in_bytes=True)(0, 0)
    expected = batch.normalised(CONFIG.image)
    with simulated("cuda:0", monkeypatch, lambda *_, **__: None) as device:
        found = batch.to(device.device).normalised(CONFIG.image)
        assert device.waits == []
        for own, other in zip(expected.inputs, found.inputs, strict=True):
            torch.testing.assert_close(other.images.held, own.images)
            assert own.image_from_bev is other.image_from_bev


@pytest.mark.parametrize(
    ("size", "changes"),
    [
        ((64, 48), {}),
        ((64, 48), {"color_order": "bgr", "crop": (0, 0, 60, 40)}),
        ((64, 40), {}),  # fits with a margin below
        ((160, 96), {"resize": "area"}),
        ((50, 40), {"crop": (3, 5, 60, 45)}),
    ],
)
def test_images_as_bytes_are_the_normalised_ones_rounded(size: tuple[int, int], changes: dict[str, Any]) -> None:
    image = replace(LITE, size=(64, 48), pad_divisor=32, **changes)
    pixels = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    width, height = image.padded_size
    floats, in_bytes = (np.zeros((height, width, 3), dtype).transpose(2, 0, 1) for dtype in (np.float32, np.uint8))
    write_network_image(pixels, image, floats)
    write_bytes(pixels, image, in_bytes)
    assert not in_bytes[floats == 0].any()
    back = images_from_bytes(torch.from_numpy(in_bytes)[None, None], image)[0, 0].numpy()
    errors = np.abs(back - floats) * np.array(image.std)[:, None, None]
    assert errors.max() <= 0.501
    if size[0] == image.size[0]:  # not resized
        assert errors[floats != 0].max() < 1e-4


def test_noise_is_normal_and_independent() -> None:
    grey, random = np.full((200, 301, 3), 100, np.uint8), np.random.default_rng(0)
    one, other = (noisy(grey, 5.0, random).astype(np.float64) - 100 for _ in range(2))
    assert abs(one.mean()) < 0.05
    assert one.std() == pytest.approx(5.0, rel=0.01)
    flat = one.reshape(-1)
    for shifted in (other.reshape(-1), *(np.roll(flat, step) for step in range(1, 7))):
        assert abs(np.corrcoef(flat, shifted)[0, 1]) < 0.01
    assert np.mean(np.abs(flat) > 10) == pytest.approx(0.0357, abs=0.01)  # beyond 10.5: 2.1 deviations
    assert noisy(np.full((9, 9, 3), 255, np.uint8), 50.0, random).max() == 255


class Drives:
    """Copies of one drive."""

    input_shapes: tuple[tuple[int, int, int], ...] | None = None

    def __init__(self, sequence: MemoryDrive, count: int = 2) -> None:
        self._sequence, self._count = sequence, count

    def __len__(self) -> int:
        return self._count

    def open(self, index: int) -> MemoryDrive:
        return self._sequence


def drawn(sequence: MemoryDrive, frames: int, times: int = 200) -> Counter[tuple[int, ...]]:
    random = np.random.default_rng(0)
    return Counter(draw_frames(sequence, frames, random) for _ in range(times))


def clips_of(drives: Drives, config: ClipConfig, seed: int = 0) -> list[Clip]:
    """The clips of one batch."""
    return [draw_clip(drives, config, [seed], place)[0] for place in range(config.batch)]


def test_one_earlier_frame_is_left_out_and_the_order_is_kept() -> None:
    expected = {(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)}  # frame 1 has one frame before it, the others two
    assert set(drawn(MemoryDrive(4), frames=2)) == expected
    assert all(places[-1] - places[0] <= 3 for places in drawn(MemoryDrive(10), frames=3))


def test_clips_trained_on_as_a_whole_have_no_gap() -> None:
    config = ClipConfig(frames=3, batch=50, short_share=0.0, learn="all")
    found = {clip.frames for clip in clips_of(Drives(MemoryDrive(5)), config)}
    assert found == {(0, 1, 2), (1, 2, 3), (2, 3, 4)}


def test_a_clip_stays_in_its_scene() -> None:
    assert set(drawn(MemoryDrive(6, scenes="aaabbb"), frames=3)) == {(0, 1, 2), (3, 4, 5)}
    assert set(drawn(MemoryDrive(3), frames=1)) == {(0,), (1,), (2,)}
    with pytest.raises(InputError, match="memory: no scene has 4 frames or more"):
        drawn(MemoryDrive(6, scenes="aaabbb"), frames=4)


def test_clips_of_a_batch_have_one_length_and_some_are_short() -> None:
    lengths = Counter()
    for seed in range(300):
        clips = clips_of(Drives(MemoryDrive(8)), ClipConfig(frames=3, batch=4, short_share=0.3), seed)
        assert len({len(clip.frames) for clip in clips}) == 1
        lengths[len(clips[0].frames)] += 1
    assert set(lengths) == {1, 2, 3}
    assert lengths[3] / 300 == pytest.approx(0.7, abs=0.1)


def test_clips_of_a_batch_share_camera_count_and_image_sizes() -> None:
    drives = Drives(MemoryDrive(5), 40)
    sizes = [(4 + index % 2, 96 + 32 * (index // 2), 160) for index in range(40)]
    drives.input_shapes = tuple(sizes)
    for seed in range(50):
        shapes = [sizes[clip.drive] for clip in clips_of(drives, ClipConfig(frames=2, batch=4), seed)]
        assert len({cameras for cameras, _, _ in shapes}) == 1
        assert max(height for _, height, _ in shapes) - min(height for _, height, _ in shapes) <= 8 * 32
