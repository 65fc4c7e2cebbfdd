"""Writes a drive as a nuScenes root."""

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError, OutputError
from bevcli.frame import CameraImage, Drive, Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Array, Pose
from bevcli.parsing.files import is_file_name
from bevcli.parsing.images import encode_image
from bevcli.workshop.formats import NuScenesOptions, WriteOptions, versions_in
from bevcli.workshop.formats.nuscenes import NuScenesDrive
from bevcli.workshop.formats.nuscenes_index import CLASS_OF_CATEGORY, NUSCENES
from bevcli.workshop.formats.nuscenes_tables import Row
from bevcli.workshop.formats.output import FolderWriter, same_rig
from bevcli.writing import write_whole

VERSION = "v1.0-custom"
PARTS = (VERSION, "samples", "maps", "can_bus")  # what the writer creates and `force` removes
MAP_FILE = "maps/empty.png"
(LIDAR,) = NUSCENES.lidars  # its pose is that of the bev frame
# scene.json is the last: it makes a folder a nuScenes root.
TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample", "sample_annotation",
    "sample_data", "sensor", "visibility", "scene",
)  # fmt: skip
CATEGORY_OF_CLASS = {name: category for category, name in reversed(CLASS_OF_CATEGORY.items())}
VISIBILITIES = {"v0-40": 0.4, "v40-60": 0.6, "v60-80": 0.8, "v80-100": 1.0}  # level -> its upper end
NO_POINTS_KNOWN = -1


class NuScenesWriter(FolderWriter):
    """Writes a nuScenes root frame by frame, each frame as a sample, and the tables at the end.

    - Images are copied byte for byte. nuScenes knows no lens distortion, so images of a camera with distortion are
      undistorted and become PNG.
    - The bev frame is that of LIDAR_TOP, whose files have no points. The map is a black image of one pixel.
    - Motion goes to the CAN bus expansion. Times are rounded down to microseconds.
    - Velocities of the ground truth are not in nuScenes' tables: readers derive them from positions over time.

    After an error, what was written is deleted. scene.json is written last, so that a killed process leaves no valid
    root.
    """

    def __init__(self, root: Path, sequence: Drive, options: WriteOptions) -> None:
        """Raises InputError for a drive without poses, and OutputError."""
        if not sequence.has_ego_motion:
            raise InputError(f"{sequence.name}: has no ego-motion, which a nuScenes root must have: add it")
        super().__init__(root, PARTS, force=options.force, can_replace={*versions_in(root)} <= {VERSION})
        self._name, self._tables = sequence.name, NewTables(sequence.name)
        self._messages: dict[str, list[Row]] = {}  # of the CAN bus, by scene

    def write(self, frame: Frame) -> None:
        """Write the images of a frame; its rows follow at the end."""
        scene, time_us = frame.stamp.scene or self._name, frame.stamp.timestamp_ns // 1000
        if not is_file_name(scene):
            raise InputError(f'scene "{scene:.60}": cannot be the name of a file: rename it')
        sample = self._tables.add_sample(scene, time_us, frame.rig)
        points = f"samples/{LIDAR}/{sample}.pcd.bin"
        write_whole(self.folder / points, b"", parents=True)
        self._tables.add_data(scene, sample, points, time_us, frame.world_from_ego, None)
        for name, image in frame.images.items():
            camera, pose = frame.rig[name], frame.world_from_ego_at[name]
            if camera.distortion is not None:
                image = CameraImage(image.timestamp_ns, camera.undistort(image.pixels_bgr))
            file = self._write_image(f"samples/{name}/{sample}", image)
            self._tables.add_data(scene, sample, file, image.timestamp_ns // 1000, pose, camera)
        self._messages.setdefault(scene, []).append(_message(time_us, frame.world_from_ego, frame.kinematics))
        if frame.ground_truth is not None:
            self._tables.add_annotations(scene, sample, frame.ground_truth)

    def _finish(self) -> None:
        if not self._messages:
            raise OutputError(f"{self.folder}: no frame was written (expected at least one)")
        write_whole(self.folder / MAP_FILE, encode_image(np.zeros((1, 1), np.uint8), ".png"), parents=True)
        for scene, messages in self._messages.items():
            write_whole(self.folder / f"can_bus/{scene}_pose.json", _json(messages), parents=True)
        self._tables.finish(MAP_FILE)
        for name, rows in self._tables.rows.items():
            write_whole(self.folder / VERSION / f"{name}.json", _json(rows), parents=True)

    def _read_back(self) -> None:
        NuScenesDrive(self.folder, own=NuScenesOptions(version=VERSION))


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


class NewTables:
    """Collects the rows of the tables of a root that is written. Tokens are the same for the same drive.

    Attributes:
        rows: table -> rows, in the order of TABLES; complete after `finish`.
    """

    def __init__(self, log: str) -> None:
        """log: name of the drive."""
        self.rows: dict[str, list[Row]] = {name: [] for name in TABLES}
        self._log = log
        self._shared: set[str] = set()  # tokens of rows that several frames share
        self._rigs: dict[str, CameraRig] = {}  # by scene
        self._samples: dict[str, list[Row]] = {}  # by scene
        self._streams: dict[tuple[str, str], list[Row]] = {}  # sample_data by scene and channel
        self._objects: dict[str, list[Row]] = {}  # annotations by instance

    def add_sample(self, scene: str, time_us: int, rig: CameraRig) -> str:
        """Add a sample, and return its token. Raises InputError for another rig or a time that is not later."""
        samples = self._samples.setdefault(scene, [])
        if samples and time_us <= samples[-1]["timestamp"]:
            raise InputError(f"scene {scene}: a frame at {time_us} us is not later than the one before it")
        if not same_rig(self._rigs.setdefault(scene, rig), rig):
            raise InputError(
                f"scene {scene}: the calibration of the frame at {time_us} us differs from the first one's"
            )
        sample = token("sample", scene, time_us)
        row = {"token": sample, "timestamp": time_us, "scene_token": token("scene", scene)}
        self._add("sample", row, samples)
        return sample

    def add_data(self, scene: str, sample: str, file: str, time_us: int, pose: Pose, camera: Camera | None) -> None:
        """Add a file of a sample, taken with the vehicle at a pose. camera: None for LIDAR_TOP."""
        channel = LIDAR if camera is None else camera.name
        data_token = token("data", sample, channel)
        self.rows["ego_pose"].append({"token": data_token, "timestamp": time_us, **_pose_of(pose)})
        row = {
            "token": data_token,
            "sample_token": sample,
            "ego_pose_token": data_token,
            "calibrated_sensor_token": token("calibrated", scene, channel),
            "timestamp": time_us,
            "fileformat": "pcd" if camera is None else file.rpartition(".")[2],
            "is_key_frame": True,
            "height": 0 if camera is None else camera.height,
            "width": 0 if camera is None else camera.width,
            "filename": file,
        }
        self._add("sample_data", row, self._streams.setdefault((scene, channel), []))

    def add_annotations(self, scene: str, sample: str, boxes: Boxes3D) -> None:
        """Add the boxes of a sample, in the world frame."""
        identities = [""] * len(boxes) if boxes.instances is None else boxes.instances.tolist()
        for k, identity in enumerate(identities):
            name = str(boxes.classes[k])
            category = CATEGORY_OF_CLASS.get(name, name)
            instance = token("instance", scene, identity or f"{sample} {k}", category)
            group = self._share("category", token("category", category), name=category, description=name)
            self._share("instance", instance, category_token=group)
            attribute = "" if boxes.attributes is None else str(boxes.attributes[k])
            if attribute:
                self._share("attribute", token("attribute", attribute), name=attribute, description="")
            row = {
                "token": token("annotation", sample, k),
                "sample_token": sample,
                "instance_token": instance,
                "visibility_token": _visibility(None if boxes.visibilities is None else boxes.visibilities[k]),
                "attribute_tokens": [token("attribute", attribute)] if attribute else [],
                "translation": boxes.centers[k].tolist(),
                "size": boxes.sizes_lwh[k][[1, 0, 2]].tolist(),
                "rotation": [float(np.cos(boxes.yaws[k] / 2)), 0.0, 0.0, float(np.sin(boxes.yaws[k] / 2))],
                "num_lidar_pts": NO_POINTS_KNOWN if boxes.num_points is None else int(boxes.num_points[k]),
                "num_radar_pts": 0,
            }
            self._add("sample_annotation", row, self._objects.setdefault(instance, []))

    def finish(self, map_file: str) -> None:
        """Add the rows that need all samples. map_file: image of the map."""
        for row in self.rows["instance"]:
            boxes = self._objects[row["token"]]
            row["nbr_annotations"] = len(boxes)
            row["first_annotation_token"], row["last_annotation_token"] = boxes[0]["token"], boxes[-1]["token"]
        for number, level in enumerate(VISIBILITIES, 1):
            self._share("visibility", str(number), level=level, description="visible share in percent")
        log = self._share("log", token("log", self._log), logfile="", vehicle="", date_captured="", location=self._log)
        self._share("map", token("map", self._log), category="", filename=map_file, log_tokens=[log])
        for scene, samples in self._samples.items():
            first, last = samples[0]["token"], samples[-1]["token"]
            ends = {"first_sample_token": first, "last_sample_token": last, "nbr_samples": len(samples)}
            self._share("scene", token("scene", scene), log_token=log, name=scene, description="", **ends)
            self._add_sensors(scene, self._rigs[scene])

    def _add_sensors(self, scene: str, rig: CameraRig) -> None:
        sensors: list[tuple[str, str, Array, list[Any]]] = [(LIDAR, "lidar", rig.ego_from_bev, [])]
        sensors += [
            (camera.name, "camera", camera.ego_from_camera, camera.intrinsics.tolist()) for camera in rig.cameras
        ]
        for channel, modality, ego_from_sensor, intrinsics in sensors:
            sensor = self._share("sensor", token("sensor", channel), channel=channel, modality=modality)
            calibrated, pose = token("calibrated", scene, channel), _pose_of(Pose.from_matrix(ego_from_sensor))
            self._share("calibrated_sensor", calibrated, sensor_token=sensor, camera_intrinsic=intrinsics, **pose)

    def _add(self, table: str, row: Row, chain: list[Row]) -> None:
        """Add a row to a table, linked with the last one of a chain in order of time, which it extends."""
        row |= {"prev": chain[-1]["token"] if chain else "", "next": ""}
        if chain:
            chain[-1]["next"] = row["token"]
        self.rows[table].append(row)
        chain.append(row)

    def _share(self, table: str, row_token: str, **columns: Any) -> str:
        """Add a row that several frames refer to once; returns its token."""
        if row_token not in self._shared:
            self._shared.add(row_token)
            self.rows[table].append({"token": row_token, **columns})
        return row_token


def token(*parts: object) -> str:
    """32 hexadecimal digits that stand for these parts."""
    return hashlib.sha256("\0".join(map(str, parts)).encode()).hexdigest()[:32]


def _visibility(fraction: float | None) -> str:
    """The token of a visible fraction's level, "" if it is unknown."""
    if fraction is None or np.isnan(fraction):
        return ""
    return next(str(number) for number, end in enumerate(VISIBILITIES.values(), 1) if fraction <= end)


def _pose_of(pose: Pose) -> Row:
    return {"rotation": pose.quaternion.tolist(), "translation": pose.translation.tolist()}
