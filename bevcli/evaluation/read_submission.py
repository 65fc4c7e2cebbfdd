"""Reading a nuScenes detection submission (results_nusc.json), from us or from anybody."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.transforms import rotation_from_quaternion, yaw_of_rotation
from bevcli.sequences.files.box_json import boxes_from_json
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes

_PEEK_BYTES = 2048  # both kinds of file say what they are at their beginning


def is_submission(path: Path) -> bool:
    """Whether a file starts like a submission; False where it cannot be read."""
    try:
        with path.open("rb") as file:
            head = file.read(_PEEK_BYTES)
    except OSError:
        return False
    return b'"bevcli-boxes' not in head and (b'"meta"' in head or b'"results"' in head)


def read_submission(path: Path) -> BoxesFile:
    """Boxes in the world by sample token; scenes, times and ego poses are not in a submission. Raises InputError."""
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({error})") from None
    results = content.get("results") if isinstance(content, dict) else None
    if not isinstance(results, dict):
        raise InputError(f'{path}: "results" must be an object of sample tokens, as in a nuScenes submission')
    frames = [_frame(place, token, rows, path) for place, (token, rows) in enumerate(results.items())]
    # No submission states the ego pose: the ground truth's is taken, with which it is paired by its sample token.
    return BoxesFile("world", tuple(frames))


def _frame(place: int, token: str, rows: Any, path: Path) -> FrameBoxes:
    where = f"{path}: sample {token}"
    if not isinstance(rows, list):
        raise InputError(f"{where}: expected a list of boxes, found {rows!r:.40}")
    objects = [_box_object(row, f"{where}: box {number}") for number, row in enumerate(rows)]
    stamp = FrameStamp(-1 - place, "", -1 - place)  # unknown: nothing may be matched by it
    return FrameBoxes(stamp, None, boxes_from_json(objects, where), {"sample_token": token})


def _box_object(row: Any, where: str) -> dict[str, Any]:
    """A submission's box in the words of a boxes file, which then checks the numbers."""
    needed = ("translation", "size", "rotation", "velocity", "detection_name", "detection_score", "attribute_name")
    missing = [key for key in needed if not isinstance(row, dict) or key not in row]
    if missing:
        raise InputError(f'{where}: "{missing[0]}" is missing')
    size = row["size"]
    return {
        "class": row["detection_name"],
        "center": row["translation"],
        "size_lwh": [size[1], size[0], size[2]] if isinstance(size, list) and len(size) == 3 else size,
        "yaw": _yaw(row["rotation"], where),
        "velocity": row["velocity"],
        "score": row["detection_score"],
        "attribute": row["attribute_name"],
    }


def _yaw(rotation: Any, where: str) -> float:
    numbers = isinstance(rotation, list) and len(rotation) == 4 and all(type(v) in (int, float) for v in rotation)
    if not numbers or not abs(np.linalg.norm(rotation) - 1) < 1e-2:
        raise InputError(f"{where}: rotation: expected 4 numbers of norm 1 (w, x, y, z), found {rotation!r:.60}")
    return yaw_of_rotation(rotation_from_quaternion(rotation))
