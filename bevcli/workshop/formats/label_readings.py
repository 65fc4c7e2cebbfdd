"""The contents of a file of labels, and what they are, decided by the boxes: sizes of classes, the road, the motion.

What stands stays where it is in the world, boxes stand on the road, and vehicles drive ahead.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, permutations, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, inverse, wrap_angle
from bevcli.sequences.files.readings import Reading, differing, question

# Usual length, width and height by words in the names of classes, metres; None for classes of other sizes.
SIZES = {
    ("bus", "coach"): (11.0, 2.9, 3.4), ("trailer",): (12.0, 2.9, 3.9), ("truck", "lorry"): (7.0, 2.5, 3.0),
    ("pedestrian", "person", "walker"): (0.7, 0.7, 1.75), ("motorcycle", "motorbike"): (2.1, 0.8, 1.4),
    ("bicycle", "cyclist", "bike"): (1.75, 0.6, 1.4), ("construction", "barrier", "cone"): None,
    ("car", "van", "taxi", "suv", "vehicle"): (4.6, 1.9, 1.7),
}  # fmt: skip
SIDES = {"l": "length", "w": "width", "h": "height"}
FRAMES = ("ego", "world", "bev")
USUAL = {  # what a file holds, as options and their values; the same as in bevcli
    "labels_frame": "ego", "labels_sides": "lwh", "labels_z": "center", "labels_yaw": "x", "labels_yaw_unit": "radians",
}  # fmt: skip
YAWS = {  # -> in words; sign and offset that make it counter-clockwise from x, radians
    "x": ("counter-clockwise from x", 1, 0.0), "y": ("counter-clockwise from y", 1, np.pi / 2),
    "clockwise": ("clockwise from x", -1, 0.0), "compass": ("clockwise from y", -1, np.pi / 2),
    "kitti": ("clockwise from -y, as rotation_y of KITTI", -1, -np.pi / 2),
}  # fmt: skip
SOUND_PERCENT, SOUND_M, SOUND_DEG = 22.0, 0.35, 15.0  # largest residuals of an unusual reading that is taken
UNFIT = 2.5  # times these: the usual one is refused
CLEAR, CLEAR_SOUND = 2.0, 0.3  # factor, and addition as a share of these, by which all other residuals are larger
FEWEST = 5  # boxes that tell
LARGEST_RADIANS, LARGEST_DEGREES = 6.5, 361.0  # a little more than a turn
LONGEST_M, USUAL_M = 300.0, 30.0  # of the longest box, and of the median one; a train has 200 m
IN_CENTIMETRES = 1000.0  # a smaller median is that of boxes in centimetres
LONG_M = 1.7  # of classes that drive ahead
NEAR_M, FAR_M = 40.0, 300.0  # of boxes that tell the road; of boxes that are not around the vehicle
WAY_M, DRIVEN_M = 1.0, (0.5, 8.0)  # between two frames: of the vehicle, of driving objects
STANDING_SHARE = 30  # percentage of the boxes that stand
ALLOWED_M = 0.5  # by which standing boxes move, and by which boxes leave the plane of the road


@dataclass(frozen=True)
class LabelledFrame:
    """The boxes of one frame."""

    index: int | None  # of the frame; None if the file has times only
    timestamp_ns: int | None  # of the frame; None if the file has indices only
    boxes: Boxes3D  # in the frame of reference of the file


@dataclass(frozen=True)
class Labels:
    """The contents of a file of labels.

    Attributes:
        states: options that state what the file holds, and their values, such as {"labels_frame": "world"}; the boxes
            decide on others.
        frames: in the order of the file.
        lists_empty: frames without boxes are in the file, too. If not, a frame of the drive that the file does not
            have may be empty or not labelled.
        notes: what was assumed, for the user.
    """

    states: Mapping[str, str]
    frames: tuple[LabelledFrame, ...]
    lists_empty: bool
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class LabelReading(Reading):
    """What a table of labels may hold, and how far its boxes are from that; infinite where they do not tell."""

    residual: float = np.inf
    is_sure: bool = True  # False where the boxes of another one may look the same

    def words(self, names: Sequence[str] = ()) -> str:
        """It in words."""
        words = {
            "labels_sides": lambda sides: f"sides in the order {', '.join(SIDES[letter] for letter in sides)}",
            "labels_frame": "boxes in the {} frame".format,
            "labels_z": "z of the {}".format,
            "labels_yaw": lambda yaw: f"yaws {YAWS[yaw][0]}",
            "labels_yaw_unit": "yaws in {}".format,
        }
        return ", ".join(words[name](value) for name, value in self.states.items() if not names or name in names)


@dataclass(frozen=True)
class PlacedBoxes:
    """The boxes of one frame of the drive, and where its vehicle is."""

    scene: str  # of the frame
    boxes: Boxes3D  # as the file has them
    world_from: Mapping[str, Array]  # (4, 4) by frame of reference

    @property
    def ego(self) -> Array:
        """(4, 4) world_from_ego."""
        return self.world_from["ego"]

    def read_as(self, states: Mapping[str, str]) -> Boxes3D:
        """The boxes in the world frame, as a reading with these states has them."""
        return read_as(states, self.boxes).transformed(self.world_from[states["labels_frame"]])


def read_as(states: Mapping[str, str], boxes: Boxes3D) -> Boxes3D:
    """The boxes of a file with sizes, centres and yaws as bevcli has them, in the file's frame of reference."""
    states = {**USUAL, **states}
    sizes = boxes.sizes_lwh[:, [states["labels_sides"].index(letter) for letter in "lwh"]]
    half = sizes * (0, 0, 0.5 if states["labels_z"] == "bottom" else 0)
    _, sign, offset = YAWS[states["labels_yaw"]]
    yaws = np.radians(boxes.yaws) if states["labels_yaw_unit"] == "degrees" else boxes.yaws
    return replace(boxes, sizes_lwh=sizes, centers=boxes.centers + half, yaws=wrap_angle(sign * yaws + offset))


def check_labels(path: Path, labels: Labels) -> None:
    """Raise InputError for impossible boxes."""
    boxes = Boxes3D.concatenate([labelled.boxes for labelled in labels.frames])
    if not len(boxes):
        return
    longest = boxes.sizes_lwh.max(axis=1)
    if longest.max() > LONGEST_M or np.median(longest) > USUAL_M:
        unit = "centimetres" if np.median(longest) < IN_CENTIMETRES else "millimetres"
        raise InputError(
            f"{path}: has boxes of {longest.max():.0f} m, the median is {np.median(longest):.0f} m (in {unit}?): "
            "convert x, y, z, length, width and height to metres"
        )
    largest = float(np.abs(boxes.yaws).max())
    if largest > LARGEST_DEGREES:
        raise InputError(f"{path}: has a yaw of {largest:g} (expected radians, or degrees up to 360): correct it")


def decide(
    path: Path, frames: Sequence[PlacedBoxes], stated: Mapping[str, str]
) -> tuple[Mapping[str, str], tuple[str, ...]]:
    """What a table holds, by its boxes, as options and their values; and notes on what is not usual.

    Args:
        path: the file.
        frames: of the drive, in order; those with boxes.
        stated: what the user and the file state, in the same way.

    Raises InputError where the boxes fit no reading, or several: it names the options that decide.
    """
    states, notes = dict[str, str](), []
    for sound, unit, ask in (
        (SOUND_PERCENT, "% off usual sizes", _sides),
        (SOUND_M, "m", _places),
        (SOUND_DEG, "degrees", _yaws),
    ):
        chosen, note = _chosen(path, list(ask(frames, states)), stated, sound, unit)
        states |= chosen
        notes += [note] if note else []
    if states["labels_yaw_unit"] == "degrees" and "labels_yaw_unit" not in stated:
        notes.append(f"the yaws, of up to {_largest_yaw(frames):.0f}, are taken to be in degrees")
    if states["labels_frame"] == "ego" and "labels_frame" not in stated:
        notes.append('there is no column frame_of_reference: the boxes are taken to be in the "ego" frame')
    return states, tuple(notes)


def _chosen(
    path: Path, readings: Sequence[LabelReading], stated: Mapping[str, str], sound: float, unit: str
) -> tuple[Mapping[str, str], str]:
    """The states of the reading that is stated, usual or clearly better than all others, and a note on it."""
    possible = [
        each for each in readings if all(stated.get(name, value) == value for name, value in each.states.items())
    ]
    usual, best = possible[0], min(possible, key=lambda each: each.residual)
    if not np.isfinite([each.residual for each in readings]).any():
        return usual.states, ""
    limit = CLEAR * best.residual + CLEAR_SOUND * sound
    left = [each for each in possible if each.residual <= limit]
    if usual in left and usual.residual <= UNFIT * sound:
        return usual.states, ""
    fitting = min(readings, key=lambda each: each.residual)
    names = differing([usual, *left, fitting])
    by = f"{usual.residual:.1f} {unit}" if np.isfinite(usual.residual) else "far away"
    off = f"{usual.words(names)}: {by}"
    if len(possible) == 1 or set(usual.states) <= set(stated):
        fits = f"; `{fitting.flags(names)}` fits ({fitting.residual:.1f} {unit})" if fitting.residual <= sound else ""
        return usual.states, f"what is stated does not fit the boxes ({off}){fits}"
    if best.residual > sound:
        raise InputError(
            f"{path}: the boxes fit no reading ({usual.words()}: {by}): correct the file, or "
            f"pass `{usual.flags(list(usual.states))}` to read it so"
        )
    left = [each for each in left if each.rank == min(one.rank for one in left)]
    if len(left) > 1 or not left[0].is_sure:
        raise question(path, f"the boxes do not tell which it is ({off})", [*left, usual])
    return left[0].states, f"{left[0].words(names)} (the boxes: {left[0].residual:.1f} {unit}; {off})"


def _sides(frames: Sequence[PlacedBoxes], _: Mapping[str, str]) -> Iterator[LabelReading]:
    """Orders of the sides, by the mean difference to the usual sizes of the classes, percent."""
    boxes = Boxes3D.concatenate(frame.boxes for frame in frames)
    usual = np.array([_usual_size(name) or (np.nan,) * 3 for name in boxes.classes]).reshape(-1, 3)
    lengths = np.unique(usual[np.isfinite(usual[:, 0]), 0])  # one of each class
    readings = []
    for sides in map("".join, permutations("lwh")):
        off = np.abs(np.log(read_as({"labels_sides": sides}, boxes).sizes_lwh / usual)).mean(axis=1)
        by_class = [off[usual[:, 0] == length].mean() for length in lengths]
        residual = 100 * float(np.expm1(np.mean(by_class))) if np.isfinite(off).sum() >= FEWEST else np.inf
        rank = sum(one != other for one, other in zip(sides, "lwh", strict=True))
        readings.append(LabelReading({"labels_sides": sides}, residual, rank=rank))
    tell = min(each.residual for each in readings) <= SOUND_PERCENT  # names of classes may be others' words
    yield from readings if tell else (replace(each, residual=np.inf) for each in readings)


def _usual_size(name: str) -> tuple[float, float, float] | None:
    lower = str(name).lower()
    return next((size for words, size in SIZES.items() if any(word in lower for word in words)), None)


def _places(frames: Sequence[PlacedBoxes], states: Mapping[str, str]) -> Iterator[LabelReading]:
    """Frames of reference and meanings of z, by the road, and by what stands if the vehicle moves."""
    for frame, z in product(FRAMES, ("center", "bottom")):
        reading = {"labels_frame": frame, "labels_z": z}
        world = [each.read_as({**states, **reading}) for each in frames]
        around = Boxes3D.concatenate(
            boxes.transformed(inverse(each.ego)) for boxes, each in zip(world, frames, strict=True)
        )
        distances = np.linalg.norm(around.centers[:, :2], axis=1)
        bottoms = (around.centers[:, 2] - around.sizes_lwh[:, 2] / 2)[distances < NEAR_M]
        ways = [
            np.linalg.norm(after.centers - before.centers, axis=1)
            for way, before, after in _successive(frames, world)
            if way >= WAY_M
        ]
        residual, moved = np.inf, np.concatenate([*ways, np.zeros(0)])
        if len(bottoms) >= FEWEST and np.median(distances) < FAR_M:
            height = float(np.median(bottoms))
            uneven_m = float(np.median(np.abs(bottoms - height)))
            moved_m = float(np.percentile(moved, STANDING_SHARE)) if len(moved) >= FEWEST else 0.0
            residual = abs(height) + max(uneven_m - ALLOWED_M, 0.0) + max(moved_m - ALLOWED_M, 0.0)
        is_sure = frame != "bev" or len(moved) >= FEWEST  # a frame with other axes may look the same
        yield LabelReading(reading, residual, is_sure, rank=(frame != FRAMES[0]) + (z == "bottom"))


def _yaws(frames: Sequence[PlacedBoxes], states: Mapping[str, str]) -> Iterator[LabelReading]:
    """Meanings of yaw: vehicles drive ahead."""
    units = ["degrees", "radians"] if _largest_yaw(frames) > LARGEST_RADIANS else ["radians", "degrees"]
    for unit, name in product(units, YAWS):
        reading = {"labels_yaw": name, "labels_yaw_unit": unit}
        off = []
        for _, before, after in _successive(frames, [each.read_as({**states, **reading}) for each in frames]):
            x, y, _ = (after.centers - before.centers).T
            is_long = np.array([(_usual_size(each) or (0.0,))[0] >= LONG_M for each in before.classes], dtype=bool)
            drives = is_long & (np.hypot(x, y) >= DRIVEN_M[0]) & (np.hypot(x, y) <= DRIVEN_M[1])
            off.append(np.abs(wrap_angle(np.arctan2(y, x) - before.yaws))[drives])
        angles = np.concatenate([*off, np.zeros(0)])
        residual = float(np.degrees(np.median(angles))) if len(angles) >= FEWEST else np.inf
        yield LabelReading(reading, residual, rank=(unit != units[0]) + (name != "x"))


def _largest_yaw(frames: Sequence[PlacedBoxes]) -> float:
    return max((float(np.abs(each.boxes.yaws).max()) for each in frames if len(each.boxes)), default=0.0)


def _successive(frames: Sequence[PlacedBoxes], world: Sequence[Boxes3D]) -> Iterator[tuple[float, Boxes3D, Boxes3D]]:
    """The way of the vehicle between two frames, metres; the boxes of the first, and what they are in the second.

    That is the box of the same track; without tracks, the nearest one of the same class.
    """
    for (one, before), (other, after) in pairwise(zip(frames, world, strict=True)):
        if one.scene == other.scene and len(after):
            names, later = (_tracks(each) for each in (before, after))
            apart = np.linalg.norm(before.centers[:, None, :2] - after.centers[None, :, :2], axis=-1)
            apart[names[:, None] != later[None]] = np.inf
            found = np.isfinite(apart.min(axis=1))
            way = float(np.linalg.norm(one.ego[:3, 3] - other.ego[:3, 3]))
            yield way, before[found], after[apart.argmin(axis=1)[found]]


def _tracks(boxes: Boxes3D) -> NDArray[np.str_]:
    """The track of each box, or its class where it has none."""
    return boxes.classes if boxes.instances is None else np.where(boxes.instances == "", boxes.classes, boxes.instances)
