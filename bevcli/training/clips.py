"""Clips: short parts of drives. As in the paper, one frame to learn from and some before it, for the history."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import Sequence
from bevcli.sequences.selection import scenes_of
from bevcli.training.drives import Drives


@dataclass(frozen=True)
class ClipConfig:
    """frames: of a clip; the paper's base model trains on 4, tiny and small on 3; 1 is without history.

    batch: clips a step. short_share: of the batches, whose clips are shorter, as at the start of a scene.
    learn: "last" learns from the last frame of a clip, as published. "all" goes through longer clips and learns from
    every frame, one update each, the first of them without history: no image is looked at in vain.
    in_turn: with "all", batches a step that are gone through side by side, a frame of each in turn, so that updates
    that follow each other do not learn from the same few streets.
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
    """drive: its place among the drives. places: of the frames in it, in order."""

    drive: int
    places: tuple[int, ...]


def draw_clips(drives: Drives, config: ClipConfig, random: np.random.Generator) -> list[Clip]:
    """The clips of a batch, all of one length. Raises InputError where a drive is too short for it."""
    frames = config.frames
    if frames > 1 and random.random() < config.short_share:
        frames = int(random.integers(1, frames))
    clips = []
    for _ in range(config.batch):
        drive = int(random.integers(len(drives)))
        with_gap = config.learn == "last"
        clips.append(Clip(drive, draw_places(drives.open(drive), frames, random, with_gap=with_gap)))
    return clips


def draw_places(
    sequence: Sequence, frames: int, random: np.random.Generator, *, with_gap: bool = True
) -> tuple[int, ...]:
    """A frame drawn at random and frames - 1 of those before it in its scene.

    with_gap: they are chosen from `frames` of them, one left out at random, as published.
    """
    scenes = list(scenes_of(sequence.stamps))
    ends = [(scene, end) for scene in scenes for end in range(frames - 1, len(scene))]
    if not ends:
        raise InputError(f"{sequence.name}: no scene of it has the {frames} frames of a clip")
    scene, end = ends[int(random.integers(len(ends)))]
    before = scene[max(0, end - frames if with_gap else end - frames + 1) : end]
    if len(before) == frames:
        del before[int(random.integers(len(before)))]
    return (*before, scene[end])
