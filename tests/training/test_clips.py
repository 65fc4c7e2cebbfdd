"""Drawing of clips."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from memory_drive import MemoryDrive

from bevcli.errors import InputError
from bevcli.workshop.training.samples import Clip, ClipConfig, draw_clip, draw_frames


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


def test_a_clip_of_one_frame_has_no_history() -> None:
    assert set(drawn(MemoryDrive(3), frames=1)) == {(0,), (1,), (2,)}


def test_a_drive_too_short_for_a_clip_is_rejected() -> None:
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
