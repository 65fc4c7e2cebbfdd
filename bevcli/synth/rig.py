"""The rigs that are rendered: the default one, six cameras like those of nuScenes, or one from a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.transforms import Array, rigid, rotation_about_z
from bevcli.sequences.files.calibration_file import read_calibration
from bevcli.synth.render.lens import distortion_maps

# name: x, y, z in the ego frame (metres), yaw (degrees), focal length (pixels at 1600 x 900)
_MOUNTS = {
    "CAM_FRONT": (1.72, 0.0, 1.50, 0.0, 1266.0),
    "CAM_FRONT_RIGHT": (1.58, -0.50, 1.51, -56.0, 1260.0),
    "CAM_FRONT_LEFT": (1.58, 0.50, 1.51, 56.0, 1260.0),
    "CAM_BACK": (0.05, 0.0, 1.57, 180.0, 809.0),
    "CAM_BACK_LEFT": (1.05, 0.48, 1.56, 109.0, 1256.0),
    "CAM_BACK_RIGHT": (1.05, -0.48, 1.56, -111.0, 1256.0),
}
EGO_AXES_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # of one that looks ahead


def nuscenes_like_rig(width: int = 1600, height: int = 900) -> CameraRig:
    """Six horizontal cameras around the vehicle. width, height: of the images, pixels; the fields of view stay."""
    cameras = []
    for name, (x, y, z, yaw_deg, focal) in _MOUNTS.items():
        intrinsics: Array = np.array([[focal, 0, 800.0], [0, focal, 450.0], [0, 0, 1.0]])
        rotation = rotation_about_z(np.radians(yaw_deg)) @ EGO_AXES_FROM_CAMERA
        camera = Camera(name, 1600, 900, intrinsics, rigid((x, y, z), rotation))
        cameras.append(camera.scaled(width / 1600, height / 900))
    return CameraRig(tuple(cameras), default_ego_from_bev())


def rig_for_rendering(rig: str | Path | CameraRig | None, size: tuple[int, int] | None) -> CameraRig:
    """The cameras to render.

    rig: a rig, or the path of a calibration.json; default: `nuscenes_like_rig`. size: width and height of the images,
    pixels; default: that of the rig.
    Raises InputError where the file is wrong, or a camera with distortion has too wide a field of view.
    """
    if rig is None:
        where, found = "", nuscenes_like_rig()
    elif isinstance(rig, CameraRig):
        where, found = "rig: ", rig
    else:
        where, found = f"{rig}: ", read_calibration(Path(rig))
    if size is not None:
        cameras = tuple(c.scaled(size[0] / c.width, size[1] / c.height) for c in found.cameras)
        found = CameraRig(cameras, found.ego_from_bev, found.ego_from_bev_assumed)
    for camera in found.cameras:
        if camera.distortion is not None:
            try:
                distortion_maps(camera)
            except InputError as error:
                raise InputError(f"{where}camera {camera.name}: {error}") from None
    return found
