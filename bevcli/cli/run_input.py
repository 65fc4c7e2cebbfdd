"""Which frames of which input a run takes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from bevcli.errors import InputError
from bevcli.frame import Sequence
from bevcli.model.bevformer import BEVFormerConfig
from bevcli.sequences.native.folder import EgoMotionUse
from bevcli.sequences.open import InputOptions, open_sequence
from bevcli.sequences.rate import every, thin
from bevcli.sequences.selection import select


@dataclass(frozen=True)
class FrameChoice:
    """Which frames of the input a run takes, as the user said it; see `bevcli run --help`."""

    frames: str | None = None
    rate: str | None = None
    every: int | None = None


def ego_motion_use(*, static: bool, temporal: bool) -> EgoMotionUse:
    """What --static and --no-temporal mean for ego_motion.csv."""
    if static:
        return "static"
    return "required" if temporal else "none"


def choose_frames(path: Path, options: InputOptions, choice: FrameChoice, config: BEVFormerConfig) -> Sequence:
    """The input at `path`, thinned to the model's rate unless said otherwise, then cut to the places asked for.

    Raises InputError.
    """
    if options.sweeps and choice.rate is None and choice.every is None:
        choice = replace(choice, rate="all")  # who asks for the images in between wants them
    sequence = _thinned(open_sequence(path, options), choice, config)
    return select(sequence, frame_range(choice.frames, len(sequence.stamps)))


def frame_range(text: str | None, count: int) -> range:
    """ "A:B" of `count` places, B exclusive, either may be left out; clipped. Raises InputError where none is left."""
    if text is None:
        return range(count)
    parts = text.split(":")
    if len(parts) != 2 or not all(part == "" or part.isdecimal() for part in parts):
        raise InputError(f'--frames "{text}": expected A:B with whole numbers, as 0:10 or 5:')
    places = range(count)[int(parts[0] or 0) : int(parts[1] or count)]
    if not places:
        raise InputError(f"--frames {text}: no frame is in this range (the sequence has {count}: 0:{count})")
    return places


def _thinned(sequence: Sequence, choice: FrameChoice, config: BEVFormerConfig) -> Sequence:
    if choice.every is not None:
        if choice.rate is not None:
            raise InputError("--rate and --every exclude each other: give one of them")
        return select(sequence, every(sequence.stamps, choice.every))
    if choice.rate == "all":
        return sequence
    thinning = thin(sequence.stamps, _rate_hz(choice.rate, config))
    return select(sequence, thinning.places, (thinning.note,) if thinning.note else ())


def _rate_hz(text: str | None, config: BEVFormerConfig) -> float:
    if text is None:
        return config.rate_hz
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = 0.0
    if not 0 < rate_hz < float("inf"):
        raise InputError(f'--rate "{text}": expected frames a second, as 2, or all')
    return rate_hz
