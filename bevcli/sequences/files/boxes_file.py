"""ground_truth.json and predictions.json ("bevcli-boxes/1"): boxes by frame, read whole, written frame by frame.

ClassNames: the class names of data sets, compared without case and renamed by a class map.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import OPTIONAL_COLUMNS, Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ClassSettings, ObjectClass, object_classes
from bevcli.geometry.transforms import Array, Pose, inverse
from bevcli.parsing.documents import TOML_BYTES, parse_toml, typed, without_garbage_collection
from bevcli.parsing.files import read_text
from bevcli.sequences.files.incremental_json import IncrementalJson, read_frames, stamp_from_json, stamp_to_json
from bevcli.sequences.files.json_fields import pose_from_json, pose_to_json

FUTURE_DECIMALS = 3  # millimetres
_Mode = Annotated[list[tuple[float, float] | None], Meta(min_length=1)]
# Types of the optional members, by `Column.values`. The range of shares is checked by column.
_TYPES: dict[str, Any] = {
    "score": Annotated[float, Meta(ge=0, le=1)] | UnsetType,
    "share": float | UnsetType | None,
    "text": str | UnsetType | None,
    "flag": bool | UnsetType,
    "count": Annotated[int, Meta(ge=0)] | UnsetType,
}
FORMAT = "bevcli-boxes/1"
FRAMES_OF_REFERENCE = ("world", "ego", "bev")
_FILE_KEYS = ("format", "frame_of_reference", "ego_from_bev", "frames")
_FRAME_KEYS = ("frame", "scene", "timestamp_ns", "world_from_ego", "boxes")


class ClassNames:
    """Maps the class names of a file to known classes.

    A name that differs from a known class only in case becomes that class. Other names stay as they are.

    renames: names of the file (in any case) -> known classes. classes: the known ones. Raises InputError for a target
    that is not known.
    """

    def __init__(
        self, renames: Mapping[str, str] | None = None, classes: Iterable[str] = tuple(NUSCENES_CLASSES)
    ) -> None:
        self.known = tuple(classes)
        self._by_name: dict[str, str] = {name: name for name in self.known}
        self._by_lower_case = {name.lower(): name for name in reversed(self.known)}
        targets = dict(self._by_lower_case)
        for name, target in (renames or {}).items():
            if target.lower() not in targets:
                raise InputError(
                    f'`class_map` (`--class-map`) {name}={target}: "{target}" is not a class (expected one of '
                    f"{', '.join(self.known)})"
                )
            exact = target if target in self.known else targets[target.lower()]
            self._by_lower_case[name.lower()] = self._by_name[name] = exact

    def __getitem__(self, name: str) -> str:
        exact = self._by_name.get(name)
        if exact is None:
            exact = self._by_name[name] = self._by_lower_case.get(name.lower(), name)
        return exact

    def renamed(self, boxes: Boxes3D) -> Boxes3D:
        """The boxes with the names of known classes."""
        names = {name: self[name] for name in np.unique(boxes.classes).tolist()}
        if all(name == new for name, new in names.items()):
            return boxes
        return replace(boxes, classes=np.array([names[name] for name in boxes.classes.tolist()]))

    def counts(self, counts: Mapping[str, int]) -> Counter[str]:
        """Numbers of boxes by the file's names -> the same by the names of known classes."""
        renamed: Counter[str] = Counter()
        for name, count in counts.items():
            renamed[self[name]] += count
        return renamed

    def note(self, counts: Mapping[str, int], location: str, use: str = "scored") -> tuple[str, ...]:
        """A note about boxes whose class is not known, if there are any.

        counts: number of boxes by the file's names. where: the file or the side that has them. use: what is not done
        with them.
        """
        others = {name: count for name, count in counts.items() if self[name] not in self.known}
        if not others:
            return ()
        named = ", ".join(f"{name} ({count})" for name, count in sorted(others.items()))
        return (
            f"{location}: {sum(others.values())} boxes have other classes and are not {use}: {named} "
            f'(`class_map` (`--class-map`) "{min(others)}={self.known[0]}" renames a class)',
        )


def read_class_map(path: Path) -> dict[str, str]:
    """A class map in TOML, one `"Name in the file" = "class"` a line. Raises InputError if it is not one."""
    class_map = parse_toml(read_text(path, TOML_BYTES), path)
    for name, target in class_map.items():
        if not isinstance(target, str):
            raise InputError(f'{path}: {name}: expected the name of a class, such as "truck", found {target!r:.40}')
    return class_map


def count_classes(frames: Iterable[Boxes3D]) -> Counter[str]:
    """Number of boxes by class."""
    return Counter(name for boxes in frames for name in boxes.classes.tolist())


_OWN_NAMES = ClassNames()


class _FixedMembers(Struct, forbid_unknown_fields=True):
    """A box in JSON without its optional columns. futures: M modes of T steps, each x and y; null if unknown."""

    name: Annotated[str, Meta(min_length=1)] = msgspec.field(name="class")
    center: tuple[float, float, float]
    size_lwh: tuple[float, float, float]
    yaw: float
    velocity: tuple[float | None, float | None] | None = None
    futures: Annotated[list[_Mode], Meta(min_length=1)] | None = None
    future_times_s: list[float] = []
    future_scores: list[float] | None = None


_Box: Any = msgspec.defstruct(
    "_Box",
    [(column.key, _TYPES[column.values], UNSET) for column in OPTIONAL_COLUMNS.values()],
    bases=(_FixedMembers,),
    forbid_unknown_fields=True,
)


def boxes_from_json(objects: Any, location: str, class_names: ClassNames = _OWN_NAMES) -> Boxes3D:
    """N boxes from a list of N JSON objects. A missing or null velocity becomes NaN.

    where: start of an error message, such as "boxes.json: frame 3". class_names: maps the classes; names that it does
    not know are kept.
    Raises InputError that names the first invalid box by its index in the list.
    """
    rows = typed(objects, list[_Box], f"{location}: boxes")
    if not rows:
        return Boxes3D.empty()
    columns: dict[str, NDArray[Any] | None] = {}
    for name, column in OPTIONAL_COLUMNS.items():
        raw = [getattr(row, column.key) for row in rows]
        filled = [column.unknown if value is UNSET or value is None else value for value in raw]
        columns[name] = None if raw.count(UNSET) == len(raw) else np.array(filled)
    boxes = Boxes3D(
        centers=np.array([row.center for row in rows]),
        sizes_lwh=np.array([row.size_lwh for row in rows]),
        yaws=np.array([row.yaw for row in rows]),
        velocities=np.array([row.velocity or (None, None) for row in rows], dtype=np.float64),
        classes=np.array([class_names[row.name] for row in rows]),
        **columns,
        **(_futures(rows, location) if any(row.futures for row in rows) else {}),
    )
    without = [index for index, row in enumerate(rows) if row.score is UNSET]
    if 0 < len(without) < len(rows):
        raise InputError(f'{location}: box {without[0]}: "score" is missing (other boxes of the frame have one)')
    sizes = boxes.sizes_lwh
    checks: list[tuple[str, NDArray[Any], NDArray[np.bool_], str]] = [
        (column.key, shares, ((shares >= 0) & (shares <= 1)) | np.isnan(shares), "0 to 1")
        for name, column in OPTIONAL_COLUMNS.items()
        if column.values == "share" and (shares := columns[name]) is not None
    ]
    for key, values in (("center", boxes.centers), ("size_lwh", sizes), ("yaw", boxes.yaws)):
        checks.append((key, values, np.isfinite(values), "finite numbers"))
    for key, values, good, expected in (*checks, ("size_lwh", sizes, sizes > 0, "numbers above 0")):
        if not good.all():
            index = int(np.argmin(good.reshape(len(good), -1).all(axis=1)))
            raise InputError(f"{location}: box {index}: {key}: expected {expected}, found {values[index].tolist()}")
    return boxes


def boxes_to_json(boxes: Boxes3D) -> list[dict[str, Any]]:
    """N JSON objects. Unknown values (NaN visibility, "" names, -1 points) are left out; NaN velocities become null.

    "duplicate" is written only where it is true.
    """
    velocities = [[None if math.isnan(v) else v for v in row] for row in boxes.velocities.tolist()]
    columns: dict[str, list[Any]] = {
        "class": boxes.classes.tolist(),
        "center": boxes.centers.tolist(),
        "size_lwh": boxes.sizes_lwh.tolist(),
        "yaw": boxes.yaws.tolist(),
        "velocity": velocities,
    }
    objects = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    for name, column in OPTIONAL_COLUMNS.items():
        values = getattr(boxes, name)
        if values is None:
            continue
        if column.values == "score":
            written = np.ones(len(values), dtype=bool)  # written always, so that NaN is an error
        elif column.values == "count":
            written = values >= 0  # two unknown numbers may add up to -2
        else:
            written = ~np.isnan(values) if column.values == "share" else values != column.unknown
        for box, value, is_written in zip(objects, values.tolist(), written.tolist(), strict=True):
            if is_written:
                box[column.key] = value
    if boxes.futures is not None:
        _add_futures(objects, boxes, boxes.futures)
    return objects


def _add_futures(objects: Sequence[dict[str, Any]], boxes: Boxes3D, futures: Array) -> None:
    """Add futures to N JSON objects: M modes of T steps, each x and y, null if unknown; and the times of the steps."""
    for index, box in enumerate(objects):
        future = futures[index]  # (M, T, 3)
        if not np.isfinite(future[..., 1:]).any():
            continue
        box["future_times_s"] = future[0, :, 0].tolist()
        modes = future[..., 1:].round(FUTURE_DECIMALS).tolist()
        box["futures"] = [[None if math.isnan(point[0]) else point for point in mode] for mode in modes]
        if boxes.future_scores is not None:
            box["future_scores"] = boxes.future_scores[index].tolist()


def _futures(rows: Sequence[Any], location: str) -> dict[str, Any]:
    """The columns `futures` and `future_scores` of Boxes3D, of rows of which one or more have futures."""
    having = {index: row for index, row in enumerate(rows) if row.futures}
    first = next(iter(having.values()))
    modes, steps = len(first.futures or ()), len(first.future_times_s)
    futures, scores = np.full((len(rows), modes, steps, 3), np.nan), np.full((len(rows), modes), np.nan)
    for index, row in having.items():
        counts = [len(mode) for mode in row.futures or ()]
        if counts != [steps] * modes or len(row.future_times_s) != steps or len(row.future_scores or counts) != modes:
            raise InputError(
                f"{location}: box {index}: futures: {len(counts)} modes of {counts[0]} steps (expected {modes} of "
                f"{steps}, as in the other boxes of the frame, with a score for each mode and a time for each step)"
            )
        futures[index, ..., 0] = row.future_times_s
        futures[index, ..., 1:] = [[point or (np.nan, np.nan) for point in mode] for mode in row.futures or ()]
        scores[index] = row.future_scores or np.nan
    return {"futures": futures, **({"future_scores": scores} if any(row.future_scores for row in rows) else {})}


@dataclass(frozen=True)
class FrameBoxes:
    """One frame's boxes, in the frame of reference of its file."""

    stamp: FrameStamp  # index, scene and time of the frame
    # pose at the frame's time. None if unknown, which is not allowed in a file in the world frame
    world_from_ego: Pose | None
    boxes: Boxes3D  # N boxes, metres
    # further members of the frame's JSON object, such as "skipped" or "sample_token"
    extras: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class BoxesFile:
    """All frames of a file, in its order."""

    frame_of_reference: str  # "world", "ego" or "bev"; all centres, yaws and velocities are in it
    frames: tuple[FrameBoxes, ...]  # the frames
    ego_from_bev: Pose | None = None  # pose of the bev frame, None if unknown
    # further members of the file's JSON object, such as "model" or "untrained"
    extras: Mapping[str, Any] = field(default_factory=dict)
    # the classes of the model that predicted the boxes; None where the file does not state them
    classes: Mapping[str, ObjectClass] | None = None

    def in_ego(self, frame: FrameBoxes) -> Boxes3D:
        """The boxes of one of the frames in the ego frame. Raises InputError if the file lacks the bev frame's pose."""
        if self.frame_of_reference == "ego":
            return frame.boxes
        if self.frame_of_reference == "world":
            assert frame.world_from_ego is not None  # read_boxes requires it
            return frame.boxes.transformed(inverse(frame.world_from_ego.matrix))
        if self.ego_from_bev is None:
            raise InputError('the boxes are in the bev frame, and their file does not state "ego_from_bev": add it')
        return frame.boxes.transformed(self.ego_from_bev.matrix)


def read_boxes(
    path: Path, class_map: Mapping[str, str] | None = None, classes: Iterable[str] | None = None
) -> BoxesFile:
    """Read a boxes file. Of a writer that was killed, the partial file (`incremental_json`) is read.

    Names are compared without case to the known classes, and unknown ones are kept. class_map: names of the file ->
    known classes. classes: the known ones; by default those that the file states, as predictions do, or nuScenes' ten.
    Raises InputError if the file is missing, not JSON or of another format, or has a missing key, an invalid value,
    or two frames of a scene with the same time. The message names the file, the frame and the box.
    """
    with without_garbage_collection():
        content = read_frames(path, FORMAT, "a boxes file", FRAMES_OF_REFERENCE)
        reference, rows = content["frame_of_reference"], content["frames"]
        own_classes = _stated_classes(content, path) if "classes" in content else None
        names = ClassNames(class_map, classes or own_classes or NUSCENES_CLASSES)
        frames = tuple(_frame(path, index, row, reference, names) for index, row in enumerate(rows))
    moments: set[tuple[str, int]] = set()
    for stamp in (frame.stamp for frame in frames):
        moment = (stamp.scene, stamp.timestamp_ns)
        if moment in moments:
            raise InputError(
                f'{path}: frame {stamp.index}: scene "{moment[0]}" has two frames at {moment[1]} ns: remove one'
            )
        moments.add(moment)
    ego_from_bev = content.get("ego_from_bev")
    return BoxesFile(
        reference,
        frames,
        None if ego_from_bev is None else pose_from_json(ego_from_bev, "ego_from_bev", str(path)),
        {key: value for key, value in content.items() if key not in _FILE_KEYS},
        own_classes,
    )


def _stated_classes(content: Mapping[str, Any], path: Path) -> dict[str, ObjectClass]:
    """The classes in "classes" and "class_settings" of a boxes file. Raises InputError."""
    try:
        names = msgspec.convert(content["classes"], tuple[str, ...])
        settings = msgspec.convert(content.get("class_settings", {}), dict[str, ClassSettings])
        return object_classes(names, settings)
    except ValueError as error:
        raise InputError(f'{path}: "classes" or "class_settings" is wrong: {error}') from None


def above_score(boxes: BoxesFile, score: float) -> BoxesFile:
    """The boxes with at least this score. Frames without scores keep all boxes."""
    return replace(boxes, frames=tuple(replace(frame, boxes=frame.boxes.scored(score)) for frame in boxes.frames))


class BoxesWriter(IncrementalJson):
    """Writes a boxes file frame by frame.

    The file gets its name when the writer is closed; until then `read_boxes` reads all finished frames from its partial
    file, also if the program is killed. Boxes are not kept in memory. Raises OutputError if the file cannot be written.

        with BoxesWriter(path, "world", {"model": "tiny"}) as writer:
            writer.write(frame_boxes)
    """

    def __init__(
        self,
        path: Path,
        frame_of_reference: str,
        extras: Mapping[str, Any] | None = None,
        ego_from_bev: Pose | None = None,
        resume_at: int | None = None,
    ) -> None:
        """resume_at: `size` of an earlier writer of this file, to go on from there."""
        assert frame_of_reference in FRAMES_OF_REFERENCE
        head: dict[str, Any] = {"format": FORMAT, "frame_of_reference": frame_of_reference, **(extras or {})}
        if ego_from_bev is not None:
            head["ego_from_bev"] = pose_to_json(ego_from_bev)
        super().__init__(path, head, "frames", resume_at)

    def write(self, frame: FrameBoxes) -> None:
        """Append a frame. Its boxes must be in the file's frame of reference."""
        row = {**stamp_to_json(frame.stamp), **frame.extras}
        if frame.world_from_ego is not None:
            row["world_from_ego"] = pose_to_json(frame.world_from_ego)
        row["boxes"] = boxes_to_json(frame.boxes)
        self.add(row, f"frame {frame.stamp.index}")


def _frame(path: Path, index: int, row: Any, frame_of_reference: str, class_names: ClassNames) -> FrameBoxes:
    stamp = stamp_from_json(row, f"{path}: entry {index} of frames")
    location = f"{path}: frame {stamp.index}"
    if "boxes" not in row:
        raise InputError(f'{location}: "boxes" is missing (expected a list, empty for a frame without boxes)')
    pose = row.get("world_from_ego")
    if pose is None and frame_of_reference == "world":
        raise InputError(f'{location}: "world_from_ego" is missing (required if "frame_of_reference" is "world")')
    return FrameBoxes(
        stamp,
        None if pose is None else pose_from_json(pose, "world_from_ego", location),
        boxes_from_json(row["boxes"], location, class_names),
        {key: value for key, value in row.items() if key not in _FRAME_KEYS},
    )
