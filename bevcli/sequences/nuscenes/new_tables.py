"""NewTables: the rows of a nuScenes root that is written."""

import hashlib
from itertools import pairwise
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig, same_rig
from bevcli.geometry.transforms import Pose
from bevcli.sequences.nuscenes.index import CLASS_OF_CATEGORY, NUSCENES

(LIDAR,) = NUSCENES.lidars  # its pose is that of the bev frame
Row = dict[str, Any]
# scene.json is the last: it makes a folder a nuScenes root.
TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample", "sample_annotation",
    "sample_data", "sensor", "visibility", "scene",
)  # fmt: skip
CATEGORY_OF_CLASS = {name: category for category, name in reversed(CLASS_OF_CATEGORY.items())}
VISIBILITIES = {"v0-40": 0.4, "v40-60": 0.6, "v60-80": 0.8, "v80-100": 1.0}  # level -> its upper end
NO_POINTS_KNOWN = -1


class NewTables:
    """Collects the rows of nuScenes' tables. Tokens are the same for the same drive.

    Attributes:
        rows: table -> rows, in the order of TABLES; complete after `finish`.
    """

    def __init__(self, log: str) -> None:
        """log: name of the drive."""
        self.rows: dict[str, list[Row]] = {name: [] for name in TABLES}
        self._log = log
        self._known: set[str] = set()  # tokens of rows that several frames share
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
        own = token("data", sample, channel)
        self.rows["ego_pose"].append({"token": own, "timestamp": time_us, **_pose_of(pose)})
        row = {
            "token": own,
            "sample_token": sample,
            "ego_pose_token": own,
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
            self._share("category", token("category", category), name=category, description=name)
            self._share("instance", instance, category_token=token("category", category))
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
        for chain in (*self._samples.values(), *self._streams.values(), *self._objects.values()):
            _link(chain)
        for row in self.rows["instance"]:
            found = self._objects[row["token"]]
            row["nbr_annotations"] = len(found)
            row["first_annotation_token"], row["last_annotation_token"] = found[0]["token"], found[-1]["token"]
        for number, level in enumerate(VISIBILITIES, 1):
            self._share("visibility", str(number), level=level, description="visible share in percent")
        log = token("log", self._log)
        self._share("log", log, logfile="", vehicle="", date_captured="", location=self._log)
        self._share("map", token("map", self._log), category="", filename=map_file, log_tokens=[log])
        for scene, samples in self._samples.items():
            first, last = samples[0]["token"], samples[-1]["token"]
            ends = {"first_sample_token": first, "last_sample_token": last, "nbr_samples": len(samples)}
            self._share("scene", token("scene", scene), log_token=log, name=scene, description="", **ends)
            self._add_sensors(scene, self._rigs[scene])

    def _add_sensors(self, scene: str, rig: CameraRig) -> None:
        self._add_sensor(scene, LIDAR, "lidar", Pose.from_matrix(rig.ego_from_bev), [])
        for one in rig.cameras:
            self._add_sensor(scene, one.name, "camera", Pose.from_matrix(one.ego_from_camera), one.intrinsics.tolist())

    def _add_sensor(self, scene: str, channel: str, modality: str, pose: Pose, intrinsics: list[list[float]]) -> None:
        sensor = token("sensor", channel)
        self._share("sensor", sensor, channel=channel, modality=modality)
        own = token("calibrated", scene, channel)
        self._share("calibrated_sensor", own, sensor_token=sensor, camera_intrinsic=intrinsics, **_pose_of(pose))

    def _add(self, table: str, row: Row, chain: list[Row]) -> None:
        """Add a row to a table, and to the rows that are linked with it."""
        self.rows[table].append(row)
        chain.append(row)

    def _share(self, table: str, own: str, **columns: Any) -> None:
        """Add a row that several frames refer to once."""
        if own not in self._known:
            self._known.add(own)
            self.rows[table].append({"token": own, **columns})


def token(*parts: object) -> str:
    """32 hexadecimal digits that stand for these parts."""
    return hashlib.sha256("\0".join(map(str, parts)).encode()).hexdigest()[:32]


def _link(rows: list[Row]) -> None:
    """Give rows in order of time the tokens of their neighbours."""
    for row in rows:
        row["prev"] = row["next"] = ""
    for one, other in pairwise(rows):
        one["next"], other["prev"] = other["token"], one["token"]


def _visibility(fraction: float | None) -> str:
    """The token of a visible fraction's level, "" if it is unknown."""
    if fraction is None or np.isnan(fraction):
        return ""
    return next(str(number) for number, end in enumerate(VISIBILITIES.values(), 1) if fraction <= end)


def _pose_of(pose: Pose) -> Row:
    return {"rotation": pose.quaternion.tolist(), "translation": pose.translation.tolist()}
