"""nuScenes submissions for detection (results_nusc.json) and tracking (tracking_nusc.json): written, and read."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D, attributes_by_speed
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import Array, rotation_from_quaternion, yaw_of_rotation
from bevcli.parsing.files import open_regular
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes, boxes_from_json
from bevcli.sequences.files.incremental_json import IncrementalJson, existing, read_entries

MAX_BOXES = 500  # per sample, by the rules of the benchmark; the best by score are kept
TRACKED = tuple(name for name, object_class in NUSCENES_CLASSES.items() if object_class.tracked)
# The keys that the submissions for a task do not share, and the columns of `Boxes3D` that they hold.
DETECTION_COLUMNS = {"detection_name": "classes", "detection_score": "scores", "attribute_name": "attributes"}
TRACKING_COLUMNS = {"tracking_id": "instances", "tracking_name": "classes", "tracking_score": "track_scores"}
META = {"use_camera": True, "use_lidar": False, "use_radar": False, "use_map": False, "use_external": False}
_PEEK_BYTES = 2048  # the kind of a file can be read from its beginning


class SubmissionWriter(IncrementalJson):
    """`with SubmissionWriter(path) as writer: writer.write(frame)`; the file gets its name when the writer is closed.

    resume_at: `size` of an earlier writer of this file, to go on from there.
    Raises OutputError where the file cannot be written.
    """

    def __init__(self, path: Path, resume_at: int | None = None, *, tracking: bool = False) -> None:
        self._boxes = tracking_submission_boxes if tracking else submission_boxes
        super().__init__(path, {"meta": META}, "results", resume_at, "{}")

    def write(self, frame: FrameBoxes) -> None:
        """Add a frame, its boxes in the world frame. A frame without a sample token (no keyframe) is left out."""
        token = frame.extras.get("sample_token")
        if token is not None:
            self.add(self._boxes(frame.boxes, token), f"frame {frame.stamp.index}", key=token)


def submission_boxes(boxes: Boxes3D, sample_token: str) -> list[dict[str, Any]]:
    """The best 500 boxes as objects of a submission, by descending score.

    boxes: in the world frame, with scores. Missing attributes follow from class and speed. An unknown velocity is
    written as 0.
    """
    if not len(boxes):
        return []
    attributes = attributes_by_speed(boxes) if boxes.attributes is None else boxes.attributes
    return _objects(replace(boxes, attributes=attributes), sample_token, DETECTION_COLUMNS, boxes.scores)


def tracking_submission_boxes(boxes: Boxes3D, sample_token: str) -> list[dict[str, Any]]:
    """The best 500 boxes with a track, of the seven tracking classes, as objects of a tracking submission.

    boxes: in the world frame. The order is that of descending track score. An unknown velocity is written as 0.
    """
    if boxes.instances is None or boxes.track_scores is None:
        return []
    tracked = boxes[(boxes.instances != "") & np.isin(boxes.classes, TRACKED)]
    return _objects(tracked, sample_token, TRACKING_COLUMNS, tracked.track_scores)


def _objects(boxes: Boxes3D, sample_token: str, keys: Mapping[str, str], scores: Array | None) -> list[dict[str, Any]]:
    """The best boxes by descending score. own: keys of the task, and their columns."""
    assert scores is not None
    best = boxes[np.argsort(-scores, kind="stable")[:MAX_BOXES]]
    none = np.zeros(len(best))
    columns = {
        "translation": best.centers,
        "size": best.sizes_lwh[:, [1, 0, 2]],
        "rotation": np.stack([np.cos(best.yaws / 2), none, none, np.sin(best.yaws / 2)], axis=-1),
        "velocity": np.nan_to_num(best.velocities, nan=0.0),
        **{key: getattr(best, column) for key, column in keys.items()},
    }
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [{"sample_token": sample_token, **dict(zip(columns, row, strict=True))} for row in rows]


def write_submission(boxes: BoxesFile, path: Path, *, tracking: bool = False) -> int:
    """Write a submission for the detection task, or for the tracking task; return the number of frames.

    Raises InputError if boxes are not in the world frame, frames have no sample token, or `tracking` and no box has a
    track.
    """
    if boxes.frame_of_reference != "world":
        raise InputError(
            "a nuScenes submission needs boxes in the world frame, but these are in the "
            f"{boxes.frame_of_reference} frame: run with ego-motion"
        )
    if not any("sample_token" in frame.extras for frame in boxes.frames):
        raise InputError('a nuScenes submission needs a "sample_token" in every frame: run on a nuScenes root')
    if tracking and all(frame.boxes.track_scores is None for frame in boxes.frames):
        raise InputError(
            'a nuScenes tracking submission needs boxes with "instance" and "track_score": use `bevcli run --track`'
        )
    with SubmissionWriter(path, tracking=tracking) as writer:
        for frame in boxes.frames:
            writer.write(frame)
    return len(boxes.frames)


def is_submission(path: Path) -> bool:
    """True if a file begins like a submission; False where it cannot be read."""
    try:
        with open_regular(existing(path)) as file:
            head = file.read(_PEEK_BYTES)
    except (InputError, OSError):
        return False
    return b'"bevcli-boxes' not in head and (b'"meta"' in head or b'"results"' in head)


def read_submission(path: Path) -> BoxesFile:
    """Read boxes in the world frame with their sample tokens. Raises InputError.

    A submission has no scenes, timestamps and ego poses.
    """
    content = read_entries(path, "{}")
    results = content.get("results") if isinstance(content, dict) else None
    if not isinstance(results, dict):
        raise InputError(f'{path}: "results" must be an object of sample tokens, as in a nuScenes submission')
    frames = [_frame_from_json(index, token, rows, path) for index, (token, rows) in enumerate(results.items())]
    # The frames have no ego pose: after pairing by sample token, the ground truth's is used.
    return BoxesFile("world", tuple(frames))


def _frame_from_json(index: int, token: str, rows: Any, path: Path) -> FrameBoxes:
    location = f"{path}: sample {token}"
    if not isinstance(rows, list):
        raise InputError(f"{location}: expected a list of boxes, found {rows!r:.40}")
    objects = [_box_object(row, f"{location}: box {number}") for number, row in enumerate(rows)]
    stamp = FrameStamp(-1 - index, "", -1 - index)  # unknown, and equal to no stamp of another file
    return FrameBoxes(stamp, None, boxes_from_json(objects, location), {"sample_token": token})


def _box_object(row: Any, location: str) -> dict[str, Any]:
    """A box of a submission with the keys of a boxes file, whose reader checks the values."""
    tracking = isinstance(row, dict) and "tracking_id" in row
    columns = TRACKING_COLUMNS if tracking else DETECTION_COLUMNS
    needed = ("translation", "size", "rotation", "velocity", *columns)
    missing = [key for key in needed if not isinstance(row, dict) or key not in row]
    if missing:
        raise InputError(f'{location}: "{missing[0]}" is missing')
    size, extras = row["size"], {"score": row.get("detection_score"), "attribute": row.get("attribute_name")}
    if tracking:
        extras = dict.fromkeys(("score", "track_score"), row["tracking_score"]) | {"instance": row["tracking_id"]}
    return {
        "class": row["tracking_name" if tracking else "detection_name"],
        **extras,
        "center": row["translation"],
        "size_lwh": [size[1], size[0], size[2]] if isinstance(size, list) and len(size) == 3 else size,
        "yaw": _yaw(row["rotation"], location),
        "velocity": row["velocity"],
    }


def _yaw(rotation: Any, location: str) -> float:
    numbers = isinstance(rotation, list) and len(rotation) == 4 and all(type(v) in (int, float) for v in rotation)
    if not numbers or not abs(np.linalg.norm(rotation) - 1) < 1e-2:
        raise InputError(f"{location}: rotation: expected 4 numbers of norm 1 (w, x, y, z), found {rotation!r:.60}")
    return yaw_of_rotation(rotation_from_quaternion(rotation))
