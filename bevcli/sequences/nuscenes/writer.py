"""Writes a drive as a nuScenes root."""

import json
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np

from bevcli.errors import InputError, OutputError
from bevcli.frame import CameraImage, Frame, Sequence
from bevcli.geometry.cameras import Camera
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Pose
from bevcli.sequences.files.calibration_file import is_file_name
from bevcli.sequences.nuscenes.format import versions_in
from bevcli.sequences.nuscenes.new_tables import LIDAR, NewTables, Row
from bevcli.sequences.options import WriteOptions
from bevcli.writing import remove_parts, whole_folder, write_whole

VERSION = "v1.0-custom"
PARTS = (VERSION, "samples", "maps", "can_bus")  # what the writer creates and `force` removes
MAP_FILE = "maps/empty.png"
SUFFIXES = {"image/jpeg": "jpg", "image/png": "png"}


class NuScenesWriter:
    """Writes a nuScenes root frame by frame, each frame as a sample, and the tables at the end.

    - Images are copied byte for byte. nuScenes knows no lens distortion, so images of a camera with distortion are
      undistorted and become PNG.
    - The bev frame is that of LIDAR_TOP, whose files have no points. The map is a black image of one pixel.
    - Motion goes to the CAN bus expansion. Times are rounded down to microseconds.
    - Velocities of the ground truth are not in nuScenes' tables: readers derive them from positions over time.

    After an error, what was written is deleted. scene.json is written last, so that a killed process leaves no valid
    root.
    """

    def __init__(self, root: Path, sequence: Sequence, options: WriteOptions) -> None:
        """See `OutputFormat`."""
        if not sequence.has_ego_motion:
            raise InputError(f"{sequence.name}: has no ego-motion, which a nuScenes root must have: add it")
        _make_room(root, options.force)
        self._open = ExitStack()
        self._open.enter_context(whole_folder(root, PARTS))
        self._open.push(self._finish)
        self.root, self._name = root, sequence.name
        self._tables = NewTables(sequence.name)
        self._messages: dict[str, list[Row]] = {}  # of the CAN bus, by scene

    def write(self, frame: Frame) -> None:
        """Write the images of a frame; its rows follow at the end."""
        scene, time_us = frame.stamp.scene or self._name, frame.stamp.timestamp_ns // 1000
        if not is_file_name(scene):
            raise InputError(f'scene "{scene:.60}": cannot be the name of a file: rename it')
        sample = self._tables.add_sample(scene, time_us, frame.rig)
        points = f"samples/{LIDAR}/{sample}.pcd.bin"
        write_whole(self.root / points, b"", parents=True)
        self._tables.add_data(scene, sample, points, time_us, frame.world_from_ego, None)
        for name, image in frame.images.items():
            camera, pose = frame.rig[name], frame.world_from_ego_at[name]
            file = self._write_image(sample, camera, image)
            self._tables.add_data(scene, sample, file, image.timestamp_ns // 1000, pose, camera)
        self._messages.setdefault(scene, []).append(_message(time_us, frame.world_from_ego, frame.kinematics))
        if frame.ground_truth is not None:
            self._tables.add_annotations(scene, sample, frame.ground_truth)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.__exit__(kind, error, trace)

    def _write_image(self, sample: str, camera: Camera, image: CameraImage) -> str:
        """Write an image; returns its path relative to the root."""
        encoded, suffix = image.encoded, SUFFIXES.get(image.media_type or "")
        if encoded is None or suffix is None or camera.distortion is not None:
            suffix, encoded = "png", cv2.imencode(".png", camera.undistort(image.pixels_bgr))[1].tobytes()
        file = f"samples/{camera.name}/{sample}.{suffix}"
        write_whole(self.root / file, encoded, parents=True)
        return file

    def _finish(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is not None:
            return
        if not self._messages:
            raise OutputError(f"{self.root}: no frame was written (expected at least one)")
        write_whole(self.root / MAP_FILE, cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes(), parents=True)
        for scene, messages in self._messages.items():
            write_whole(self.root / f"can_bus/{scene}_pose.json", _json(messages), parents=True)
        self._tables.finish(MAP_FILE)
        for name, rows in self._tables.rows.items():
            write_whole(self.root / VERSION / f"{name}.json", _json(rows), parents=True)


def _message(time_us: int, pose: Pose, kinematics: Kinematics) -> Row:
    """A pose message of the CAN bus. Readers take the first one after a sample's time, so it is 1 us later."""
    return {
        "accel": kinematics.acceleration.tolist(),
        "orientation": pose.quaternion.tolist(),
        "pos": pose.translation.tolist(),
        "rotation_rate": kinematics.angular_rate.tolist(),
        "utime": time_us + 1,
        "vel": kinematics.velocity.tolist(),
    }


def _json(rows: Iterable[Row]) -> bytes:
    return ("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n").encode()


def _make_room(root: Path, force: bool) -> None:
    if root.exists() and not root.is_dir():
        raise OutputError(f"{root}: is a file (expected a folder to write)")
    if root.is_dir() and any(root.iterdir()):
        others = [version for version in versions_in(root) if version != VERSION]
        if others or not force:
            way = "choose another folder" if others else "choose another folder, or pass `force=True` to replace it"
            raise OutputError(f"{root}: exists already: {way}")
        remove_parts(root, PARTS)
