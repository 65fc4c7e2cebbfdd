"""ground_truth.json and predictions.json ("bevcli-boxes/1"): boxes by frame, read whole and written frame by frame."""

from __future__ import annotations

import gc
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose
from bevcli.sequences.files.box_json import boxes_from_json, boxes_to_json
from bevcli.sequences.files.growing_json import GrowingJson
from bevcli.sequences.files.pose_json import pose_from_json, pose_to_json

FORMAT = "bevcli-boxes/1"
FRAMES_OF_REFERENCE = ("world", "ego", "bev")
_FILE_KEYS = ("format", "frame_of_reference", "ego_from_bev", "frames")
_FRAME_KEYS = ("frame", "scene", "timestamp_ns", "world_from_ego", "boxes")


@dataclass(frozen=True)
class FrameBoxes:
    """One frame's boxes, in the frame of reference of the file that holds it.

    world_from_ego: at the frame's time; None where it is not known (then the frame of reference is not world).
    extras: whatever else is said of the frame, such as "skipped" or "sample_token".
    """

    stamp: FrameStamp
    world_from_ego: Pose | None
    boxes: Boxes3D
    extras: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class BoxesFile:
    """All frames of a file, in its order.

    frame_of_reference: "world", "ego" or "bev", of every centre, yaw and velocity. ego_from_bev: where it is known.
    extras: whatever else is said of all frames, such as "model" or "untrained".
    """

    frame_of_reference: str
    frames: tuple[FrameBoxes, ...]
    ego_from_bev: Pose | None = None
    extras: Mapping[str, Any] = field(default_factory=dict)


def read_boxes(path: Path) -> BoxesFile:
    """Read a boxes file.

    Raises InputError, one line that names the file, the frame and the box, where the file is missing or no JSON,
    is of another format, lacks a key, has a number that is none, an unknown class, or one moment of a scene twice.
    """
    with _without_garbage_collection():
        content = _load(path)
        frame_of_reference = content.get("frame_of_reference")
        if frame_of_reference not in FRAMES_OF_REFERENCE:
            raise InputError(
                f'{path}: "frame_of_reference" must be world, ego or bev, found {frame_of_reference!r:.40}'
            )
        if not isinstance(content.get("frames"), list):
            raise InputError(f'{path}: "frames" is missing or no list (expected one object a frame)')
        rows = content["frames"]
        frames = tuple(_frame(path, place, row, frame_of_reference) for place, row in enumerate(rows))
    _check_unique(path, frames)
    ego_from_bev = content.get("ego_from_bev")
    return BoxesFile(
        frame_of_reference,
        frames,
        None if ego_from_bev is None else pose_from_json(ego_from_bev, "ego_from_bev", str(path)),
        _others(content, _FILE_KEYS),
    )


def above_score(boxes: BoxesFile, score: float) -> BoxesFile:
    """The boxes with at least this score; those without any score stay."""

    def kept(frame: FrameBoxes) -> FrameBoxes:
        scores = frame.boxes.scores
        return frame if scores is None else replace(frame, boxes=frame.boxes[scores >= score])

    return replace(boxes, frames=tuple(map(kept, boxes.frames)))


class BoxesWriter:
    """`with BoxesWriter(path, "world", {"model": "tiny"}) as writer: writer.write(frame_boxes)`.

    The file is whole, valid JSON after every frame: a run that is killed leaves the frames it has done.
    Nothing is kept in memory. Raises OutputError where the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        frame_of_reference: str,
        extras: Mapping[str, Any] | None = None,
        ego_from_bev: Pose | None = None,
    ) -> None:
        assert frame_of_reference in FRAMES_OF_REFERENCE
        head: dict[str, Any] = {"format": FORMAT, "frame_of_reference": frame_of_reference, **(extras or {})}
        if ego_from_bev is not None:
            head["ego_from_bev"] = pose_to_json(ego_from_bev)
        self._file = GrowingJson(path, json.dumps(head)[:-1] + ', "frames": [', "]}")

    def write(self, frame: FrameBoxes) -> None:
        """Append a frame, its boxes in the file's frame of reference."""
        row: dict[str, Any] = {
            "frame": frame.stamp.index,
            "scene": frame.stamp.scene,
            "timestamp_ns": frame.stamp.timestamp_ns,
            **frame.extras,
        }
        if frame.world_from_ego is not None:
            row["world_from_ego"] = pose_to_json(frame.world_from_ego)
        row["boxes"] = boxes_to_json(frame.boxes)
        self._file.append(row, f"frame {frame.stamp.index}")

    def __enter__(self) -> BoxesWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    # Millions of small JSON objects make the collector walk them over and over: twice the time for nothing.
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _load(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{path}: the file is missing (expected boxes, {FORMAT})") from None
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: broken JSON at line {error.lineno}, column {error.colno}: {error.msg}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({error})") from None
    found = content.get("format") if isinstance(content, dict) else type(content).__name__
    if found != FORMAT:
        raise InputError(f'{path}: not a boxes file: "format" must be "{FORMAT}", found {found!r:.40}')
    return content


def _frame(path: Path, place: int, row: Any, frame_of_reference: str) -> FrameBoxes:
    where = f"{path}: entry {place} of frames"
    if not isinstance(row, dict):
        raise InputError(f"{where}: expected an object, found {row!r:.40}")
    index, timestamp_ns = _integer(row, "frame", where), _integer(row, "timestamp_ns", where)
    where = f"{path}: frame {index}"
    scene = row.get("scene", "")
    if not isinstance(scene, str):
        raise InputError(f"{where}: scene: expected a text, found {scene!r:.40}")
    if "boxes" not in row:
        raise InputError(f'{where}: "boxes" is missing (a frame without boxes has an empty list)')
    stated = row.get("world_from_ego")
    if stated is None and frame_of_reference == "world":
        raise InputError(f'{where}: "world_from_ego" is missing (expected, because frame_of_reference is world)')
    return FrameBoxes(
        FrameStamp(index, scene, timestamp_ns),
        None if stated is None else pose_from_json(stated, "world_from_ego", where),
        boxes_from_json(row["boxes"], where),
        _others(row, _FRAME_KEYS),
    )


def _integer(row: dict[str, Any], key: str, where: str) -> int:
    value = row.get(key)
    if type(value) is not int:
        raise InputError(f'{where}: "{key}" must be an integer, found {value!r:.40}')
    return value


def _others(row: dict[str, Any], known: tuple[str, ...]) -> dict[str, Any]:
    return {key: value for key, value in row.items() if key not in known}


def _check_unique(path: Path, frames: tuple[FrameBoxes, ...]) -> None:
    seen: set[tuple[str, int]] = set()
    for frame in frames:
        moment = (frame.stamp.scene, frame.stamp.timestamp_ns)
        if moment in seen:
            raise InputError(f'{path}: frame {frame.stamp.index}: scene "{moment[0]}" has {moment[1]} ns twice')
        seen.add(moment)
