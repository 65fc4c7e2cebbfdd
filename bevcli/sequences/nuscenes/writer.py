"""Writes a drive as a nuScenes root."""

import hashlib
import json
import shutil
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np

from bevcli.errors import InputError, OutputError
from bevcli.frame import CameraImage, Frame, Sequence
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig, same_rig
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Pose
from bevcli.sequences.files.calibration_file import is_file_name
from bevcli.sequences.nuscenes.build import LIDAR
from bevcli.sequences.nuscenes.format import versions_in
from bevcli.sequences.nuscenes.index import CLASS_OF_CATEGORY
from bevcli.sequences.options import WriteOptions
from bevcli.writing import write_whole

VERSION = "v1.0-custom"
TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample", "sample_annotation",
    "sample_data", "sensor", "visibility", "scene",
)  # fmt: skip
PARTS = (VERSION, "samples", "maps", "can_bus")  # what the writer creates and `force` removes
CATEGORY_OF_CLASS = {name: category for category, name in reversed(CLASS_OF_CATEGORY.items())}
VISIBILITIES = {"v0-40": 0.4, "v40-60": 0.6, "v60-80": 0.8, "v80-100": 1.0}  # level -> its upper end
SUFFIXES = {"image/jpeg": "jpg", "image/png": "png"}
Row = dict[str, Any]


class NuScenesWriter:
    """Writes a nuScenes root frame by frame, each frame as a sample, and the tables at the end.

    - Images are copied byte for byte. nuScenes knows no lens distortion, so images of a camera with distortion are
      undistorted and become PNG.
    - The bev frame is that of LIDAR_TOP, whose files have no points. A map is a black image of one pixel.
    - Motion goes to the CAN bus expansion. Times are rounded down to microseconds.
    - Velocities of the ground truth are not in nuScenes' tables: readers derive them from positions over time.

    scene.json is written last, so that an unfinished root is none.
    """

    def __init__(self, root: Path, sequence: Sequence, options: WriteOptions) -> None:
        """See `OutputFormat`."""
        if not sequence.has_ego_motion:
            raise InputError(
                f"{sequence.name}: has no ego-motion, which a nuScenes root must have: add it to the drive"
            )
        _make_room(root, options.force)
        self.root, self._name = root, sequence.name
        self._tables: dict[str, list[Row]] = {name: [] for name in TABLES}
        self._known: set[str] = set()  # tokens of rows that several frames share
        self._scenes: dict[str, list[Row]] = {}  # scene -> its samples
        self._streams: dict[tuple[str, str], list[Row]] = {}  # scene and channel -> its sample_data
        self._objects: dict[str, list[Row]] = {}  # instance token -> its annotations
        self._messages: dict[str, list[Row]] = {}  # scene -> its CAN bus messages
        self._rigs: dict[str, CameraRig] = {}

    def write(self, frame: Frame) -> None:
        """Write the images of a frame; its rows follow at the end."""
        scene = frame.stamp.scene or self._name
        if not is_file_name(scene):
            raise InputError(f'scene "{scene:.60}": cannot be the name of a file: rename it')
        samples = self._scenes.setdefault(scene, [])
        time_us = frame.stamp.timestamp_ns // 1000
        if samples and time_us <= samples[-1]["timestamp"]:
            raise InputError(f"frame {frame.stamp.index} ({scene}): is not later than the frame before it")
        if not same_rig(self._rigs.setdefault(scene, frame.rig), frame.rig):
            raise InputError(
                f"frame {frame.stamp.index} ({scene}): its calibration differs from the scene's first frame"
            )
        sample = _token("sample", scene, time_us)
        row = {"token": sample, "timestamp": time_us, "scene_token": _token("scene", scene)}
        self._add("sample", row, samples)
        self._add_data(scene, sample, LIDAR, time_us, frame.world_from_ego, f"samples/{LIDAR}/{sample}.pcd.bin", b"")
        for name, image in frame.images.items():
            self._add_image(scene, sample, frame.rig[name], image, frame.world_from_ego_at[name])
        self._messages.setdefault(scene, []).append(_message(time_us, frame.world_from_ego, frame.kinematics))
        if frame.ground_truth is not None:
            self._add_annotations(scene, sample, frame.ground_truth)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if error[0] is None:
            self._finish()

    def _add_image(self, scene: str, sample: str, camera: Camera, image: CameraImage, world_from_ego: Pose) -> None:
        encoded, suffix = image.encoded, SUFFIXES.get(image.media_type or "")
        if encoded is None or suffix is None or camera.distortion is not None:
            suffix, encoded = "png", cv2.imencode(".png", camera.undistort(image.pixels_bgr))[1].tobytes()
        file = f"samples/{camera.name}/{sample}.{suffix}"
        self._add_data(scene, sample, camera.name, image.timestamp_ns // 1000, world_from_ego, file, encoded, camera)

    def _add_data(
        self,
        scene: str,
        sample: str,
        channel: str,
        time_us: int,
        world_from_ego: Pose,
        file: str,
        content: bytes,
        camera: Camera | None = None,
    ) -> None:
        """Write a file, and keep its rows of sample_data and ego_pose."""
        write_whole(self.root / file, content, parents=True)
        token = _token("data", sample, channel)
        self._tables["ego_pose"].append({"token": token, "timestamp": time_us, **_pose_of(world_from_ego)})
        row = {
            "token": token,
            "sample_token": sample,
            "ego_pose_token": token,
            "calibrated_sensor_token": _token("calibrated", scene, channel),
            "timestamp": time_us,
            "fileformat": file.rpartition(".")[2].replace("bin", "pcd"),
            "is_key_frame": True,
            "height": 0 if camera is None else camera.height,
            "width": 0 if camera is None else camera.width,
            "filename": file,
        }
        self._add("sample_data", row, self._streams.setdefault((scene, channel), []))

    def _add_annotations(self, scene: str, sample: str, boxes: Boxes3D) -> None:
        identities = [""] * len(boxes) if boxes.instances is None else boxes.instances.tolist()
        for k, identity in enumerate(identities):
            name = str(boxes.classes[k])
            category = CATEGORY_OF_CLASS.get(name, name)
            instance = _token("instance", scene, identity or f"{sample} {k}", category)
            self._share("category", token=_token("category", category), name=category, description=name)
            attribute = "" if boxes.attributes is None else str(boxes.attributes[k])
            if attribute:
                self._share("attribute", token=_token("attribute", attribute), name=attribute, description="")
            row = {
                "token": _token("annotation", sample, k),
                "sample_token": sample,
                "instance_token": instance,
                "visibility_token": _visibility(None if boxes.visibilities is None else boxes.visibilities[k]),
                "attribute_tokens": [_token("attribute", attribute)] if attribute else [],
                "translation": boxes.centers[k].tolist(),
                "size": boxes.sizes_lwh[k][[1, 0, 2]].tolist(),
                "rotation": [float(np.cos(boxes.yaws[k] / 2)), 0.0, 0.0, float(np.sin(boxes.yaws[k] / 2))],
                "num_lidar_pts": -1 if boxes.num_points is None else int(boxes.num_points[k]),
                "num_radar_pts": 0,
            }
            self._add("sample_annotation", row, self._objects.setdefault(instance, []))
            self._share("instance", token=instance, category_token=_token("category", category))

    def _add(self, table: str, row: Row, chain: list[Row]) -> None:
        """Add a row to a table, and to the rows that are linked with it."""
        self._tables[table].append(row)
        chain.append(row)

    def _share(self, table: str, **row: Any) -> None:
        """Add a row that several frames refer to once."""
        if row["token"] not in self._known:
            self._known.add(row["token"])
            self._tables[table].append(row)

    def _finish(self) -> None:
        if not self._scenes:
            raise OutputError(f"{self.root}: no frame was written (expected at least one)")
        self._link_rows()
        for scene, rig in self._rigs.items():
            self._add_sensors(scene, rig)
        self._add_scenes()
        for number, level in enumerate(VISIBILITIES, 1):
            self._share("visibility", token=str(number), level=level, description="visible share in percent")
        for scene, messages in self._messages.items():
            write_whole(self.root / f"can_bus/{scene}_pose.json", _json(messages), parents=True)
        for name, rows in self._tables.items():  # scene.json is the last
            write_whole(self.root / VERSION / f"{name}.json", _json(rows), parents=True)

    def _link_rows(self) -> None:
        for chain in (*self._scenes.values(), *self._streams.values(), *self._objects.values()):
            _link(chain)
        for row in self._tables["instance"]:
            found = self._objects[row["token"]]
            row["nbr_annotations"] = len(found)
            row["first_annotation_token"], row["last_annotation_token"] = found[0]["token"], found[-1]["token"]

    def _add_sensors(self, scene: str, rig: CameraRig) -> None:
        bev = Pose.from_matrix(rig.ego_from_bev)
        poses: list[tuple[str, str, Pose, list[list[float]]]] = [(LIDAR, "lidar", bev, [])]
        for one in rig.cameras:
            poses.append((one.name, "camera", Pose.from_matrix(one.ego_from_camera), one.intrinsics.tolist()))
        for channel, modality, pose, intrinsics in poses:
            self._share("sensor", token=_token("sensor", channel), channel=channel, modality=modality)
            token = _token("calibrated", scene, channel)
            owner = {"sensor_token": _token("sensor", channel), "camera_intrinsic": intrinsics}
            self._share("calibrated_sensor", token=token, **owner, **_pose_of(pose))

    def _add_scenes(self) -> None:
        log, picture = _token("log", self._name), f"maps/{_token('map', self._name)}.png"
        write_whole(self.root / picture, cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes(), parents=True)
        self._share("log", token=log, logfile="", vehicle="", date_captured="", location=self._name)
        self._share("map", token=_token("map", self._name), category="", filename=picture, log_tokens=[log])
        for scene, samples in self._scenes.items():
            first, last = samples[0]["token"], samples[-1]["token"]
            ends = {"first_sample_token": first, "last_sample_token": last, "nbr_samples": len(samples)}
            self._share("scene", token=_token("scene", scene), log_token=log, name=scene, description="", **ends)


def _link(rows: list[Row]) -> None:
    """Give rows in order of time the tokens of their neighbours."""
    for row in rows:
        row["prev"] = row["next"] = ""
    for one, other in pairwise(rows):
        one["next"], other["prev"] = other["token"], one["token"]


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


def _visibility(fraction: float | None) -> str:
    """The token of a visible fraction's level, "" if it is unknown."""
    if fraction is None or np.isnan(fraction):
        return ""
    return next(str(number) for number, end in enumerate(VISIBILITIES.values(), 1) if fraction <= end)


def _pose_of(pose: Pose) -> Row:
    return {"rotation": pose.quaternion.tolist(), "translation": pose.translation.tolist()}


def _token(*parts: object) -> str:
    """32 hexadecimal digits, the same for the same drive."""
    return hashlib.sha256("\0".join(map(str, parts)).encode()).hexdigest()[:32]


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
        for part in PARTS:
            shutil.rmtree(root / part, ignore_errors=True)
