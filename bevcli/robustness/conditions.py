"""The corruptions with their severities: what `bevcli stress` runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Sequence as Items
from dataclasses import dataclass
from typing import Literal

from bevcli.errors import InputError
from bevcli.frame import Sequence
from bevcli.robustness.calibration_noise import CalibrationNoise
from bevcli.robustness.draws import Draws
from bevcli.robustness.ego_motion_faults import EgoMotionLost, TimeOffsets
from bevcli.robustness.lighting import brightness, low_light
from bevcli.robustness.lost_images import CameraCrash, FrameLost, LostImage
from bevcli.robustness.processing import ImageCorruption, color_quantisation, motion_blur
from bevcli.robustness.sequences import CorruptedImages, at_lower_rate
from bevcli.robustness.weather import fog, snow

SeverityChoice = Literal["easy", "mid", "hard", "all"]
CLEAN = "clean"
# Makes of a scene what is run in its place, for a level: several sequences if they must not share a history.
Apply = Callable[[Sequence, int, Draws, LostImage], tuple[Sequence, ...]]


@dataclass(frozen=True)
class Corruption:
    """A kind of corruption with its severities.

    Attributes:
        name: on the command line and in stress.json.
        title: in plots, with the unit of the levels.
        levels: severity, such as "easy", or a number -> level.
        apply: makes of a scene what is run.
        published: whether it is one of RoboBEV's; only these count in mRR and mCE.
    """

    name: str
    title: str
    levels: Mapping[str, int]
    apply: Apply
    published: bool = True


@dataclass(frozen=True)
class Condition:
    """One corruption at one severity.

    Attributes:
        corruption: None for clean drives.
        severity: a key of `Corruption.levels`; "" for clean drives.
    """

    corruption: Corruption | None = None
    severity: str = ""

    @property
    def name(self) -> str:
        """Name of the corruption, or "clean"."""
        return CLEAN if self.corruption is None else self.corruption.name

    def sequences(self, scene: Sequence, seed: int, kind: LostImage) -> tuple[Sequence, ...]:
        """What is run in place of a scene."""
        if self.corruption is None:
            return (scene,)
        level = self.corruption.levels[self.severity]
        return self.corruption.apply(scene, level, Draws(seed, self.name), kind)


def _images(corrupt: ImageCorruption) -> Apply:
    return lambda scene, level, draws, kind: (CorruptedImages(scene, corrupt, level, draws),)


def _severities(easy: int, mid: int, hard: int) -> dict[str, int]:
    return {"easy": easy, "mid": mid, "hard": hard}


# Levels of the first eight as published: RoboBEV, docs/CREATE.md.
CORRUPTIONS = (
    Corruption(
        "camera_crash", "camera crash", _severities(2, 4, 5),
        lambda scene, level, draws, kind: (CameraCrash(scene, level, draws, kind),),
    ),
    Corruption(
        "frame_lost", "frame lost", _severities(2, 4, 5),
        lambda scene, level, draws, kind: (FrameLost(scene, level, draws, kind),),
    ),
    Corruption("color_quantisation", "colour quantisation", _severities(1, 2, 3), _images(color_quantisation)),
    Corruption("motion_blur", "motion blur", _severities(2, 4, 5), _images(motion_blur)),
    Corruption("brightness", "brightness", _severities(2, 4, 5), _images(brightness)),
    Corruption("low_light", "low light", _severities(2, 3, 4), _images(low_light)),
    Corruption("fog", "fog", _severities(2, 4, 5), _images(fog)),
    Corruption("snow", "snow", _severities(1, 2, 3), _images(snow)),
    Corruption(
        "calibration_noise", "calibration noise", {"1": 1, "2": 2, "3": 3, "4": 4},
        lambda scene, level, draws, kind: (CalibrationNoise(scene, level, draws),), published=False,
    ),
    Corruption(
        "time_offset", "capture times off by up to 50, 100, 200 ms", _severities(50, 100, 200),
        lambda scene, level, draws, kind: (TimeOffsets(scene, level, draws),), published=False,
    ),
    Corruption(
        "ego_motion_lost", "ego-motion lost in 2/6, 4/6, 5/6 of the frames", _severities(2, 4, 5),
        lambda scene, level, draws, kind: (EgoMotionLost(scene, level, draws),), published=False,
    ),
    Corruption(
        "frame_rate", "1/2, 1/3, 1/4 of the frame rate", _severities(2, 3, 4),
        lambda scene, level, draws, kind: at_lower_rate(scene, level), published=False,
    ),
)  # fmt: skip
NAMES = tuple(corruption.name for corruption in CORRUPTIONS)
_GROUP_OF_LEVEL = {"1": "easy", "2": "mid", "3": "mid", "4": "hard"}  # of corruptions with numbered levels


def choose_conditions(severity: SeverityChoice = "all", only: Items[str] = ()) -> tuple[Condition, ...]:
    """The conditions of a test: clean first, then the corruptions in the order of CORRUPTIONS.

    Args:
        severity: only conditions of this severity. Of the numbered levels, 1 is easy, 2 and 3 are mid, 4 is hard.
        only: names of corruptions; empty for all.

    Raises:
        InputError: a name is unknown.
    """
    unknown = [name for name in only if name not in NAMES]
    if unknown:
        raise InputError(f"--only {unknown[0]}: unknown corruption (expected one of {', '.join(NAMES)})")
    return (
        Condition(),
        *(
            Condition(corruption, label)
            for corruption in CORRUPTIONS
            if not only or corruption.name in only
            for label in corruption.levels
            if severity in ("all", _GROUP_OF_LEVEL.get(label, label))
        ),
    )
