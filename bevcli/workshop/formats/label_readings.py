"""The contents of a file of labels, and what they are, decided by the boxes and by the images.

What stands stays where it is in the world, boxes stand on the road, and vehicles drive ahead. Of the readings that this
leaves, one is believed if its boxes lie on the objects that a detector sees in the images, and those of others do not.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, permutations, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, inverse, wrap_angle
from bevcli.sequences.files.readings import MOST_NAMED, Reading, differing, question

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
FEWEST = 5  # boxes that tell the road and the yaws
SAME, COMPARED = np.array([0.02] * 6 + [np.radians(1)]), 200  # metres and radians; boxes that are compared
LARGEST_RADIANS, LARGEST_DEGREES = 6.5, 361.0  # a little more than a turn
LONGEST_M, USUAL_M = 300.0, 30.0  # of the longest box, and of the median one; a train has 200 m
IN_CENTIMETRES = 1000.0  # a smaller median is that of boxes in centimetres
LONG_M = 1.7  # of classes that drive ahead
NEAR_M, FAR_M = 40.0, 300.0  # of boxes that tell the road; of boxes that are not around the vehicle
TURNED_RAD, BY_CHANCE = 0.5, 4.6  # yaws that are not near 0; Rayleigh's statistic that chance exceeds once in a hundred
ASIDE = "neither boxes nor images tell the bev frame from others on the vehicle: pass `--labels-frame bev` if it is"
WAY_M, DRIVEN_M = 1.0, (0.5, 8.0)  # between two frames: of the vehicle, of driving objects
RUNS, RUN = 5, 8  # of frames in which motion is looked for
STANDING_SHARE = 30  # percentage of the boxes that stand
ALLOWED_M = 0.5  # by which standing boxes move, and by which boxes leave the plane of the road


@dataclass(frozen=True)
class LabelledFrame:
    """The boxes of one frame."""

    index: int | None  # of the frame; None if the file has times only
    timestamp_ns: int | None  # of the frame; None if the file has indices only
    boxes: Boxes3D  # in the frame of reference of the file
    # the same, as those of each camera that they may be of
    by_camera: Mapping[str, Boxes3D] = field(default_factory=dict)


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

    @property
    def cameras(self) -> tuple[str, ...]:
        """Those that the boxes may be of."""
        return tuple(self.frames[0].by_camera) if self.frames else ()


@dataclass(frozen=True)
class LabelReading(Reading):
    """What a table of labels may hold, and how far its boxes are from that."""

    residual: float = np.inf  # of what was looked at last; infinite where it does not tell
    doubt: str = ""  # why it is not believed unless the images show it
    notes: tuple[str, ...] = ()  # what shows it

    def words(self, names: Sequence[str] = ()) -> str:
        """It in words."""
        words = {
            "labels_sides": lambda sides: f"sides in the order {', '.join(SIDES[letter] for letter in sides)}",
            "labels_frame": "boxes in the {} frame".format,
            "labels_z": "z of the {}".format,
            "labels_yaw": lambda yaw: f"yaws {YAWS[yaw][0]}",
            "labels_yaw_unit": "yaws in {}".format,
            "labels_camera": "boxes in the frame of {}".format,
        }
        return ", ".join(words[name](value) for name, value in self.states.items() if not names or name in names)

    def with_more(self, states: Mapping[str, str], residual: float, rank: int, doubt: str = "") -> "LabelReading":
        """It, with further states."""
        return LabelReading({**self.states, **states}, residual, self.doubt or doubt, self.notes, rank=self.rank + rank)


@dataclass(frozen=True)
class PlacedBoxes:
    """The boxes of one frame of the drive, and where its vehicle is."""

    scene: str  # of the frame
    boxes: Boxes3D  # as the file has them
    world_from: Mapping[str, Array]  # (4, 4) by frame of reference
    by_camera: Mapping[str, Boxes3D] = field(default_factory=dict)

    @property
    def ego(self) -> Array:
        """(4, 4) world_from_ego."""
        return self.world_from["ego"]

    def read_as(self, states: Mapping[str, str]) -> Boxes3D:
        """The boxes in the world frame, as a reading with these states has them."""
        boxes = self.by_camera.get(states.get("labels_camera", ""), self.boxes)
        return read_as(states, boxes).transformed(self.world_from[states["labels_frame"]])


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


def fitting(path: Path, frames: Sequence[PlacedBoxes], stated: Mapping[str, str]) -> list[LabelReading]:
    """The readings of a table that its boxes leave, the usual one first. Of those that mean the same, the first.

    Args:
        path: the file.
        frames: of the drive, in order; those with boxes.
        stated: what the user and the file state, as options and their values.

    Raises InputError where the boxes fit no reading: it names the options that decide.
    """
    left = [LabelReading({})]
    for names, sound, unit, ask in (
        (("labels_sides",), SOUND_PERCENT, "% off usual shapes", _sides),
        (("labels_frame", "labels_z"), SOUND_M, "m", _places),
        (("labels_yaw", "labels_yaw_unit"), SOUND_DEG, "degrees", _yaws),
    ):
        readings = [reading for before in left for reading in ask(frames, before)]
        left = _left(path, readings, names, stated, sound, unit)
    if "labels_frame" in stated:
        left = [replace(each, doubt="" if each.doubt == ASIDE else each.doubt) for each in left]
    return _unlike(frames, sorted(left, key=lambda each: each.rank))


def _left(
    path: Path, readings: Sequence[LabelReading], names: Sequence[str], stated: Mapping[str, str], sound: float,
    unit: str,
) -> list[LabelReading]:  # fmt: skip
    """The readings that differ in `names`, without those that are not stated and those that are clearly worse."""
    possible = [
        each for each in readings if all(stated.get(name, value) == value for name, value in each.states.items())
    ]
    usual, best, fitting = possible[0], *(min(some, key=lambda each: each.residual) for some in (possible, readings))
    if not np.isfinite(fitting.residual):  # the boxes do not tell
        return possible
    left = [each for each in possible if each.residual <= CLEAR * best.residual + CLEAR_SOUND * sound]
    by = f"{usual.residual:.1f} {unit}" if np.isfinite(usual.residual) else "far away"
    if set(names) <= set(stated):
        near = min(UNFIT * sound, CLEAR * fitting.residual + CLEAR_SOUND * sound)
        if best.residual <= max(sound, near):
            return left
        differ = differing([usual, fitting])
        fits = f"; `{fitting.flags(differ)}` fits ({fitting.residual:.1f} {unit})" if fitting.residual <= sound else ""
        note = f"what is stated does not fit the boxes ({usual.words(differ or names)}: {by}){fits}"
        return [replace(each, notes=(*each.notes, note)) for each in possible]
    if usual in left and usual.residual <= UNFIT * sound:
        return left
    if best.residual > sound:
        why = f"the boxes fit no reading ({usual.words(names)}: {by}), and the images show none"
        doubt = f"{why}: correct the file, or pass `{usual.flags(names)}` to read it so"
        return [replace(each, doubt=each.doubt or doubt) for each in possible]
    differ = [name for name in differing([usual, *left]) if name in names]
    off = f"{usual.words(differ)}: {by}"
    notes = [f"{each.words(differ)} (the boxes: {each.residual:.1f} {unit}; {off})" for each in left]
    return [replace(each, notes=(*each.notes, note)) for each, note in zip(left, notes, strict=True)]


def _unlike(frames: Sequence[PlacedBoxes], readings: Sequence[LabelReading]) -> list[LabelReading]:
    """The readings, without those that put all boxes where an earlier one has them."""
    frames, kept, places = _some(frames), list[LabelReading](), np.zeros((0, COMPARED, 7))
    for reading in readings if len(readings) > 1 else ():
        boxes = Boxes3D.concatenate(frame.read_as(reading.states) for frame in frames)
        boxes = boxes[np.linspace(0, len(boxes) - 1, COMPARED).astype(int)] if len(boxes) else boxes
        place = np.resize(np.concatenate([boxes.centers, boxes.sizes_lwh, boxes.yaws[:, None]], axis=1), (COMPARED, 7))
        off = np.abs(places - place)
        off[..., 6] = np.abs(wrap_angle(off[..., 6]))
        if not (off <= SAME).all(axis=(1, 2)).any():
            kept, places = [*kept, reading], np.concatenate([places, place[None]])
    return kept or list(readings)


def decided(
    path: Path, frames: Sequence[PlacedBoxes], left: Sequence[LabelReading], stated: Mapping[str, str]
) -> tuple[Mapping[str, str], tuple[str, ...]]:
    """What a table holds, as options and their values; and notes on what is not stated. left: at least one reading.

    Raises InputError where several readings are left: it names the options that decide.
    """
    chosen = left[0]
    if chosen.doubt:
        raise InputError(f"{path}: {chosen.doubt}")
    if len(left) > 1:
        names = differing(left)
        why = "neither boxes nor images tell which it is"
        if len(left) <= MOST_NAMED or len(names) == 1:
            raise question(path, why, left)
        options = ", ".join(f"`{name}` (`--{name.replace('_', '-')}`)" for name in names)
        raise InputError(
            f"{path}: has {len(left)} readings, and {why}: state what it holds by {options}; it is "
            f"`{LabelReading(USUAL).flags(names)}` where it is as documented"
        )
    states, notes = chosen.states, list(chosen.notes)
    if "labels_camera" in states:
        sees = f"the boxes are those that {states['labels_camera']} sees, in its frame"
        notes.append(f"{sees} (`labels_camera` (`--labels-camera`)); others have no labels")
    if states["labels_yaw_unit"] == "degrees" and "labels_yaw_unit" not in stated:
        notes.append(f"the yaws, of up to {_largest_yaw(frames):.0f}, are taken to be in degrees")
    if states["labels_frame"] == "ego" and "labels_frame" not in stated:
        notes.append('there is no column frame_of_reference: the boxes are taken to be in the "ego" frame')
    return states, tuple(notes)


def _sides(frames: Sequence[PlacedBoxes], before: LabelReading) -> Iterator[LabelReading]:
    """Orders of the sides, by the mean difference to the usual shapes of the classes, percent."""
    boxes = Boxes3D.concatenate(frame.boxes for frame in frames)
    usual = np.array([_usual_size(name) or (np.nan,) * 3 for name in boxes.classes]).reshape(-1, 3)
    lengths = np.unique(usual[np.isfinite(usual[:, 0]), 0])  # one of each class
    readings = []
    for sides in map("".join, permutations("lwh")):
        scales = np.log(read_as({"labels_sides": sides}, boxes).sizes_lwh / usual)
        off = np.abs(scales - scales.mean(axis=1, keepdims=True)).mean(axis=1)
        by_class = [off[usual[:, 0] == length].mean() for length in lengths]
        residual = 100 * float(np.expm1(np.mean(by_class))) if len(lengths) else np.inf
        rank = sum(one != other for one, other in zip(sides, "lwh", strict=True))
        readings.append(before.with_more({"labels_sides": sides}, residual, rank))
    tell = min(each.residual for each in readings) <= SOUND_PERCENT  # names of classes may be others' words
    yield from readings if tell else (replace(each, residual=np.inf) for each in readings)


def _usual_size(name: str) -> tuple[float, float, float] | None:
    lower = str(name).lower()
    return next((size for words, size in SIZES.items() if any(word in lower for word in words)), None)


def _places(frames: Sequence[PlacedBoxes], before: LabelReading) -> Iterator[LabelReading]:
    """Frames of reference and meanings of z, by the road, and by what stands if the vehicle moves."""
    frames = _some(frames)
    for frame, z in product(FRAMES, ("center", "bottom")):
        reading = {"labels_frame": frame, "labels_z": z}
        world = [each.read_as({**before.states, **reading}) for each in frames]
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
        doubt = "" if frame != "bev" or len(moved) >= FEWEST else ASIDE
        yield before.with_more(reading, residual, (frame != FRAMES[0]) + (z == "bottom"), doubt)


def _yaws(frames: Sequence[PlacedBoxes], before: LabelReading) -> Iterator[LabelReading]:
    """Meanings of yaw: vehicles drive ahead."""
    units = ["degrees", "radians"] if _largest_yaw(frames) > LARGEST_RADIANS else ["radians", "degrees"]
    shown = units[:1] if _are_at_right_angles(frames, units[0]) else units
    frames = _some(frames)
    for unit, name in product(units, YAWS):
        reading = {"labels_yaw": name, "labels_yaw_unit": unit}
        off = []
        for _, earlier, later in _successive(frames, [each.read_as({**before.states, **reading}) for each in frames]):
            x, y, _ = (later.centers - earlier.centers).T
            is_long = np.array([(_usual_size(each) or (0.0,))[0] >= LONG_M for each in earlier.classes], dtype=bool)
            drives = is_long & (np.hypot(x, y) >= DRIVEN_M[0]) & (np.hypot(x, y) <= DRIVEN_M[1])
            off.append(np.abs(wrap_angle(np.arctan2(y, x) - earlier.yaws))[drives])
        angles = np.concatenate([*off, np.zeros(0)])
        residual = float(np.degrees(np.median(angles))) if len(angles) >= FEWEST else np.inf
        if unit in shown:
            yield before.with_more(reading, residual, (unit != units[0]) + (name != "x"))


def _are_at_right_angles(frames: Sequence[PlacedBoxes], unit: str) -> bool:
    """True where vehicles are parallel and at right angles to each other, with yaws in this unit, and not by chance."""
    boxes = Boxes3D.concatenate(frame.boxes for frame in frames)
    yaws = boxes.yaws[[(_usual_size(each) or (0.0,))[0] >= LONG_M for each in boxes.classes]]
    yaws = wrap_angle(np.radians(yaws) if unit == "degrees" else yaws)
    turned = yaws[np.abs(yaws) > TURNED_RAD]
    return len(turned) >= FEWEST and bool(np.square(np.abs(np.exp(4j * turned).mean())) * len(turned) > BY_CHANCE)


def _some(frames: Sequence[PlacedBoxes]) -> Sequence[PlacedBoxes]:
    """Those of a short drive, or runs of successive frames all over a long one."""
    if len(frames) <= RUNS * RUN:
        return frames
    starts = np.linspace(0, len(frames) - RUN, RUNS).astype(int).tolist()
    return [frame for start in starts for frame in frames[start : start + RUN]]


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
