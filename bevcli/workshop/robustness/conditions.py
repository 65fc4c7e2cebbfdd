"""The corruptions with their severities: what `bevcli stress` runs."""

from collections.abc import Callable, Mapping, Sequence as Items
from dataclasses import dataclass
from enum import Enum, auto
from functools import partial

from bevcli.errors import InputError
from bevcli.frame import Sequence
from bevcli.workshop.robustness import sequences
from bevcli.workshop.robustness.options import LostImage, SeverityChoice
from bevcli.workshop.robustness.sequences import Draws
from bevcli.workshop.synth import corruptions

# Makes of a scene what is run in its place, for a level: several sequences if they must not share a history.
Apply = Callable[[Sequence, int, Draws, LostImage], Sequence | tuple[Sequence, ...]]


class Group(Enum):
    """Corruptions whose scores are averaged together."""

    ROBOBEV = auto()  # as published: mRR and mCE
    UNSEEN = auto()  # those of ImageNet-C that no training here uses
    OTHER = auto()  # averaged with nothing


class Shown(Enum):
    """The part of a frame that shows a corruption on the contact sheet."""

    IMAGE = auto()  # of the camera that looks ahead
    BOXES = auto()  # the same with ground truth boxes: the image stays, they show where the model looks
    CAMERAS = auto()  # all cameras
    NOTHING = auto()  # it changes no image


@dataclass(frozen=True)
class Corruption:
    """A kind of corruption with its severities.

    Attributes:
        name: on the command line and in stress.json.
        title: in plots, with the unit of the levels.
        levels: severity, such as "easy", or a number -> level.
        apply: makes of a scene what is run.
        shown: on the contact sheet.
        group: the corruptions that it is averaged with.
    """

    name: str
    title: str
    levels: Mapping[str, int]
    apply: Apply
    shown: Shown = Shown.IMAGE
    group: Group = Group.ROBOBEV


@dataclass(frozen=True)
class Condition:
    """One corruption at one severity.

    Attributes:
        corruption: CLEAN for clean drives.
        severity: a key of `Corruption.levels`.
    """

    corruption: Corruption
    severity: str

    @property
    def name(self) -> str:
        """Name of the corruption, or "clean"."""
        return self.corruption.name

    def sequences(self, scene: Sequence, seed: int, kind: LostImage) -> tuple[Sequence, ...]:
        """The sequences that are run in place of a scene."""
        made = self.corruption.apply(scene, self.corruption.levels[self.severity], Draws(seed, self.name), kind)
        return made if isinstance(made, tuple) else (made,)


def _images(corrupt: corruptions.ImageCorruption) -> Apply:
    return partial(sequences.CorruptedImages, corrupt=corrupt)


def _severities(easy: int, mid: int, hard: int) -> dict[str, int]:
    return {"easy": easy, "mid": mid, "hard": hard}


def _unseen(name: str, corrupt: corruptions.ImageCorruption) -> Corruption:
    return Corruption(name, name.replace("_", " "), _severities(2, 4, 5), _images(corrupt), group=Group.UNSEEN)


CLEAN = Corruption("clean", "no corruption", {"": 0}, lambda scene, *_: scene, Shown.NOTHING, Group.OTHER)
# Levels of the first eight as published: RoboBEV, docs/CREATE.md.
CORRUPTIONS = (
    Corruption("camera_crash", "camera crash", _severities(2, 4, 5), sequences.CameraCrash, Shown.CAMERAS),
    Corruption("frame_lost", "frame lost", _severities(2, 4, 5), sequences.FrameLost, Shown.CAMERAS),
    Corruption(
        "color_quantisation", "colour quantisation", _severities(1, 2, 3), _images(corruptions.color_quantisation)
    ),
    Corruption("motion_blur", "motion blur", _severities(2, 4, 5), _images(corruptions.motion_blur)),
    Corruption("brightness", "brightness", _severities(2, 4, 5), _images(corruptions.brightness)),
    Corruption("low_light", "low light", _severities(2, 3, 4), _images(corruptions.low_light)),
    Corruption("fog", "fog", _severities(2, 4, 5), _images(corruptions.fog)),
    Corruption("snow", "snow", _severities(1, 2, 3), _images(corruptions.snow)),
    _unseen("defocus_blur", corruptions.defocus_blur),
    _unseen("low_contrast", corruptions.low_contrast),
    _unseen("impulse_noise", corruptions.impulse_noise),
    _unseen("jpeg", corruptions.jpeg),
    _unseen("saturation", corruptions.saturation),
    Corruption(
        "calibration_noise", "calibration noise", {"1": 1, "2": 2, "3": 3, "4": 4},
        sequences.CalibrationNoise, Shown.BOXES, group=Group.OTHER,
    ),
    Corruption(
        "time_offset", "capture times off by up to 50, 100, 200 ms", _severities(50, 100, 200),
        sequences.TimeOffsets, Shown.BOXES, group=Group.OTHER,
    ),
    Corruption(
        "ego_motion_lost", "ego-motion lost in 2/6, 4/6, 5/6 of the frames", _severities(2, 4, 5),
        sequences.EgoMotionLost, Shown.NOTHING, group=Group.OTHER,
    ),
    Corruption(
        "frame_rate", "1/2, 1/3, 1/4 of the frame rate", _severities(2, 3, 4),
        lambda scene, step, *_: sequences.at_lower_rate(scene, step), Shown.NOTHING, group=Group.OTHER,
    ),
)  # fmt: skip
NAMES = tuple(corruption.name for corruption in CORRUPTIONS)
_GROUP_OF_LEVEL = {"1": "easy", "2": "mid", "3": "mid", "4": "hard"}  # of corruptions with numbered levels


def choose_conditions(severity: SeverityChoice = "all", only: Items[str] = ()) -> tuple[Condition, ...]:
    """The conditions of a test: clean first, then the corruptions in the order of CORRUPTIONS.

    severity: only conditions of this severity; of the numbered levels, 1 is easy, 2 and 3 are mid, 4 is hard.
    only: names of corruptions; empty for all. Raises InputError for an unknown name.
    """
    unknown = [name for name in only if name not in NAMES]
    if unknown:
        raise InputError(f"`only={unknown[0]}`: unknown corruption (expected one of {', '.join(NAMES)})")
    chosen = [
        Condition(corruption, label)
        for corruption in CORRUPTIONS
        if not only or corruption.name in only
        for label in corruption.levels
        if severity in ("all", _GROUP_OF_LEVEL.get(label, label))
    ]
    return (Condition(CLEAN, ""), *chosen)
