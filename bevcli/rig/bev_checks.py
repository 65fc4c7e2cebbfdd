"""The bev frame: published weights expect nuScenes' LIDAR_TOP, x right, y forward, 1.84 m above the ground."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bevcli.findings import Finding
from bevcli.geometry.transforms import Array, inverse, rigid
from bevcli.rig.pose_checks import reordered, unit_of

HEIGHT_M = 1.84  # of LIDAR_TOP in nuScenes
HEIGHT_ERROR_M, HEIGHT_WARNING_M = 1.2, 0.4
TILT_ERROR_DEG, TILT_WARNING_DEG = 15.0, 6.0  # nuScenes' own is tilted by 2.7
HEADING_DEG = 20.0
FARTHEST_M = 6.0


def check_bev_frame(ego_from_bev: Array) -> tuple[Finding, ...]:
    """Findings about ego_from_bev (4, 4): one error at most, or warnings."""
    unit = unit_of(float(np.linalg.norm(ego_from_bev[:3, 3])))
    if unit != 1:
        found, expected = f"{np.linalg.norm(ego_from_bev[:3, 3]):.0f} m from the ego origin", "about (0.94, 0, 1.84) m"
        message = f'"ego_from_bev" has its translation in {"millimetres" if unit == 1000 else "centimetres"}'
        return (_error("translation-unit", message, found, expected, f"divide it by {unit:g}"),)
    if _is_good(ego_from_bev):
        return _warnings(ego_from_bev)
    return (_mistake(ego_from_bev) or _defect(ego_from_bev),)


def tilt_deg(ego_from_bev: Array) -> float:
    """Degrees between the bev frame's z and straight up."""
    return float(np.degrees(np.arccos(np.clip(ego_from_bev[2, 2], -1, 1))))


def heading_deg(ego_from_bev: Array) -> float:
    """Degrees counter-clockwise from the vehicle's forward to the bev frame's y, which should be 0."""
    return float(np.degrees(np.arctan2(ego_from_bev[1, 1], ego_from_bev[0, 1])))


def _is_good(pose: Array) -> bool:
    height = abs(pose[2, 3] - HEIGHT_M) <= HEIGHT_ERROR_M
    level = tilt_deg(pose) <= TILT_ERROR_DEG and abs(heading_deg(pose)) <= HEADING_DEG
    return bool(height and level and np.hypot(pose[0, 3], pose[1, 3]) <= FARTHEST_M)


def _mistake(pose: Array) -> Finding | None:
    """The single mistake after whose undoing the frame is as it should be."""
    undoings: tuple[tuple[str, str, str, Callable[[], Array]], ...] = (
        ("transform-inverted", "is bev_from_ego, inverted", "invert it", lambda: inverse(pose)),
        ("quaternion-order", "has a quaternion that is not in the order w, x, y, z", "put w first",
         lambda: reordered(pose, 1)),
        ("quaternion-order", "has a quaternion that is not in the order w, x, y, z", "put w first",
         lambda: reordered(pose, -1)),
    )  # fmt: skip
    # x forward, turned to x right: what a frame of KITTI's, Waymo's or Argoverse's kind lacks
    turned = rigid(pose[:3, 3], pose[:3, :3] @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    if _is_good(turned):
        found, expected = "x forward, y left", "x right, y forward"
        advice = "turn it, unless your weights were trained with x forward"
        return _error("bev-x-forward", '"ego_from_bev" has x forward', found, expected, advice)
    for code, message, advice, undo in undoings:
        if _is_good(undo()):
            return _error(code, f'"ego_from_bev" {message}', _found(pose), "x right, y forward, z up, z 1.84 m", advice)
    return None


def _defect(pose: Array) -> Finding:
    if tilt_deg(pose) > TILT_ERROR_DEG:
        advice = "its z points up"
        return _error("bev-tilted", '"ego_from_bev" is tilted', f"{tilt_deg(pose):.0f}°", "level within 15°", advice)
    if abs(heading_deg(pose)) > HEADING_DEG:
        message, found = '"ego_from_bev" does not have y forward', f"y is {heading_deg(pose):.0f}° to the left"
        return _error("bev-axes", message, found, "x right, y forward", "turn it about z")
    if abs(pose[2, 3] - HEIGHT_M) > HEIGHT_ERROR_M:
        message, found = '"ego_from_bev" is not at the height that the weights expect', f"{pose[2, 3]:.2f} m"
        advice = "heights are above the ground; pillars reach from 4.5 m under this frame to 2.5 m above it"
        return _error("bev-height", message, found, f"about {HEIGHT_M} m", advice)
    found, expected = f"{np.hypot(pose[0, 3], pose[1, 3]):.1f} m from the ego origin", f"at most {FARTHEST_M:g} m"
    return _error("bev-far", '"ego_from_bev" is not on the vehicle', found, expected, "check its translation")


def _warnings(pose: Array) -> tuple[Finding, ...]:
    findings = []
    if abs(pose[2, 3] - HEIGHT_M) > HEIGHT_WARNING_M:
        message, advice = '"ego_from_bev" stands higher or lower than nuScenes\'', "set it 1.84 m above the ground"
        found, expected = f"{pose[2, 3]:.2f} m", f"about {HEIGHT_M} m"
        findings.append(Finding("bev-height", "warning", None, message, found, expected, advice))
    if tilt_deg(pose) > TILT_WARNING_DEG:
        message, found = '"ego_from_bev" is tilted', f"{tilt_deg(pose):.1f}°"
        findings.append(Finding("bev-tilted", "warning", None, message, found, "under 6°", "level it"))
    return tuple(findings)


def _found(pose: Array) -> str:
    return f"tilt {tilt_deg(pose):.0f}°, y {heading_deg(pose):.0f}° from ahead, height {pose[2, 3]:.2f} m"


def _error(code: str, message: str, found: str, expected: str, advice: str) -> Finding:
    return Finding(code, "error", None, message, found, expected, advice)
