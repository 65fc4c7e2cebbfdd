"""ASAM OpenLABEL 1.0.0: a JSON file with the cuboids of each object in each frame."""

import json
from collections import Counter
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.evaluation.box_format import BoxFormat
from bevcli.evaluation.formats.tracks import tracks_of
from bevcli.evaluation.options import ExportOptions
from bevcli.geometry.boxes import Boxes3D
from bevcli.printing import counted
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.writing import write_whole

Fields = dict[str, Any]
COLUMNS = {"score": "scores", "track_score": "track_scores", "visibility": "visibilities"}  # by their attributes' names


def _write(boxes: BoxesFile, target: Path, options: ExportOptions, source: Path) -> str:
    content = openlabel(boxes)
    write_whole(target, json.dumps(content, allow_nan=False).encode())
    return f"{counted(len(boxes.frames), 'frames')}, {len(content['openlabel']['objects'])} objects"


FORMAT = BoxFormat("openlabel.json", _write)


def openlabel(boxes: BoxesFile) -> Fields:
    """The JSON object of a file. A track is an object; its cuboids are in the file's frame of reference.

    A cuboid is x, y, z, the quaternion x, y, z, w, length, width, height. Raises InputError where frame indices repeat.
    """
    numbers = [frame.stamp.index for frame in boxes.frames]
    if len(set(numbers)) < len(numbers):
        raise InputError("frame indices repeat (OpenLABEL's frames are named by them): export each scene separately")
    has_poses = all(frame.world_from_ego is not None for frame in boxes.frames)
    frames = {str(frame.stamp.index): {"frame_properties": _properties(frame), "objects": {}} for frame in boxes.frames}
    objects = {}
    for number, track in enumerate(tracks_of(boxes.frames)):
        places = [(boxes.frames[frame], box) for frame, box in track]
        for frame, box in places:
            cuboid = _cuboid(frame.boxes, box, boxes.frame_of_reference)
            frames[str(frame.stamp.index)]["objects"][str(number)] = {"object_data": {"cuboid": [cuboid]}}
        objects[str(number)] = _object(places, number)
    return {
        "openlabel": {
            "metadata": {"schema_version": "1.0.0", "annotator": "bevcli", "name": str(boxes.extras.get("model", ""))},
            "coordinate_systems": _coordinate_systems(boxes, has_poses),
            "objects": objects,
            "frames": frames,
            "frame_intervals": _intervals(numbers),
        }
    }


def _object(places: list[tuple[FrameBoxes, int]], number: int) -> Fields:
    """An object of its boxes: its class is the most frequent one."""
    (kind, _), *_ = Counter(str(frame.boxes.classes[box]) for frame, box in places).most_common()
    frame, box = places[0]
    identity = "" if frame.boxes.instances is None else str(frame.boxes.instances[box])
    intervals = _intervals(frame.stamp.index for frame, _ in places)
    return {"name": f"{kind} {identity or f'without track {number}'}", "type": kind, "frame_intervals": intervals}


def _cuboid(boxes: Boxes3D, box: int, frame_of_reference: str) -> Fields:
    half = boxes.yaws[box] / 2
    values = [*boxes.centers[box], 0, 0, np.sin(half), np.cos(half), *boxes.sizes_lwh[box]]
    known = {name: getattr(boxes, column) for name, column in COLUMNS.items()}
    found = {name: float(column[box]) for name, column in known.items() if column is not None}
    found |= dict(zip(("vx", "vy"), boxes.velocities[box].tolist(), strict=True))
    attributes: Fields = {"num": [{"name": key, "val": value} for key, value in found.items() if np.isfinite(value)]}
    if boxes.attributes is not None and boxes.attributes[box]:
        attributes["text"] = [{"name": "attribute", "val": str(boxes.attributes[box])}]
    numbers = [float(value) for value in values]
    return {"name": "box", "coordinate_system": frame_of_reference, "val": numbers, "attributes": attributes}


def _properties(frame: FrameBoxes) -> Fields:
    properties: Fields = {"timestamp": f"{np.datetime64(frame.stamp.timestamp_ns, 'ns')}Z"}
    if frame.stamp.scene:
        properties["scene"] = frame.stamp.scene
    if frame.world_from_ego is not None:
        matrix = {"matrix4x4": frame.world_from_ego.matrix.ravel().tolist()}
        properties["transforms"] = {"ego_to_world": {"src": "ego", "dst": "world", "transform_src_to_dst": matrix}}
    return properties


def _coordinate_systems(boxes: BoxesFile, has_poses: bool) -> Fields:
    """The world where poses are known, the ego frame in it, and the bev frame where boxes are in it."""
    systems: Fields = {"ego": {"type": "local_cs", "parent": "world" if has_poses else "", "children": []}}
    if has_poses:
        systems["world"] = {"type": "scene_cs", "parent": "", "children": ["ego"]}
    if boxes.ego_from_bev is not None or boxes.frame_of_reference == "bev":
        systems["bev"] = {"type": "local_cs", "parent": "ego", "children": []}
        systems["ego"]["children"] = ["bev"]
    if boxes.ego_from_bev is not None:
        systems["bev"]["pose_wrt_parent"] = {"matrix4x4": boxes.ego_from_bev.matrix.ravel().tolist()}
    return systems


def _intervals(numbers: Iterable[int]) -> list[Fields]:
    """Runs of consecutive numbers."""
    runs = groupby(enumerate(sorted(numbers)), key=lambda pair: pair[1] - pair[0])
    found = [[number for _, number in run] for _, run in runs]
    return [{"frame_start": run[0], "frame_end": run[-1]} for run in found]
