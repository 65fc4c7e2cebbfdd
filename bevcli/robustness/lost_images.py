"""Lost images: cameras that are out for a whole scene (camera crash), and single images (lost frames)."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Literal

import numpy as np

from bevcli.frame import Frame, Sequence
from bevcli.robustness.draws import Draws
from bevcli.robustness.sequences import ChangedSequence

# What the model gets for a lost image: a black one, as in RoboBEV, or none, as for an image that cannot be read.
LostImage = Literal["black", "missing"]
MOST_CRASHES = 5  # draws of cameras at the hardest level
FRAME_LOST_PARTS = 6  # level L loses an image with probability L/6


class LostImages(ChangedSequence):
    """A sequence that loses images. A subclass overrides `lost`."""

    def __init__(self, sequence: Sequence, level: int, draws: Draws, kind: LostImage) -> None:
        super().__init__(sequence)
        self._level, self._draws, self._kind = level, draws, kind

    def lost(self, frame: Frame) -> Collection[str]:
        """The cameras whose images are lost."""
        raise NotImplementedError

    def change(self, place: int, frame: Frame) -> Frame:
        """The frame without the lost images, or with black ones."""
        lost = [name for name in frame.images if name in self.lost(frame)]
        if self._kind == "missing":
            kept = {name: image for name, image in frame.images.items() if name not in lost}
            return replace(
                frame, images=kept, dropped={**frame.dropped, **dict.fromkeys(lost, "lost by bevcli stress")}
            )
        black = {
            name: replace(image, pixels_bgr=np.zeros_like(image.pixels_bgr), encoded=None, media_type=None)
            for name, image in frame.images.items()
            if name in lost
        }
        return replace(frame, images={**frame.images, **black})


class CameraCrash(LostImages):
    """Level L draws L cameras of the rig, with replacement; they deliver nothing for the whole scene."""

    def lost(self, frame: Frame) -> Collection[str]:
        """The crashed cameras of the scene."""
        names = frame.rig.names
        drawn = self._draws.generator(self.scene_key(frame.stamp)).integers(0, len(names), MOST_CRASHES)
        return {names[index] for index in drawn[: self._level]}


class FrameLost(LostImages):
    """Level L loses each image with a probability of L/6, independently of the others."""

    def lost(self, frame: Frame) -> Collection[str]:
        """The cameras whose images of this frame are lost."""
        scene, index = self.scene_key(frame.stamp), frame.stamp.index
        limit = self._level / FRAME_LOST_PARTS
        return {name for name in frame.rig.names if self._draws.generator(scene, index, name).random() < limit}
