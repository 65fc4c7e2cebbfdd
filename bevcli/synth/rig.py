"""The default rig: six cameras as nuScenes' vehicles carry them, with rounded numbers."""

from __future__ import annotations

import numpy as np

from bevcli.geometry.cameras import Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.transforms import Array, rigid, rotation_about_z

# name: x, y, z in ego (m), yaw (degrees), focal length (px at 1600 x 900)
_MOUNTS = {
    "CAM_FRONT": (1.72, 0.0, 1.50, 0.0, 1266.0),
    "CAM_FRONT_RIGHT": (1.58, -0.50, 1.51, -56.0, 1260.0),
    "CAM_FRONT_LEFT": (1.58, 0.50, 1.51, 56.0, 1260.0),
    "CAM_BACK": (0.05, 0.0, 1.57, 180.0, 809.0),
    "CAM_BACK_LEFT": (1.05, 0.48, 1.56, 109.0, 1256.0),
    "CAM_BACK_RIGHT": (1.05, -0.48, 1.56, -111.0, 1256.0),
}
_EGO_AXES_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def nuscenes_like_rig(width: int = 1600, height: int = 900) -> CameraRig:
    """Six level cameras around the vehicle, for pictures of this size; a wider picture sees no more."""
    cameras = []
    for name, (x, y, z, yaw_deg, focal) in _MOUNTS.items():
        intrinsics: Array = np.array([[focal, 0, 800.0], [0, focal, 450.0], [0, 0, 1.0]])
        rotation = rotation_about_z(np.radians(yaw_deg)) @ _EGO_AXES_FROM_CAMERA
        camera = Camera(name, 1600, 900, intrinsics, rigid((x, y, z), rotation))
        cameras.append(camera.scaled(width / 1600, height / 900))
    return CameraRig(tuple(cameras), default_ego_from_bev())
