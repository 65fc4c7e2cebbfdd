"""Healthy rigs as the content of calibration.json, made with SciPy's rotations only."""

from copy import deepcopy

import numpy as np
from scipy.spatial.transform import Rotation

AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # columns: a level camera's right, down, forward in ego


def camera(place, yaw, focal, size=(1600, 900), pitch=0.0, roll=0.0, distortion=None):
    """Angles in degrees; pitch up, focal length in pixels; the principal point is a little off the middle."""
    rotation = Rotation.from_euler("z", yaw, degrees=True) * Rotation.from_matrix(AHEAD)
    rotation = rotation * Rotation.from_euler("x", pitch, degrees=True) * Rotation.from_euler("z", roll, degrees=True)
    x, y, z, w = rotation.as_quat()
    document = {
        "width": size[0],
        "height": size[1],
        "intrinsics": [[focal, 0.0, size[0] * 0.515], [0.0, focal, size[1] * 0.52], [0.0, 0.0, 1.0]],
        "ego_from_camera": {"translation": list(place), "rotation_wxyz": [w, x, y, z]},
    }
    if distortion:
        document["distortion"] = {"model": distortion[0], "coefficients": list(distortion[1])}
    return document


def rig(**cameras):
    """A calibration with a bev frame as nuScenes': x right, y forward."""
    return {
        "format": "bevcli-calibration/1",
        "ego_from_bev": {"translation": [0.94, 0.0, 1.84], "rotation_wxyz": [0.5**0.5, 0, 0, -(0.5**0.5)]},
        "cameras": cameras,
    }


SIX = rig(
    CAM_FRONT=camera((1.70, 0.01, 1.51), 0.4, 1260, pitch=0.5, roll=0.6),
    CAM_FRONT_RIGHT=camera((1.55, -0.49, 1.50), -56, 1260, pitch=0.2, roll=0.8),
    CAM_FRONT_LEFT=camera((1.52, 0.49, 1.51), 55, 1270, pitch=0.9, roll=0.2),
    CAM_BACK=camera((0.03, 0.0, 1.57), 179.5, 800, pitch=0.4, roll=-0.6),
    CAM_BACK_LEFT=camera((1.04, 0.48, 1.59), 108, 1260, pitch=1.1, roll=0.1),
    CAM_BACK_RIGHT=camera((1.05, -0.48, 1.56), -110, 1260, pitch=0.7),
)
FISHEYE = ("kannala_brandt", (0.05, -0.01, 0.002, -0.0005))
BARREL = ("brown_conrady", (-0.32, 0.12, 0.001, -0.0005, -0.02))

HEALTHY = {
    "six": SIX,
    "one": rig(dashcam=camera((1.4, 0.1, 1.3), 0.0, 1000, (1920, 1080), pitch=-4, distortion=BARREL)),
    "four fisheyes": rig(
        front=camera((3.7, 0.0, 0.65), 0, 340, (1280, 960), pitch=-25, distortion=FISHEYE),
        left=camera((2.0, 1.0, 1.0), 90, 340, (1280, 960), pitch=-55, distortion=FISHEYE),
        right=camera((2.0, -1.0, 1.0), -90, 340, (1280, 960), pitch=-55, distortion=FISHEYE),
        rear=camera((-0.9, 0.0, 0.9), 180, 340, (1280, 960), pitch=-30, distortion=FISHEYE),
    ),
    "five": rig(
        FRONT=camera((1.5, 0.0, 2.1), 0, 2050, (1920, 1280)),
        FRONT_LEFT=camera((1.5, 0.1, 2.1), 45, 2050, (1920, 1280)),
        FRONT_RIGHT=camera((1.5, -0.1, 2.1), -45, 2050, (1920, 1280)),
        SIDE_LEFT=camera((1.4, 0.15, 2.1), 90, 2050, (1920, 886)),
        SIDE_RIGHT=camera((1.4, -0.15, 2.1), -90, 2050, (1920, 886)),
    ),
    "seven": rig(
        ring_front_center=camera((1.6, 0.0, 1.4), 0, 1780, (1550, 2048)),
        ring_front_left=camera((1.5, 0.2, 1.4), 45, 1680, (2048, 1550)),
        ring_front_right=camera((1.5, -0.2, 1.4), -45, 1680, (2048, 1550)),
        ring_side_left=camera((1.3, 0.3, 1.4), 99, 1680, (2048, 1550)),
        ring_side_right=camera((1.3, -0.3, 1.4), -99, 1680, (2048, 1550)),
        ring_rear_left=camera((1.1, 0.2, 1.4), 153, 1680, (2048, 1550)),
        ring_rear_right=camera((1.1, -0.2, 1.4), -153, 1680, (2048, 1550)),
    ),
    "lorry": rig(
        cab_front=camera((4.9, 0.0, 3.2), 0, 1100, (1920, 1080), pitch=-12),
        tele_front=camera((4.9, 0.1, 3.2), 0, 4200, (1920, 1080), pitch=-2),
        mirror_left=camera((4.5, 1.4, 2.8), 150, 1000, (1920, 1080), pitch=-15),
        mirror_right=camera((4.5, -1.4, 2.8), -150, 1000, (1920, 1080), pitch=-15),
    ),
    "numbered": rig(**{f"cam{i}": camera((1.0, 0.0, 1.6), 72.0 * i, 900, (1280, 720), pitch=-3) for i in range(5)}),
}


def copy_of(name):
    """A healthy rig's document, to plant mistakes in."""
    return deepcopy(HEALTHY[name])
