"""Agreement: how well boxes in space and the boxes of the witness in the images explain each other.

The score is the harmonic mean of two, times kept: the mean fit of the objects of the witness to their partners, and
that of our boxes to theirs. Without frames half a second apart, kept counts as 0.5.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from itertools import chain, pairwise
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from bevcli.errors import Finding
from bevcli.frame import Frame, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import SHOWN_SCORE, ObjectClass
from bevcli.geometry.transforms import Array
from bevcli.workshop.scores.evaluate import finite
from bevcli.workshop.scores.tables import Cell, Table
from bevcli.workshop.trust.sightings import GROUPS, NOTHING, PARTNER, Seen, Sightings, sightings

LEAST_S, MOST_S, MOST_M_S = 0.4, 1.5, 8.0  # between frames that are compared; error of a velocity that counts 0
MARGIN_M = 4.0  # a box so near to the end of the range may leave it
RESAMPLES, ENDS = 1000, (5, 95)  # of the seconds; percentiles of the interval
FEWEST_SECONDS, FEWEST_OBJECTS = 3, 20  # for an interval; for a score without a note
RINGS_M = (0.0, 10.0, 20.0, 30.0, 40.0, 60.0)
# What whoever reads a score may hold it against; docs/trust.md says on which drives.
USUAL = "labels 0.4 to 0.65, demo on rendered streets 0.15 to 0.35, photographs anywhere 0.1 to 0.3"

# A frame, boxes in the world frame, and what the witness sees; None or no camera where it does not look.
Held = tuple[Frame, Boxes3D, Seen | None]


@dataclass(frozen=True)
class FrameAgreement:
    """One frame: what is projected and seen in its images, within the range; and how many boxes are kept."""

    stamp: FrameStamp  # of the frame
    sightings: Sightings  # what is held against the other side, and what explains some of it
    # sums over the boxes: of scores that a frame half a second later keeps, and of scores; zeros without one
    kept: tuple[float, float] = (0.0, 0.0)
    is_looked_at: bool = False  # whether the witness saw the frame

    @property
    def differences(self) -> int:
        """Number of objects and of boxes without a partner."""
        return int((self.sightings["overlap"][self.sightings["counted"]] < PARTNER).sum())


@dataclass(frozen=True)
class Part:
    """Agreement of a group, a camera or a ring of distances."""

    found: float  # share of the witness's objects that a projected box explains; NaN without any
    objects: int  # number of these objects
    confirmed: float  # share of the boxes in view that the witness explains; NaN without any
    boxes: int  # number of these boxes


PART_COLUMNS = ("found", "of objects", "confirmed", "of boxes")


@dataclass(frozen=True)
class Shift:
    """The median offset in a camera from projected boxes to seen ones; NaN without pairs."""

    right_px: float  # pixels
    down_px: float  # pixels
    scale: float  # height of a seen box as a share of the projected one's
    pairs: int  # number of them


@dataclass(frozen=True)
class Agreement:
    """Agreement of the boxes of one or several drives with the witness."""

    score: float | None  # 0 to 1; None where the witness sees nothing
    # lower end of the interval of 90 % over resamplings of the seconds; None for fewer than three seconds
    low: float | None
    high: float | None  # its upper end
    kept: float  # share of the boxes that are where motion leads half a second later, by their scores; NaN unknown
    groups: Mapping[str, Part]  # "vehicles", "people" and "cycles" -> their agreement
    cameras: Mapping[str, Part]  # camera -> agreement of what it shows
    # "0-10 m" and so on -> agreement of what is at this distance from the vehicle, on flat ground
    distances: Mapping[str, Part]
    shifts: Mapping[str, Shift]  # camera -> offset between projected and seen boxes
    frames: tuple[int, int]  # number of frames, and how many of them the witness saw
    # the frames that differ most, with the number of objects and boxes without a partner
    worst: tuple[tuple[FrameStamp, int], ...] = ()
    findings: tuple[Finding, ...] = ()  # faults that show without labels
    notes: tuple[str, ...] = ()  # why there is no score, or why it says little

    def to_dict(self) -> dict[str, Any]:
        """For JSON; numbers that are not known are null."""
        worst = [{"frame": one.index, "scene": one.scene, "differences": count} for one, count in self.worst]
        content = {**asdict(self), "frames": self.frames[0], "looked_at": self.frames[1], "worst_frames": worst}
        return dict(finite({key: value for key, value in content.items() if key != "worst"}))

    @property
    def line(self) -> str:
        """The score on one line."""
        if self.score is None:
            return "agreement -"
        between = "" if self.low is None else f", between {self.low:.2f} and {self.high:.2f} over its seconds"
        return f"agreement {self.score:.2f}{between} (usual: {USUAL})"

    def tables(self, reference: "Agreement | None" = None) -> Iterator[Table]:
        """The numbers in tables. reference: of another drive, whose numbers stand beside."""
        sides, rows = [self] if reference is None else [self, reference], list[tuple[Cell, ...]]()
        for name, one in zip(("agreement", "reference"), sides, strict=False):
            shares = (np.nan if value is None else value for value in (one.score, one.low, one.high, one.kept))
            rows.append((name, *shares, *one.frames))
        names = ("score", "low", "high", "kept")
        yield Table("agreement", ("", *names, "frames", "looked at"), rows, dict.fromkeys(names, 2))
        for title in ("groups", "cameras", "distances"):
            parts, empty = [getattr(side, title) for side in sides], _part(NOTHING)
            rows = [(name, *chain(*(astuple(each.get(name, empty)) for each in parts))) for name in parts[0]]
            yield Table(title, (title, *PART_COLUMNS * len(sides)), rows, dict.fromkeys(PART_COLUMNS, 2))
        columns = ("shift of what is seen", "right px", "down px", "scale", "pairs")
        rows = [(name, *astuple(one)) for name, one in self.shifts.items()]
        yield Table("shifts", columns, rows, {"right px": 1, "down px": 1, "scale": 2})
        if self.worst:
            rows = [(f"frame {stamp.index}", count) for stamp, count in self.worst]
            yield Table("worst frames", ("worst frames", "objects and boxes without a partner"), rows)

    def table(self, reference: "Agreement | None" = None) -> str:
        """The score and its parts as text. reference: see `tables`."""
        notes = [f"note: {note}" for note in self.notes]
        notes += [f"{finding.severity}: {finding.line}" for finding in self.findings]
        return "\n\n".join(filter(None, [self.line, *map(str, self.tables(reference)), "\n".join(notes)]))


def compared(
    frames: Iterable[Held],
    classes: Mapping[str, ObjectClass],
    range_m: float,
    *,
    has_poses: bool,
) -> Iterator[FrameAgreement]:
    """Each frame's boxes held against what the witness sees, and against the boxes half a second later.

    classes: of the boxes. range_m: nothing beyond it is counted. has_poses: whether the drive has ego-motion.
    """
    waiting = deque[tuple[FrameAgreement, Boxes3D]]()
    for frame, boxes, seen in frames:
        shown = boxes.scored(SHOWN_SCORE)
        found = sightings(frame, shown, seen or {}, classes)
        found["counted"] &= found["distance"] < range_m
        while waiting:
            last, near = waiting[0]
            seconds = (frame.stamp.timestamp_ns - last.stamp.timestamp_ns) / 1e9
            is_same = last.stamp.scene == frame.stamp.scene
            if is_same and seconds < LEAST_S:
                break
            follows = has_poses and is_same and seconds <= MOST_S
            yield replace(last, kept=kept(near, shown, seconds)) if follows else last
            waiting.popleft()
        near = shown[np.linalg.norm(shown.centers - frame.world_from_ego.matrix[:3, 3], axis=1) < range_m - MARGIN_M]
        waiting.append((FrameAgreement(frame.stamp, found, is_looked_at=bool(seen)), near))
    yield from (last for last, _ in waiting)


def kept(boxes: Boxes3D, following: Boxes3D, seconds: float) -> tuple[float, float]:
    """Sums of the scores of boxes that a later frame keeps, and of all of them.

    A box that is off by v m/s from where its velocity leads counts 1 - v / 8. All boxes are in the world frame.
    """
    scores = np.ones(len(boxes)) if boxes.scores is None else boxes.scores
    there = boxes.centers[:, :2] + np.nan_to_num(boxes.velocities) * seconds
    off_m = np.linalg.norm(there[:, None] - following.centers[:, :2], axis=2)
    off_m[boxes.classes[:, None] != following.classes] = np.inf
    worth = np.clip(1 - off_m / seconds / MOST_M_S, 0, 1)
    rows, columns = linear_sum_assignment(worth, maximize=True)
    return float(scores[rows] @ worth[rows, columns]), float(scores.sum())


def agreement(frames: Sequence[FrameAgreement], worst: int = 0) -> Agreement:
    """The agreement of all frames. worst: length of the list of frames that differ most."""
    looked = [frame for frame in frames if frame.is_looked_at]
    found = np.concatenate([NOTHING, *(frame.sightings for frame in looked)])
    counted, pairs = found[found["counted"]], found[~found["is_seen"] & (found["overlap"] >= PARTNER)]
    objects, distances = int(counted["is_seen"].sum()), counted["distance"]
    seconds = np.array([_sums(frame) for frame in frames]).reshape(-1, 6)
    blocks = [f"{frame.stamp.scene} {frame.stamp.timestamp_ns // 10**9}" for frame in frames]
    names, block = np.unique(blocks, return_inverse=True)
    sums = np.zeros((len(names), 6))
    np.add.at(sums, block, seconds)
    total = sums.sum(axis=0)
    score = low = high = None
    if objects:
        score = float(_score(total))
        if len(sums) >= FEWEST_SECONDS:
            draws = np.random.default_rng(0).multinomial(len(sums), np.full(len(sums), 1 / len(sums)), RESAMPLES)
            low, high = (float(end) for end in np.percentile(_score(draws @ sums), ENDS))
    order = sorted(((one.stamp, one.differences) for one in looked), key=lambda pair: -pair[1])[:worst]
    cameras = dict.fromkeys(counted["camera"])
    rings = {f"{a:g}-{b:g} m": _part(counted[(a <= distances) & (distances < b)]) for a, b in pairwise(RINGS_M)}
    return Agreement(
        *(score, low, high, float(total[4] / total[5]) if total[5] else np.nan),
        {name: _part(counted[counted["group"] == index]) for index, name in enumerate(GROUPS)},
        {name: _part(counted[counted["camera"] == name]) for name in cameras},
        {name: part for name, part in rings.items() if part.objects or part.boxes},
        {name: _shift(pairs[pairs["camera"] == name]) for name in cameras},
        (len(frames), len(looked)),
        tuple(pair for pair in order if pair[1]),
        notes=tuple(_notes(objects)),
    )


def _notes(objects: int) -> Iterator[str]:
    if not objects:
        yield "the witness sees no vehicle, person or cycle near the vehicle: night, fog or an empty road tell nothing"
    elif objects < FEWEST_OBJECTS:
        yield f"the witness sees {objects} objects only (expected {FEWEST_OBJECTS} or more): the score says little"


def _sums(frame: FrameAgreement) -> tuple[float, ...]:
    """Of the objects and of the boxes the fits and their number, then `kept`."""
    counted = frame.sightings[frame.sightings["counted"]]
    sides = (counted["fit"][counted["is_seen"] == is_seen] for is_seen in (True, False))
    return (*(value for each in sides for value in (float(each.sum()), len(each))), *frame.kept)


def _score(sums: Array) -> Array:
    """(...,) of sums (..., 6)."""
    found, confirmed, same = (sums[..., i] / np.maximum(sums[..., i + 1], 1e-9) for i in (0, 2, 4))
    same = np.where(sums[..., 5] > 0, same, 0.5)
    return np.asarray(2 * found * confirmed / np.maximum(found + confirmed, 1e-9) * same)


def _part(counted: Sightings) -> Part:
    sides = (counted["overlap"][counted["is_seen"] == is_seen] >= PARTNER for is_seen in (True, False))
    (found, objects), (confirmed, boxes) = ((float(one.mean()) if len(one) else np.nan, len(one)) for one in sides)
    return Part(found, objects, confirmed, boxes)


def _shift(pairs: Sightings) -> Shift:
    if not len(pairs):
        return Shift(np.nan, np.nan, np.nan, 0)
    right, down = np.median((pairs["partner"] - pairs["corners"]).reshape(-1, 2, 2).mean(axis=1), axis=0)
    own, seen = ((side[:, 3] - side[:, 1]) for side in (pairs["corners"], pairs["partner"]))
    return Shift(float(right), float(down), float(np.median(seen / own)), len(pairs))
