"""Frames of Autoware and of URDF: x, y, z, roll, pitch and yaw of each frame from its parent, in metres and radians.

Autoware has them in two files: `sensors_calibration.yaml` places the kit of sensors on the vehicle (`base_link`), and
`sensor_kit_calibration.yaml` the cameras on the kit. The frame of a camera is that of its body, `camera0/camera_link`
with x forward, y left, z up, or that of its image, `camera0/camera_optical_link`.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, inverse, rigid, rotation_about_z
from bevcli.parsing.files import is_there
from bevcli.sequences.files.json_fields import array_of_numbers
from bevcli.workshop.formats.camera_poses import AXES
from bevcli.workshop.formats.markup import read_yaml

NUMBERS = ("x", "y", "z", "roll", "pitch", "yaw")
ON_VEHICLE = "sensors_calibration.yaml"  # beside the calibration of a kit
VEHICLE = "base_link"
FRAME = re.compile(r"[/_]?(?:camera_)?(?:base_)?(?P<optical>optical_)?(?:link|frame)$")
Frames = dict[str, tuple[str, Array]]  # frame -> its parent, and (4, 4) parent_from_frame


def with_own_names(document: Any, path: Path) -> Any:
    """A document with frames as one with the poses of the cameras; any other document as it is. Raises InputError."""
    frames = _frames(document, path)
    if not frames:
        return document
    beside = path.parent / ON_VEHICLE
    if VEHICLE not in (parent for parent, _ in frames.values()) and is_there(beside):
        frames |= _frames(read_yaml(beside), beside)
    cameras: dict[str, dict[str, Any]] = {}
    for frame in sorted(frames, key=lambda name: "optical" in name):  # the frame of the image replaces that of the body
        match = FRAME.search(frame)
        if match is not None and "cam" in frame.lower():
            root, root_from_frame = _from_root(frames, frame)
            matrix = root_from_frame if match["optical"] else root_from_frame @ inverse(rigid(rotation=AXES["vehicle"]))
            name = "ego_from_camera" if root == VEHICLE else "T_rig_camera"
            cameras[frame[: match.start()] or frame] = {name: matrix.tolist()}
    return cameras or document  # cameras by their names may have such numbers too


def _frames(document: Any, path: Path) -> Frames:
    """The frames of {parent: {frame: {x, …, yaw}}}; none for another document."""
    if not isinstance(document, dict) or not document:
        return {}
    frames: Frames = {}
    for parent, children in document.items():
        if not isinstance(children, dict) or not children:
            return {}
        for name, pose in children.items():
            if not isinstance(pose, dict) or not set(NUMBERS) <= pose.keys():
                return {}
            numbers = array_of_numbers([pose[key] for key in NUMBERS])
            if numbers is None or not np.isfinite(numbers).all():
                raise InputError(f"{path}: {name}: {', '.join(NUMBERS)}: expected finite numbers")
            frames[str(name)] = str(parent), transform(numbers[:3], numbers[3:])
    return frames


def transform(translation: Array, angles: Array) -> Array:
    """(4, 4) parent_from_frame of URDF: metres, and roll, pitch and yaw about fixed axes, radians."""
    roll, pitch, yaw = (np.eye(4), np.eye(4), rigid(rotation=rotation_about_z(angles[2])))
    roll[1:3, 1:3] = rotation_about_z(angles[0])[:2, :2]
    pitch[np.ix_([2, 0], [2, 0])] = rotation_about_z(angles[1])[:2, :2]
    return rigid(translation) @ yaw @ pitch @ roll


def _from_root(frames: Frames, frame: str) -> tuple[str, Array]:
    """The frame that has no parent, and (4, 4) root_from_frame."""
    root_from_frame, seen = np.eye(4), set[str]()
    while frame in frames and frame not in seen:
        seen.add(frame)
        frame, parent_from_frame = frames[frame]
        root_from_frame = parent_from_frame @ root_from_frame
    return frame, root_from_frame


def urdf_document(robot: Element) -> dict[str, Any]:
    """The joints of a URDF, as Autoware's files have them."""
    document: dict[str, Any] = {}
    for joint in robot.iter("joint"):
        ends = [
            element.get("link", "") if (element := joint.find(end)) is not None else "" for end in ("parent", "child")
        ]
        numbers = dict(zip(NUMBERS, _origin(joint), strict=True))
        document.setdefault(ends[0], {})[ends[1]] = numbers
    return document


def _origin(joint: Element) -> Iterator[float | None]:
    origin = joint.find("origin")
    values: Mapping[str, str] = {} if origin is None else origin.attrib
    for name in ("xyz", "rpy"):
        words = values.get(name, "0 0 0").split()
        for index in range(3):
            try:
                yield float(words[index])
            except (IndexError, ValueError):
                yield None
