"""Sequences that wrap another one: its frames with a change, kept in memory, of one scene, or at a lower rate."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from bevcli.errors import InputError
from bevcli.frame import CameraImage, Frame, FrameStamp, Sequence, facts_of
from bevcli.robustness.draws import Draws
from bevcli.robustness.processing import ImageCorruption, Level
from bevcli.sequences.selection import scenes_of, select

KEPT_BYTES = 1 << 30  # decoded images that are kept in memory, of all drives together


class ChangedSequence:
    """A sequence whose frames are changed when they are loaded. A subclass overrides `change`."""

    def __init__(self, sequence: Sequence) -> None:
        self._sequence = sequence
        self.name = sequence.name
        self.rig = sequence.rig
        self.has_ego_motion = sequence.has_ego_motion
        self.notes = sequence.notes
        self.facts = facts_of(sequence)
        self.input_files: tuple[Path, ...] = getattr(sequence, "input_files", ())

    @property
    def stamps(self) -> tuple[FrameStamp, ...]:
        """Identity and time of each frame: those of the sequence."""
        return self._sequence.stamps

    def load(self, place: int) -> Frame:
        """The changed frame at a place."""
        return self.change(place, self._sequence.load(place))

    def change(self, place: int, frame: Frame) -> Frame:
        """The frame at a place with its change; here none."""
        return frame

    def scene_key(self, stamp: FrameStamp) -> str:
        """A name of the frame's scene for `Draws`, which does not depend on where the drive is stored."""
        return f"{self.name}/{stamp.scene}"


class CorruptedImages(ChangedSequence):
    """A sequence with every image corrupted. Each frame and camera has its own random numbers."""

    def __init__(self, sequence: Sequence, corrupt: ImageCorruption, level: Level, draws: Draws) -> None:
        super().__init__(sequence)
        self._corrupt, self._level, self._draws = corrupt, level, draws

    def change(self, place: int, frame: Frame) -> Frame:
        """The frame with corrupted images; the cameras are computed in parallel."""
        scene = self.scene_key(frame.stamp)

        def corrupted(name: str) -> CameraImage:
            random = self._draws.generator(scene, frame.stamp.index, name)
            pixels = self._corrupt(frame.images[name].pixels_bgr, self._level, random)
            return replace(frame.images[name], pixels_bgr=pixels, encoded=None, media_type=None)

        with ThreadPoolExecutor(min(max(len(frame.images), 1), os.cpu_count() or 1)) as threads:
            images = dict(zip(frame.images, threads.map(corrupted, frame.images), strict=True))
        return replace(frame, images=images)


class FrameStore:
    """The memory that `KeptFrames` of several drives share.

    limit: bytes of decoded images; frames beyond it are read again each time.
    """

    def __init__(self, limit: int = KEPT_BYTES) -> None:
        self.left = limit


class KeptFrames(ChangedSequence):
    """A sequence that keeps its decoded frames while the memory lasts, because every condition needs them.

    The bytes of the image files are not kept.
    """

    def __init__(self, sequence: Sequence, store: FrameStore) -> None:
        super().__init__(sequence)
        self._store = store
        self._frames: dict[int, Frame] = {}

    def load(self, place: int) -> Frame:
        """The frame at a place, from memory if it is there."""
        if place in self._frames:
            return self._frames[place]
        frame = self._sequence.load(place)
        images = {name: replace(image, encoded=None, media_type=None) for name, image in frame.images.items()}
        frame = replace(frame, images=images)
        size = sum(image.pixels_bgr.nbytes for image in images.values())
        if size <= self._store.left:
            self._store.left -= size
            self._frames[place] = frame
        return frame


def split_scenes(sequence: Sequence) -> list[Sequence]:
    """One sequence per scene. Raises InputError if the sequence has no frames."""
    if not sequence.stamps:
        raise InputError(f"{sequence.name}: has no frames")
    return [select(sequence, places) for places in scenes_of(sequence.stamps)]


def at_lower_rate(sequence: Sequence, step: int) -> tuple[Sequence, ...]:
    """The frames of one scene at 1/step of its rate, as `step` sequences that start one frame after another.

    Together they have every frame once, so that the score covers the same ground truth as at the full rate.
    """
    count = len(sequence.stamps)
    return tuple(select(sequence, range(start, count, step)) for start in range(min(step, count)))
