"""Training clips: short parts of drives. As in the paper, the last frame is trained on, the others are its history."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import Sequence
from bevcli.sequences.selection import scenes_of
from bevcli.training.drives import Drives, InputShape, input_shapes_of

_CHOICE = 8  # drives among which the other clips of a batch are drawn, at least


@dataclass(frozen=True)
class ClipConfig:
    """The [training.clips] table.

    Attributes:
        frames: frames of a clip. The paper's base model uses 4, tiny and small use 3; 1 trains without history.
        batch: clips of a batch.
        short_share: share of the batches with shorter clips (0 to 1), because each scene starts without history.
        learn: "last" trains on the last frame of a clip, as published. "all" trains on every frame of successive
            frames, with one update each; a clip's first frame has no history.
        in_turn: with "all", the number of batches a step. The updates alternate between them, so that successive
            updates do not see the same few streets.
    """

    frames: int = 3
    batch: int = 4
    short_share: float = 0.1
    learn: Literal["last", "all"] = "last"
    in_turn: int = 1

    def __post_init__(self) -> None:
        if min(self.frames, self.batch) < 1 or not 0 <= self.short_share <= 1:
            raise ValueError("frames and batch must be positive, short_share from 0 to 1")
        if self.in_turn < 1 or (self.in_turn > 1 and self.learn != "all"):
            raise ValueError('in_turn must be positive, and 1 unless learn is "all"')


@dataclass(frozen=True)
class Clip:
    """Some frames of one drive.

    Attributes:
        drive: index of the drive.
        frames: indices of the frames in the drive, ascending.
    """

    drive: int
    frames: tuple[int, ...]


def draw_clips(drives: Drives, config: ClipConfig, random: np.random.Generator, *, with_gap: bool = True) -> list[Clip]:
    """The clips of one batch, all of the same length. Raises InputError if a drive is too short.

    Args:
        with_gap: with `learn` "last", leave out one of the earlier frames, as published for BEVFormer.
    """
    frames = config.frames
    if frames > 1 and random.random() < config.short_share:
        frames = int(random.integers(1, frames))
    clips: list[Clip] = []
    shapes = input_shapes_of(drives)
    for _ in range(config.batch):
        if clips and shapes is not None:
            alike = _similar_drives(shapes, clips[0].drive)
            drive = int(alike[random.integers(len(alike))])
        else:
            drive = int(random.integers(len(drives)))
        leave_out = with_gap and config.learn == "last"
        clips.append(Clip(drive, draw_frames(drives.open(drive), frames, random, with_gap=leave_out)))
    return clips


def _similar_drives(shapes: tuple[InputShape, ...], drive: int) -> NDArray[np.intp]:
    """Drives that go into one batch with a drive: with as many cameras, and of these those with the nearest sizes.

    The images of a batch are padded to the largest. At least `_CHOICE` drives, where so many have as many cameras.
    """
    counts, heights, widths = np.array(shapes).T
    differences = np.abs(heights - heights[drive]) + np.abs(widths - widths[drive])
    alike = counts == counts[drive]
    nearest = np.sort(differences[alike])[:_CHOICE]
    return np.flatnonzero(alike & (differences <= nearest[-1]))


def draw_frames(
    sequence: Sequence, count: int, random: np.random.Generator, *, with_gap: bool = True
) -> tuple[int, ...]:
    """Indices of a random frame and of `count` - 1 frames before it in its scene. Raises InputError if there are none.

    Args:
        with_gap: as published, take the `count` frames before it and leave out a random one.
    """
    scenes = list(scenes_of(sequence.stamps))
    candidates = [(scene, end) for scene in scenes for end in range(count - 1, len(scene))]
    if not candidates:
        raise InputError(f"{sequence.name}: no scene has {count} frames or more, as many as a clip needs")
    scene, end = candidates[int(random.integers(len(candidates)))]
    before = scene[max(0, end - count if with_gap else end - count + 1) : end]
    if len(before) == count:
        del before[int(random.integers(len(before)))]
    return (*before, scene[end])
