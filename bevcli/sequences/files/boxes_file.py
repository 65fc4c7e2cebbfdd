"""ground_truth.json and predictions.json ("bevcli-boxes/1"): boxes by frame, read whole, written frame by frame."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ClassSettings, ObjectClass, object_classes
from bevcli.geometry.transforms import Pose, inverse
from bevcli.parsing.documents import without_garbage_collection
from bevcli.sequences.files.box_json import boxes_from_json, boxes_to_json
from bevcli.sequences.files.class_names import ClassNames
from bevcli.sequences.files.incremental_json import FileOfFrames, read_frames, stamp_from_json, stamp_to_json
from bevcli.sequences.files.json_fields import pose_from_json, pose_to_json

FORMAT = "bevcli-boxes/1"
FRAMES_OF_REFERENCE = ("world", "ego", "bev")
_FILE_KEYS = ("format", "frame_of_reference", "ego_from_bev", "frames")
_FRAME_KEYS = ("frame", "scene", "timestamp_ns", "world_from_ego", "boxes")


@dataclass(frozen=True)
class FrameBoxes:
    """One frame's boxes, in the frame of reference of its file.

    Attributes:
        stamp: index, scene and time of the frame.
        world_from_ego: pose at the frame's time. None if unknown, which is not allowed in a file in the world frame.
        boxes: N boxes, metres.
        extras: further members of the frame's JSON object, such as "skipped" or "sample_token".
    """

    stamp: FrameStamp
    world_from_ego: Pose | None
    boxes: Boxes3D
    extras: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class BoxesFile:
    """All frames of a file, in its order.

    Attributes:
        frame_of_reference: "world", "ego" or "bev"; all centres, yaws and velocities are in it.
        frames: the frames.
        ego_from_bev: pose of the bev frame, None if unknown.
        extras: further members of the file's JSON object, such as "model" or "untrained".
        classes: the classes of the model that predicted the boxes; None where the file does not state them.
    """

    frame_of_reference: str
    frames: tuple[FrameBoxes, ...]
    ego_from_bev: Pose | None = None
    extras: Mapping[str, Any] = field(default_factory=dict)
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
        reference, rows, stated = content["frame_of_reference"], content["frames"], _stated_classes(content, path)
        names = ClassNames(class_map, classes or stated or NUSCENES_CLASSES)
        frames = tuple(_frame(path, place, row, reference, names) for place, row in enumerate(rows))
    _check_unique(path, frames)
    ego_from_bev = content.get("ego_from_bev")
    return BoxesFile(
        reference,
        frames,
        None if ego_from_bev is None else pose_from_json(ego_from_bev, "ego_from_bev", str(path)),
        _others(content, _FILE_KEYS),
        stated,
    )


def _stated_classes(content: Mapping[str, Any], path: Path) -> dict[str, ObjectClass] | None:
    """The classes in "classes" and "class_settings" of a boxes file; None without them. Raises InputError."""
    if "classes" not in content:
        return None
    try:
        names = msgspec.convert(content["classes"], tuple[str, ...])
        settings = msgspec.convert(content.get("class_settings", {}), dict[str, ClassSettings])
        return object_classes(names, settings)
    except ValueError as error:
        raise InputError(f'{path}: "classes" or "class_settings" is wrong: {error}') from None


def above_score(boxes: BoxesFile, score: float) -> BoxesFile:
    """The boxes with at least this score. Frames without scores keep all boxes."""
    return replace(boxes, frames=tuple(replace(frame, boxes=frame.boxes.scored(score)) for frame in boxes.frames))


class BoxesWriter(FileOfFrames):
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
        super().__init__(path, head, resume_at)

    def write(self, frame: FrameBoxes) -> None:
        """Append a frame. Its boxes must be in the file's frame of reference."""
        row = {**stamp_to_json(frame.stamp), **frame.extras}
        if frame.world_from_ego is not None:
            row["world_from_ego"] = pose_to_json(frame.world_from_ego)
        row["boxes"] = boxes_to_json(frame.boxes)
        self.add(row, f"frame {frame.stamp.index}")


def write_boxes(boxes: BoxesFile, path: Path) -> int:
    """Write all frames of a file; return the number of boxes. Raises OutputError."""
    with BoxesWriter(path, boxes.frame_of_reference, boxes.extras, boxes.ego_from_bev) as writer:
        for frame in boxes.frames:
            writer.write(frame)
    return sum(len(frame.boxes) for frame in boxes.frames)


def _frame(path: Path, place: int, row: Any, frame_of_reference: str, class_names: ClassNames) -> FrameBoxes:
    stamp = stamp_from_json(row, f"{path}: entry {place} of frames")
    where = f"{path}: frame {stamp.index}"
    if "boxes" not in row:
        raise InputError(f'{where}: "boxes" is missing (expected a list, empty for a frame without boxes)')
    stated = row.get("world_from_ego")
    if stated is None and frame_of_reference == "world":
        raise InputError(f'{where}: "world_from_ego" is missing (required if "frame_of_reference" is "world")')
    return FrameBoxes(
        stamp,
        None if stated is None else pose_from_json(stated, "world_from_ego", where),
        boxes_from_json(row["boxes"], where, class_names),
        _others(row, _FRAME_KEYS),
    )


def _others(row: dict[str, Any], known: tuple[str, ...]) -> dict[str, Any]:
    return {key: value for key, value in row.items() if key not in known}


def _check_unique(path: Path, frames: tuple[FrameBoxes, ...]) -> None:
    seen: set[tuple[str, int]] = set()
    for frame in frames:
        moment = (frame.stamp.scene, frame.stamp.timestamp_ns)
        if moment in seen:
            raise InputError(
                f'{path}: frame {frame.stamp.index}: scene "{moment[0]}" has two frames at {moment[1]} ns: remove one'
            )
        seen.add(moment)
