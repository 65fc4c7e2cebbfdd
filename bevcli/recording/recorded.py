"""What is recorded: a drive, the results of a model, and how much of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np

from bevcli.frame import DriveFacts, FrameStamp
from bevcli.geometry.cameras import CameraRig
from bevcli.recording.colors import Color, class_colors
from bevcli.recording.options import RecordingOptions

if TYPE_CHECKING:
    from bevcli.model.config import ModelConfig

UNTRAINED = "untrained weights"
FROM_RENDERED = "trained on renderings"
WARNINGS = {
    UNTRAINED: "The weights are UNTRAINED: boxes and maps are meaningless.",
    FROM_RENDERED: "The weights were trained on rendered streets; these images are not rendered.",
}


class RecordedModel(Protocol):
    """The facts about a model that go into a recording."""

    @property
    def config(self) -> ModelConfig:
        """The model's configuration; its name and its classes are written."""

    @property
    def untrained(self) -> bool:
        """True for random weights. Then titles, events and the page "About" say so."""

    @property
    def bundled(self) -> bool:
        """True for the weights of the package. Titles and events say so where the drive is not a rendered one."""


class RecordedDrive(Protocol):
    """The facts about a drive that go into a recording: those of a `Sequence`, or of a `Session`."""

    name: str
    rig: CameraRig
    has_ego_motion: bool
    facts: DriveFacts

    @property
    def stamps(self) -> tuple[FrameStamp, ...]:
        """The frames that are known in advance; their rate is written."""


@dataclass(frozen=True)
class Recorded:
    """A drive, the model that runs on it, and how much of both a recording holds."""

    drive: RecordedDrive
    model: RecordedModel
    options: RecordingOptions

    @property
    def title(self) -> str:
        """The names of the drive and of the model."""
        return f"{self.drive.name} · {self.model.config.name}"

    @property
    def note(self) -> str:
        """A note on the weights for the titles of the views, "" for none: a key of WARNINGS."""
        if self.model.untrained:
            return UNTRAINED
        return FROM_RENDERED if self.model.bundled and not self.drive.facts.rendered else ""

    @cached_property
    def classes(self) -> Mapping[str, Color]:
        """The model's classes and their colours."""
        return class_colors(self.model.config.object_classes.values())

    @property
    def map_classes(self) -> tuple[str, ...]:
        """The classes of the map that is written; none without a map."""
        return tuple(self.model.config.map_classes) if self.options.shows_internals else ()


def frame_rate_hz(stamps: tuple[FrameStamp, ...]) -> float:
    """Frames per second: 1 / the median time between frames; 2 where there are less than two frames."""
    steps = np.diff([stamp.timestamp_ns for stamp in stamps])
    steps = steps[steps > 0]
    return float(1e9 / np.median(steps)) if len(steps) else 2.0
