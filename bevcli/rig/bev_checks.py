"""Checks of the bev frame.

Published weights expect nuScenes' LIDAR_TOP: x right, y forward, 1.84 m above the ground.
"""

import numpy as np

from bevcli.findings import Finding, rig_error
from bevcli.geometry.transforms import Array, inverse, rigid
from bevcli.rig.pose_checks import reordered, units_per_metre

HEIGHT_M = 1.84  # of LIDAR_TOP in nuScenes
HEIGHT_ERROR_M, HEIGHT_WARNING_M = 1.2, 0.4
TILT_ERROR_DEG, TILT_WARNING_DEG = 15.0, 6.0
TILT_INFO_DEG = 1.0  # the demo model's training drives are level; nuScenes' LIDAR_TOP is tilted by 1 to 3
HEADING_DEG = 20.0
MAX_DISTANCE_M = 6.0


def check_bev_frame(ego_from_bev: Array) -> tuple[Finding, ...]:
    """Findings about ego_from_bev (4, 4): at most one error, or else warnings."""
    unit = units_per_metre(float(np.linalg.norm(ego_from_bev[:3, 3])))
    if unit != 1:
        found, expected = f"{np.linalg.norm(ego_from_bev[:3, 3]):.0f} m from the ego origin", "about (0.94, 0, 1.84) m"
        message = f'the translation of "ego_from_bev" is in {"millimetres" if unit == 1000 else "centimetres"}'
        return (rig_error("translation-unit", message, found, expected, f"divide the translation by {unit:g}"),)
    if _is_plausible(ego_from_bev):
        return _warnings(ego_from_bev)
    return (_mistake(ego_from_bev) or _defect(ego_from_bev),)


def _tilt_deg(ego_from_bev: Array) -> float:
    """Angle between z of the bev frame and straight up, degrees."""
    return float(np.degrees(np.arccos(np.clip(ego_from_bev[2, 2], -1, 1))))


def _heading_deg(ego_from_bev: Array) -> float:
    """Angle of y of the bev frame, degrees counter-clockwise from the vehicle's forward direction; 0 is expected."""
    return float(np.degrees(np.arctan2(ego_from_bev[1, 1], ego_from_bev[0, 1])))


def _is_plausible(pose: Array) -> bool:
    height = abs(pose[2, 3] - HEIGHT_M) <= HEIGHT_ERROR_M
    level = _tilt_deg(pose) <= TILT_ERROR_DEG and abs(_heading_deg(pose)) <= HEADING_DEG
    return bool(height and level and np.hypot(pose[0, 3], pose[1, 3]) <= MAX_DISTANCE_M)


def _mistake(pose: Array) -> Finding | None:
    """The common mistake whose undoing gives a plausible frame."""
    # KITTI, Waymo and Argoverse have x forward: rotated to x right, such a frame is plausible.
    turned = rigid(pose[:3, 3], pose[:3, :3] @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    if _is_plausible(turned):
        message, advice = "has x forward", "rotate it by 90° about z, unless your weights were trained with x forward"
        found, expected = "x forward, y left", "x right, y forward"
        return rig_error("bev-x-forward", f'"ego_from_bev" {message}', found, expected, advice)
    if _is_plausible(inverse(pose)):
        code, message, advice = "transform-inverted", "is bev_from_ego, the inverse", "invert it"
    elif _is_plausible(reordered(pose, 1)) or _is_plausible(reordered(pose, -1)):
        code, advice = "quaternion-order", "put w first"
        message = "has a quaternion that is not in the order w, x, y, z"
    else:
        return None
    found = f"tilt {_tilt_deg(pose):.0f}°, y {_heading_deg(pose):.0f}° from forward, height {pose[2, 3]:.2f} m"
    return rig_error(code, f'"ego_from_bev" {message}', found, "x right, y forward, z up, z 1.84 m", advice)


def _defect(pose: Array) -> Finding:
    """The implausible property of the frame, where no common mistake explains it."""
    if _tilt_deg(pose) > TILT_ERROR_DEG:
        found, advice = f"{_tilt_deg(pose):.0f}°", "z of the bev frame points up"
        return rig_error("bev-tilted", '"ego_from_bev" is tilted', found, "level within 15°", advice)
    if abs(_heading_deg(pose)) > HEADING_DEG:
        message, found = 'y of "ego_from_bev" is not forward', f"y is {_heading_deg(pose):.0f}° to the left"
        return rig_error("bev-axes", message, found, "x right, y forward", "rotate it about z")
    if abs(pose[2, 3] - HEIGHT_M) > HEIGHT_ERROR_M:
        message, found = '"ego_from_bev" is not at the height that the weights expect', f"{pose[2, 3]:.2f} m"
        advice = "give its height above the ground; pillars extend from 4.5 m below this frame to 2.5 m above it"
        return rig_error("bev-height", message, found, f"about {HEIGHT_M} m", advice)
    found, expected = f"{np.hypot(pose[0, 3], pose[1, 3]):.1f} m from the ego origin", f"at most {MAX_DISTANCE_M:g} m"
    return rig_error("bev-far", '"ego_from_bev" is not on the vehicle', found, expected, "check its translation")


def _warnings(pose: Array) -> tuple[Finding, ...]:
    findings = []
    if abs(pose[2, 3] - HEIGHT_M) > HEIGHT_WARNING_M:
        message, found = '"ego_from_bev" is higher or lower than nuScenes\'', f"{pose[2, 3]:.2f} m"
        advice = "place it 1.84 m above the ground"
        findings.append(Finding("bev-height", "warning", None, message, found, f"about {HEIGHT_M} m", advice))
    message, found = '"ego_from_bev" is tilted', f"{_tilt_deg(pose):.1f}°"
    if _tilt_deg(pose) > TILT_WARNING_DEG:
        findings.append(Finding("bev-tilted", "warning", None, message, found, "under 6°", "level it"))
    elif _tilt_deg(pose) > TILT_INFO_DEG:
        expected = "as in training: 1 to 3° in nuScenes, 0° in rendered drives"
        advice = "nothing for the demo model, which levels the frame itself"
        findings.append(Finding("bev-tilted", "info", None, message, found, expected, advice))
    return tuple(findings)
