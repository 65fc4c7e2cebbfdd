"""What is written for nuScenes: drives as its roots, and boxes as its submissions, which are also read.

A submission is for detection (results_nusc.json) or for tracking (tracking_nusc.json).
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError, OutputError
from bevcli.frame import CameraImage, Drive, Frame, FrameStamp
from bevcli.geometry.boxes import Boxes3D, attributes_by_speed
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import Array, Pose, rotation_from_quaternion, yaw_of_rotation
from bevcli.parsing.files import is_file_name, open_regular
from bevcli.parsing.images import encode_image
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes, boxes_from_json
from bevcli.sequences.files.incremental_json import IncrementalJson, existing, read_entries
from bevcli.workshop.formats import NuScenesOptions, WriteOptions, versions_in
from bevcli.workshop.formats.nuscenes import NuScenesDrive
from bevcli.workshop.formats.nuscenes_index import CLASS_OF_CATEGORY, NUSCENES
from bevcli.workshop.formats.nuscenes_tables import Row
from bevcli.workshop.formats.output import FolderWriter, same_rig
from bevcli.writing import whole_file, write_whole

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
MAX_BOXES = 500  # per sample, by the rules of the benchmark; the best by score are kept
TRACKED = tuple(name for name, object_class in NUSCENES_CLASSES.items() if object_class.tracked)
# The keys that the submissions for a task do not share, and the columns of `Boxes3D` that they hold.
DETECTION_COLUMNS = {"detection_name": "classes", "detection_score": "scores", "attribute_name": "attributes"}
TRACKING_COLUMNS = {"tracking_id": "instances", "tracking_name": "classes", "tracking_score": "track_scores"}
META = {"use_camera": True, "use_lidar": False, "use_radar": False, "use_map": False, "use_external": False}
_PEEK_BYTES = 2048  # the kind of a file can be read from its beginning


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
    with whole_file(path) as unfinished, SubmissionWriter(unfinished, tracking=tracking) as writer:
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
