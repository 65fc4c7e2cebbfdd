"""Drives whose stated calibration is wrong by a known amount."""

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from bevcli.frame import DerivedDrive, Drive, Frame
from bevcli.geometry.cameras import Camera, CameraRig, Distortion
from bevcli.geometry.transforms import rigid


class ThroughLens(DerivedDrive):
    """A drive of cameras without distortion, as lenses would have shown it; `zoom` keeps their images filled."""

    def __init__(self, sequence: Drive, lens: Distortion, zoom: float = 1.0) -> None:
        super().__init__(sequence)
        self.rig = replace(self.rig, cameras=tuple(_with_lens(each, lens, zoom) for each in self.rig.cameras))

    def load(self, index: int) -> Frame:
        frame = self.drive.load(index)
        images = {}
        for plain, camera in zip(self.drive.rig.cameras, self.rig.cameras, strict=True):
            pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
            source = plain.project(camera.rays(pixels))[0].astype(np.float32)
            seen = frame.images[camera.name]
            bent = cv2.remap(seen.pixels_bgr, source[..., 0], source[..., 1], cv2.INTER_CUBIC)
            images[camera.name] = replace(seen, pixels_bgr=bent)
        return replace(frame, rig=self.rig, images=images)


def _with_lens(camera: Camera, lens: Distortion, zoom: float) -> Camera:
    return replace(camera, distortion=lens, intrinsics=camera.intrinsics * [[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]])


def wrong_rig(rig: CameraRig, camera: str, turn_deg: tuple[float, float, float], shift_m: tuple) -> CameraRig:
    """The rig with one camera turned about its own axes (right, down, forward) and shifted in the ego frame."""
    changed = []
    for each in rig.cameras:
        if each.name == camera:
            pose = each.ego_from_camera @ rigid(rotation=Rotation.from_rotvec(turn_deg, degrees=True).as_matrix())
            each = replace(each, ego_from_camera=rigid(shift_m) @ pose)
        changed.append(each)
    return replace(rig, cameras=tuple(changed))


def angle_deg(a: CameraRig, b: CameraRig, camera: str) -> float:
    """The angle between the rotations of a camera in two rigs."""
    relative = a[camera].ego_from_camera[:3, :3].T @ b[camera].ego_from_camera[:3, :3]
    return float(np.degrees(Rotation.from_matrix(relative).magnitude()))


def distance_m(a: CameraRig, b: CameraRig, camera: str) -> float:
    """The distance between the positions of a camera in two rigs."""
    return float(np.linalg.norm(a[camera].ego_from_camera[:3, 3] - b[camera].ego_from_camera[:3, 3]))
