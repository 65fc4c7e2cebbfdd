"""A true drive as other programs state it: axes, directions, rotations, units and origins of its rig and poses."""

import json
import random
import re
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from bevcli.frame import Drive
from bevcli.sequences.open import open_sequence

EGO_FROM_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
EGO_FROM = {
    "flu": np.eye(3), "frd": np.diag([1.0, -1, -1]), "rfu": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "ruf": np.array([[0.0, 0, 1], [-1, 0, 0], [0, 1, 0]]),
}  # fmt: skip
OPTICAL_FROM = {"optical": np.eye(3), "opengl": np.diag([1.0, -1, -1]), "unity": np.diag([1.0, -1, 1])}
UNITS = {"m": 1, "cm": 100, "mm": 1000}
CHOICES = {
    "rig_axes": ("flu", "frd", "rfu"), "transform": ("T_ego_cam", "T_cam_ego", "T"),
    "rotation": ("matrix", "quaternion", "vector", "rpy"), "unit": ("m", "mm", "cm"), "origin_m": (0.0, 0.55),
    "body": ("flu", "frd", "camera"), "pose_transform": ("world_from_body", "body_from_world"),
    "file": ("tum", "kitti", "yaw"),
}  # fmt: skip
WORST = 1.0, 0.05, 0.03, 0.02  # degrees, metres of cameras, metres of a step, and share of it


@dataclass(frozen=True)
class Convention:
    """How a program states a drive; the defaults are those of bevcli."""

    rig_axes: str = "flu"
    camera_axes: str = "optical"
    transform: str = "T_ego_cam"
    rotation: str = "matrix"
    unit: str = "m"
    origin_m: float = 0.0  # of the rig, above the ground
    body: str = "flu"
    pose_transform: str = "world_from_body"
    file: str = "tum"

    @classmethod
    def drawn(cls, seed: int) -> "Convention":
        """One of all conventions."""
        generator = random.Random(seed)
        drawn = cls(**{name: generator.choice(choices) for name, choices in CHOICES.items()})
        if drawn.file == "yaw":  # of the vehicle in the world
            return replace(drawn, body=generator.choice(("flu", "frd")), pose_transform="world_from_body")
        return drawn


def rigid(rotation, translation=(0, 0, 0)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def write(truth: Drive, folder: Path, convention: Convention, names=None) -> dict[str, Path]:
    """Write images, rig and poses; the options that open them. names: other names of the cameras."""
    names = names or {name: name for name in truth.rig.names}
    for index, stamp in enumerate(truth.stamps):
        for file in truth.image_files(index):
            path = folder / "drive/images" / names[file.parent.name] / f"{stamp.timestamp_ns}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, path)
    rig = {
        names[camera.name]: {
            "K": camera.intrinsics.tolist(), "width": camera.width, "height": camera.height,
            **_pose(camera.ego_from_camera, convention),
        }
        for camera in truth.rig.cameras
    }  # fmt: skip
    (folder / "rig.json").write_text(json.dumps(rig))
    (folder / "poses.txt").write_text(_poses(truth, convention))
    return {"calibration": folder / "rig.json", "ego_motion_file": folder / "poses.txt"}


def _pose(ego_from_camera: np.ndarray, convention: Convention) -> dict[str, object]:
    lowered = rigid(np.eye(3), (0, 0, -convention.origin_m)) @ ego_from_camera
    matrix = rigid(EGO_FROM[convention.rig_axes].T) @ lowered @ rigid(OPTICAL_FROM[convention.camera_axes])
    if convention.rotation == "rpy" and convention.rig_axes == "flu":  # of the body of the camera
        matrix = matrix @ rigid(EGO_FROM_OPTICAL.T)
    elif convention.transform != "T_ego_cam" and convention.rotation != "rpy":
        matrix = np.linalg.inv(matrix)
    translation, rotation = (matrix[:3, 3] * UNITS[convention.unit]).tolist(), Rotation.from_matrix(matrix[:3, :3])
    if convention.rotation == "matrix":
        return {convention.transform: rigid(matrix[:3, :3], translation).tolist()}
    if convention.rotation == "quaternion":
        return {"rotation": np.roll(rotation.as_quat(), 1).tolist(), "translation": translation}
    if convention.rotation == "vector":
        return {"rotation": rotation.as_rotvec().tolist(), "translation": translation}
    order = "YXZ" if convention.rotation == "unity" else "ZYX"
    angles = dict(zip(("yaw", "pitch", "roll"), rotation.as_euler(order, degrees=True).tolist(), strict=True))
    return angles | dict(zip("xyz", translation, strict=True))


def _poses(truth: Drive, convention: Convention) -> str:
    times = [stamp.timestamp_ns for stamp in truth.stamps]
    poses = np.stack([truth.ego_motion.pose_at(time).matrix for time in times])
    camera = truth.rig.cameras[0].ego_from_camera
    body = camera if convention.body == "camera" else rigid(EGO_FROM[convention.body])
    poses = np.linalg.inv(body) @ np.linalg.inv(poses[0]) @ poses @ body
    if convention.pose_transform == "body_from_world":
        poses = np.linalg.inv(poses)
    lines = ["time,x,y,z,roll,pitch,yaw"] if convention.file == "yaw" else []
    for time, pose in zip(times, poses, strict=True):
        rotation = Rotation.from_matrix(pose[:3, :3])
        if convention.file == "kitti":
            numbers, sign, head = pose[:3].ravel(), " ", []
        elif convention.file == "tum":
            numbers, sign, head = [*pose[:3, 3], *rotation.as_quat()], " ", [f"{time / 1e9:.6f}"]
        else:
            numbers, sign, head = [*pose[:3, 3], *rotation.as_euler("xyz", degrees=True)], ",", [f"{time / 1e9:.6f}"]
        lines.append(sign.join([*head, *(f"{number:.9f}" for number in numbers)]))
    return "\n".join(lines) + "\n"


def opened(folder: Path, options: dict[str, Path], **stated: object) -> Drive:
    """The drive that was written."""
    return open_sequence(folder / "drive", rate_hz="all", **options, **stated)


def wrong(found: Drive, truth: Drive) -> str:
    """What is not as in the truth, in words; "" where all is right."""
    for camera, true in zip(sorted(found.rig.names), sorted(truth.rig.names), strict=True):
        pose, stated = found.rig[camera].ego_from_camera, truth.rig[true].ego_from_camera
        turn = np.degrees(Rotation.from_matrix(pose[:3, :3].T @ stated[:3, :3]).magnitude())
        moved = np.linalg.norm(pose[:3, 3] - stated[:3, 3])
        if turn > WORST[0] or moved > WORST[1]:
            return f"{camera} is turned by {turn:.1f} degrees and moved by {moved:.2f} m"
    ways = []
    for drive in (found, truth):
        poses = np.stack([drive.ego_motion.pose_at(stamp.timestamp_ns).matrix for stamp in drive.stamps])
        ways.append(np.linalg.inv(poses[:-1]) @ poses[1:])
    for step, true in zip(*ways, strict=True):
        turn = np.degrees(Rotation.from_matrix(step[:3, :3].T @ true[:3, :3]).magnitude())
        moved = np.linalg.norm(step[:3, 3] - true[:3, 3])
        if turn > WORST[0] or moved > WORST[2] + WORST[3] * np.linalg.norm(true[:3, 3]):
            return f"a step is turned by {turn:.1f} degrees and moved by {moved:.2f} m"
    return ""


def choices_of(error: Exception) -> list[dict[str, object]]:
    """The options that a question names, each of which is an answer."""
    found = [choice.split() for choice in re.findall("`(--[^`]*)`", str(error))]
    return [
        {flag[2:].replace("-", "_"): float(value) if flag == "--height" else value
         for flag, value in zip(words[::2], words[1::2], strict=True)}
        for words in found
    ]  # fmt: skip
