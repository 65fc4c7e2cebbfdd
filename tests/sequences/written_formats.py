"""Small writers of other data sets' formats, from the frames of any drive. Each follows the published layout."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import feather

from bevcli.frame import Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import inverse, quaternion_from_rotation, rigid, rotation_about_z

RING = (
    "ring_front_center", "ring_front_right", "ring_front_left", "ring_side_right", "ring_side_left",
    "ring_rear_right", "ring_rear_left",
)  # fmt: skip
AXLE_HEIGHT_M = 0.33
# Argoverse 2 and T4 have no class for some of the ten; their names are written as they are.
ARGOVERSE2_NAMES = {
    "car": "REGULAR_VEHICLE", "truck": "BOX_TRUCK", "bus": "BUS", "trailer": "VEHICULAR_TRAILER",
    "motorcycle": "MOTORCYCLE", "bicycle": "BICYCLE", "pedestrian": "PEDESTRIAN", "traffic_cone": "CONSTRUCTION_CONE",
}  # fmt: skip
DGP_NAMES = {"car": "Car", "truck": "Truck", "bus": "Bus/RV/Caravan", "trailer": "Towed Object", "pedestrian": "Person"}
T4_NAMES = {"car": "vehicle.car", "pedestrian": "construction_worker", "bus": "vehicle.bus (bendy & rigid)"}


def _lens(camera: Camera) -> np.ndarray:
    """k1 k2 p1 p2 k3."""
    return np.array(camera.distortion.coefficients[:5] if camera.distortion else (0.0,) * 5)


def _pose_columns(poses: Sequence[np.ndarray]) -> dict[str, list[float]]:
    quaternions = np.array([quaternion_from_rotation(pose[:3, :3]) for pose in poses]).reshape(-1, 4)
    translations = np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3)
    names = zip(("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"), [*quaternions.T, *translations.T], strict=True)
    return {name: column.tolist() for name, column in names}


def _box_poses(boxes: Boxes3D) -> list[np.ndarray]:
    return [rigid(c, rotation_about_z(float(yaw))) for c, yaw in zip(boxes.centers, boxes.yaws, strict=True)]


def _write_feather(path: Path, columns: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), path)


def write_argoverse2(frames: Sequence[Frame], folder: Path) -> None:
    """A log of the Argoverse 2 sensor dataset, whose ego frame is above ours."""
    ego_from_axle = rigid((0, 0, AXLE_HEIGHT_M))
    rig = frames[0].rig
    names = dict(zip(rig.names, RING, strict=False))
    lenses = np.array([_lens(camera) for camera in rig.cameras])
    intrinsics = {
        "sensor_name": list(names.values()),
        **{f"f{axis}_px": [c.intrinsics[k, k] for c in rig.cameras] for k, axis in enumerate("xy")},
        **{f"c{axis}_px": [c.intrinsics[k, 2] for c in rig.cameras] for k, axis in enumerate("xy")},
        **{name: lenses[:, column].tolist() for name, column in (("k1", 0), ("k2", 1), ("k3", 4))},
        "height_px": pa.array([c.height for c in rig.cameras], pa.uint16()),
        "width_px": pa.array([c.width for c in rig.cameras], pa.uint16()),
    }
    extrinsics = [inverse(ego_from_axle) @ camera.ego_from_camera for camera in rig.cameras]
    _write_feather(folder / "calibration/intrinsics.feather", intrinsics)
    sensors = {"sensor_name": list(names.values()), **_pose_columns(extrinsics)}
    _write_feather(folder / "calibration/egovehicle_SE3_sensor.feather", sensors)
    poses, annotations = {}, []
    for frame in frames:
        time = frame.stamp.timestamp_ns
        poses[time] = frame.world_from_ego.matrix @ ego_from_axle
        for name, image in frame.images.items():
            poses.setdefault(image.timestamp_ns, frame.world_from_ego_at[name].matrix @ ego_from_axle)
            file = folder / "sensors/cameras" / names[name] / f"{image.timestamp_ns}.jpg"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(image.encoded)
        boxes = frame.ground_truth.transformed(inverse(poses[time]))
        annotations.append(
            {
                "timestamp_ns": [time] * len(boxes),
                "track_uuid": boxes.instances.tolist(),
                "category": [ARGOVERSE2_NAMES.get(name, name) for name in boxes.classes.tolist()],
                **dict(zip(("length_m", "width_m", "height_m"), boxes.sizes_lwh.T.tolist(), strict=True)),
                **_pose_columns(_box_poses(boxes)),
                "num_interior_pts": [7] * len(boxes),
            }
        )
    _write_feather(
        folder / "city_SE3_egovehicle.feather", {"timestamp_ns": list(poses), **_pose_columns(list(poses.values()))}
    )
    together = {name: [value for one in annotations for value in one[name]] for name in annotations[0]}
    _write_feather(folder / "annotations.feather", together)


def _dgp_pose(matrix: np.ndarray) -> dict[str, Any]:
    rotation = dict(zip(("qw", "qx", "qy", "qz"), quaternion_from_rotation(matrix[:3, :3]).tolist(), strict=True))
    return {"rotation": rotation, "translation": dict(zip("xyz", matrix[:3, 3].tolist(), strict=True))}


def _dgp_id(name: str, time_ns: int) -> dict[str, str]:
    time = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=time_ns // 1000)
    return {"log": "", "name": name, "timestamp": time.isoformat(timespec="microseconds").replace("+00:00", "Z")}


def _write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def write_dgp(frames: Sequence[Frame], folder: Path) -> None:
    """A DGP scene. Its lidar, whose file does not exist, stands 2 m above the ego frame."""
    rig, ego_from_lidar = frames[0].rig, rigid((0, 0, 2.0))
    classes = sorted({name for frame in frames for name in frame.ground_truth.classes.tolist()})
    things = sorted({name for frame in frames for name in frame.ground_truth.instances.tolist()})
    items = [{"id": k, "name": DGP_NAMES.get(name, name), "isthing": True} for k, name in enumerate(classes)]
    _write_json(folder / "ontology/o.json", {"items": items})
    lenses = [
        dict(zip(("k1", "k2", "p1", "p2", "k3"), _lens(camera).tolist(), strict=True))
        | {"fx": camera.intrinsics[0, 0], "fy": camera.intrinsics[1, 1], "skew": 0.0}
        | {"cx": camera.intrinsics[0, 2], "cy": camera.intrinsics[1, 2]}
        for camera in rig.cameras
    ]
    extrinsics = [_dgp_pose(pose) for pose in (ego_from_lidar, *(camera.ego_from_camera for camera in rig.cameras))]
    calibration = {"names": ["LIDAR", *rig.names], "intrinsics": [{}, *lenses], "extrinsics": extrinsics}
    _write_json(folder / "calibration/c.json", calibration)
    data, samples = [], []
    for number, frame in enumerate(frames):
        world_from_lidar = frame.world_from_ego.matrix @ ego_from_lidar
        boxes = frame.ground_truth.transformed(inverse(world_from_lidar))
        annotations = [
            {
                "class_id": classes.index(name),
                "instance_id": things.index(instance) + 1,
                "num_points": 7,
                "box": dict(zip(("length", "width", "height"), size, strict=True)) | {"pose": _dgp_pose(pose)},
            }
            for name, instance, size, pose in zip(
                boxes.classes.tolist(), boxes.instances, boxes.sizes_lwh.tolist(), _box_poses(boxes), strict=True
            )
        ]
        _write_json(folder / f"bounding_box_3d/LIDAR/{number}.json", {"annotations": annotations})
        content = {"annotations": {"1": f"bounding_box_3d/LIDAR/{number}.json"}, "pose": _dgp_pose(world_from_lidar)}
        own = _dgp_id("LIDAR", frame.stamp.timestamp_ns)
        data.append({"key": f"lidar{number}", "id": own, "datum": {"point_cloud": content}})
        for name, image in frame.images.items():
            file = f"rgb/{name}/{number}.jpg"
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(image.encoded)
            pose = frame.world_from_ego_at[name].matrix @ rig[name].ego_from_camera
            content = {"filename": file, "annotations": {}, "pose": _dgp_pose(pose)}
            content |= {"width": rig[name].width, "height": rig[name].height, "channels": 3}
            own = _dgp_id(name, image.timestamp_ns)
            data.append({"key": f"{name}{number}", "id": own, "datum": {"image": content}})
        keys = [one["key"] for one in data if one["key"].endswith(str(number))]
        own = _dgp_id("", frame.stamp.timestamp_ns)
        samples.append({"calibration_key": "c", "datum_keys": keys, "id": own, "metadata": {}})
    _write_json(folder / "scene_s.json", {"data": data, "samples": samples, "ontologies": {"1": "o"}})


def _t4_pose(matrix: np.ndarray) -> dict[str, Any]:
    return {"translation": matrix[:3, 3].tolist(), "rotation": quaternion_from_rotation(matrix[:3, :3]).tolist()}


def write_t4(frames: Sequence[Frame], folder: Path) -> None:
    """A T4 dataset whose lidar is LIDAR_CONCAT in the ego frame."""
    rig = frames[0].rig
    tables: dict[str, list[dict[str, Any]]] = {name: [] for name in ("sample_data", "ego_pose", "sample_annotation")}
    sensors = ["LIDAR_CONCAT", *rig.names]
    classes = sorted({name for frame in frames for name in frame.ground_truth.classes.tolist()})
    things = {i: n for f in frames for i, n in zip(f.ground_truth.instances, f.ground_truth.classes, strict=True)}
    tables["sensor"] = [{"token": f"s{name}", "channel": name, "modality": ""} for name in sensors]
    tables["calibrated_sensor"] = [
        {"token": f"c{name}", "sensor_token": f"s{name}"}
        | (
            {**_t4_pose(np.eye(4)), "camera_intrinsic": [], "camera_distortion": []}
            if name == "LIDAR_CONCAT"
            else {
                **_t4_pose(rig[name].ego_from_camera),
                "camera_intrinsic": rig[name].intrinsics.tolist(),
                "camera_distortion": _lens(rig[name]).tolist(),
            }
        )
        for name in sensors
    ]
    tables["scene"] = [{"token": "scene", "name": "street"}]
    tables["sample"] = [
        {"token": f"k{number}", "scene_token": "scene", "timestamp": frame.stamp.timestamp_ns // 1000}
        for number, frame in enumerate(frames)
    ]
    tables["category"] = [{"token": f"g{name}", "name": T4_NAMES.get(name, name)} for name in classes]
    tables["attribute"] = [{"token": "a", "name": "vehicle_state.parked"}]
    tables["visibility"] = [{"token": "v", "level": "most"}]
    tables["instance"] = [{"token": f"i{i}", "category_token": f"g{name}"} for i, name in things.items()]
    seen = [set(frame.ground_truth.instances.tolist()) for frame in frames]
    for number, frame in enumerate(frames):
        data = {"LIDAR_CONCAT": (frame.stamp.timestamp_ns, frame.world_from_ego.matrix, "x.pcd.bin", (0, 0))}
        for name, image in frame.images.items():
            file = f"data/{name}/{number}.jpg"
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(image.encoded)
            size = (rig[name].width, rig[name].height)
            data[name] = (image.timestamp_ns, frame.world_from_ego_at[name].matrix, file, size)
        for name, (time, pose, file, (width, height)) in data.items():
            token = f"d{name}{number}"
            tables["ego_pose"].append({"token": token, "timestamp": time // 1000, **_t4_pose(pose)})
            tables["sample_data"].append(
                {"token": token, "ego_pose_token": token, "sample_token": f"k{number}", "is_key_frame": True}
                | {"calibrated_sensor_token": f"c{name}", "timestamp": time // 1000, "filename": file}
                | {"width": width, "height": height}
            )
        boxes = frame.ground_truth
        for row, (instance, pose) in enumerate(zip(boxes.instances.tolist(), _box_poses(boxes), strict=True)):
            before = f"b{instance}.{number - 1}" if number and instance in seen[number - 1] else ""
            after = f"b{instance}.{number + 1}" if number + 1 < len(frames) and instance in seen[number + 1] else ""
            tables["sample_annotation"].append(
                {"token": f"b{instance}.{number}", "sample_token": f"k{number}", "instance_token": f"i{instance}"}
                | {"attribute_tokens": ["a"], "visibility_token": "v", "size": boxes.sizes_lwh[row][[1, 0, 2]].tolist()}
                | {"num_lidar_pts": 7, "num_radar_pts": 0, "prev": before, "next": after, **_t4_pose(pose)}
            )
    for name, rows in tables.items():
        _write_json(folder / "annotation" / f"{name}.json", rows)
    _write_json(folder / "status.json", {})


@dataclass(frozen=True)
class WrittenFormat:
    """A format and its writer.

    Attributes:
        write: the frames and the folder.
        mapping: "module:attribute" of the classes of its categories.
        options: of the format, for what the writer writes.
    """

    write: Callable[[Sequence[Frame], Path], None]
    mapping: str
    options: dict[str, Any]


WRITTEN = {
    "dgp": WrittenFormat(write_dgp, "bevcli.workshop.formats.dgp:CLASS_OF_CATEGORY", {}),
    "argoverse2": WrittenFormat(
        write_argoverse2, "bevcli.workshop.formats.argoverse2:CLASS_OF_CATEGORY", {"distorted": True}
    ),
    "t4": WrittenFormat(write_t4, "bevcli.workshop.formats.nuscenes:T4_CLASS_OF_CATEGORY", {}),
}
