"""KITTI raw: tracklet_labels.xml, a list of tracks, as annotation tools read it."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from bevcli.errors import InputError
from bevcli.evaluation.box_format import BoxFormat
from bevcli.evaluation.formats.tracks import Place, tracks_of
from bevcli.evaluation.options import ExportOptions
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.geometry.transforms import Array, wrap_angle
from bevcli.printing import counted
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.sequences.files.calibration_file import is_file_name
from bevcli.workshop.formats.boxes.kitti import kitti_type
from bevcli.writing import write_whole

HEAD = b'<?xml version="1.0" encoding="UTF-8" standalone="yes"?>\n<!DOCTYPE boost_serialization>\n'
INTERPOLATED, LABELLED = 1, 2  # state of a pose
UNSET = {"occlusion": -1, "occlusion_kf": 0, "truncation": -1, "amt_occlusion": -1, "amt_occlusion_kf": -1}
UNSET |= {"amt_border_l": -1, "amt_border_r": -1, "amt_border_kf": -1}


def _write(boxes: BoxesFile, target: Path, options: ExportOptions, source: Path) -> str:
    scenes: dict[str, list[FrameBoxes]] = {}
    for frame in boxes.frames:
        scenes.setdefault(frame.stamp.scene, []).append(frame)
    count = 0
    for scene, frames in scenes.items():
        if scene and not is_file_name(scene):
            raise InputError(f'scene "{scene:.60}": cannot be the name of a folder: rename it')
        tracks = tracks_of(frames)
        count += len(tracks)
        in_ego = [boxes.in_ego(frame) for frame in frames]
        root = tracklets(in_ego, tracks, boxes.classes or NUSCENES_CLASSES)
        write_whole(target / scene / "tracklet_labels.xml", HEAD + ElementTree.tostring(root), parents=True)
    return f"{counted(len(boxes.frames), 'frames')}, {counted(count, 'tracks')}"


FORMAT = BoxFormat("kitti_raw", _write)


def tracklets(
    frames: Sequence[Boxes3D], tracks: Sequence[Sequence[Place]], classes: Mapping[str, ObjectClass]
) -> ElementTree.Element:
    """The XML of a scene's frames, which are numbered from 0. The frame of the lidar is the ego frame.

    A tracklet has one size, the median of its boxes', and a pose in every frame from its first to its last: between
    boxes it is interpolated.

    frames: boxes in the ego frame. classes: the known ones, for their KITTI types.
    """
    root = ElementTree.Element("boost_serialization", signature="serialization::archive", version="9")
    listed = ElementTree.SubElement(root, "tracklets", class_id="0", tracking_level="0", version="0")
    _values(listed, {"count": len(tracks), "item_version": 1})
    for number, track in enumerate(tracks):
        item = ElementTree.SubElement(listed, "item", _marks(1, 1) if number == 0 else {})
        boxes = [frames[frame][[box]] for frame, box in track]
        length, width, height = np.median([one.sizes_lwh[0] for one in boxes], axis=0).tolist()
        kind = kitti_type(str(boxes[0].classes[0]), classes)
        _values(item, {"objectType": kind, "h": height, "w": width, "l": length, "first_frame": track[0][0]})
        poses = [(frame, _pose(box)) for (frame, _), box in zip(track, boxes, strict=True)]
        _add_poses(item, _filled(poses), is_first=number == 0)
        _values(item, {"finished": 1})
    return root


def _pose(box: Boxes3D) -> Array:
    """(4,) x, y, z of the bottom's centre, metres, and yaw of a single box."""
    bottom = box.centers[0] - box.sizes_lwh[0] * (0, 0, 0.5)
    return np.array([*bottom, box.yaws[0]])


def _filled(poses: list[tuple[int, Array]]) -> list[tuple[Array, int]]:
    """A pose for every frame from the first to the last, and its state."""
    found = [(poses[0][1], LABELLED)]
    for (earlier, start), (later, end) in pairwise(poses):
        step = end - start
        step[3] = wrap_angle(step[3])
        fractions = np.arange(1, later - earlier) / (later - earlier)
        found += [(start + fraction * step, INTERPOLATED) for fraction in fractions]
        found.append((end, LABELLED))
    return found


def _add_poses(item: ElementTree.Element, poses: list[tuple[Array, int]], *, is_first: bool) -> None:
    """is_first: the classes of the archive are declared where they occur first."""
    listed = ElementTree.SubElement(item, "poses", _marks(2, 0) if is_first else {})
    _values(listed, {"count": len(poses), "item_version": 2})
    for place, ((x, y, z, yaw), state) in enumerate(poses):
        pose = ElementTree.SubElement(listed, "item", _marks(3, 2) if is_first and place == 0 else {})
        _values(pose, {"tx": x, "ty": y, "tz": z, "rx": 0.0, "ry": 0.0, "rz": yaw, "state": state, **UNSET})


def _marks(class_id: int, version: int) -> dict[str, str]:
    return {"class_id": str(class_id), "tracking_level": "0", "version": str(version)}


def _values(parent: ElementTree.Element, values: dict[str, object]) -> None:
    for name, value in values.items():
        ElementTree.SubElement(parent, name).text = f"{value:.6f}" if isinstance(value, float) else str(value)
