"""Checks of camera names against poses: a name such as CAM_BACK_LEFT states a viewing direction."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from scipy.optimize import linear_sum_assignment

from bevcli.findings import Finding
from bevcli.geometry.cameras import Camera
from bevcli.rig.mounting import mounting_of, seen_fov_deg

WORDS = {"front": "front", "forward": "front", "fwd": "front", "back": "back", "rear": "back", "backward": "back"}
# Centre of each sector, degrees counter-clockwise from straight ahead.
SECTORS = {
    ("front", ""): 0.0, ("front", "left"): 50.0, ("", "left"): 90.0, ("back", "left"): 130.0, ("back", ""): 180.0,
    ("back", "right"): -130.0, ("", "right"): -90.0, ("front", "right"): -50.0,
}  # fmt: skip
CONTRADICTION_DEG = 95.0  # a larger angle between name and pose is a contradiction
SWAP_GAIN_DEG = 60.0  # names are swapped if a permutation reduces the summed angle by at least this
EGO_TURN_DEG = (60.0, 35.0)  # all cameras turned by at least the first; their turns differ by at most the second
SAME_PLACE_M, SAME_DIRECTION_DEG = 0.02, 1.0
SAME_FOV = 0.2  # relative; one place may hold a wide and a tele camera, which differ by more


def direction_of_name(name: str) -> float | None:
    """Viewing direction that a name such as "CAM_BACK_LEFT" or "rearRight" states.

    Degrees counter-clockwise from straight ahead; None if the name states none, or a contradiction.
    """
    words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())
    ends = {end for word, end in WORDS.items() if _contains(words, word)}
    sides = {side for side in ("left", "right") if _contains(words, side)}
    if len(ends) > 1 or len(sides) > 1:
        return None
    return SECTORS.get(("".join(ends), "".join(sides)))


def turn_deg(a: float, b: float) -> float:
    """The angle between two directions in degrees, 0 to 180."""
    return abs((a - b + 180.0) % 360.0 - 180.0)


def side_of(yaw_deg: float) -> str:
    """The side of the vehicle that a direction points to, such as "back left"."""
    centers = {"ahead": 0, "front left": 50, "left": 90, "back left": 130, "back": 180}
    centers |= {"back right": -130, "right": -90, "front right": -50}
    return min(centers, key=lambda side: turn_deg(centers[side], yaw_deg))


def check_names(cameras: Sequence[Camera]) -> tuple[Finding, ...]:
    """Find copied poses, swapped names, and an ego frame whose x axis is not forward; at most one error per camera."""
    copies = _copied_poses(cameras)
    copied = {name for names, _ in copies for name in names}
    stated = {c.name: direction_of_name(c.name) for c in cameras if c.name not in copied}
    named = {name: direction for name, direction in stated.items() if direction is not None}
    yaws = {camera.name: mounting_of(camera.ego_from_camera).yaw_deg for camera in cameras}
    findings = tuple(finding for _, finding in copies)
    turned = _turned_ego_frame(named, yaws)
    return findings + ((turned,) if turned else _swapped_names(named, yaws))


def _contains(words: Sequence[str], word: str) -> bool:
    return any(part.startswith(word) or part.endswith(word) for part in words)


def _copied_poses(cameras: Sequence[Camera]) -> list[tuple[tuple[str, str], Finding]]:
    """Pairs of cameras with the same pose and field of view."""
    found = []
    for a, b in combinations(cameras, 2):
        distance = float(np.linalg.norm(a.ego_from_camera[:3, 3] - b.ego_from_camera[:3, 3]))
        cosine = np.clip((np.trace(a.ego_from_camera[:3, :3].T @ b.ego_from_camera[:3, :3]) - 1) / 2, -1, 1)
        turn = float(np.degrees(np.arccos(cosine)))
        fov_a, fov_b = seen_fov_deg(a)[0], seen_fov_deg(b)[0]
        same_fov = abs(fov_a - fov_b) <= SAME_FOV * max(fov_a, fov_b)
        if distance < SAME_PLACE_M and turn < SAME_DIRECTION_DEG and same_fov:
            finding = Finding(
                "same-pose", "error", b.name, f"has the same pose as {a.name}",
                f"{distance:.3f} m and {turn:.2f}° apart", "different positions or viewing directions",
                "one pose is a copy of the other: give each camera its own",
            )  # fmt: skip
            found.append(((a.name, b.name), finding))
    return found


def _turned_ego_frame(named: Mapping[str, float], yaws: Mapping[str, float]) -> Finding | None:
    """All cameras turned by about the same angle from their names: x of the ego frame is not forward."""
    if len(named) < 3:
        return None
    turns = np.exp(1j * np.radians([yaws[name] - named[name] for name in named]))
    turn = float(np.degrees(np.angle(turns.mean())))
    spread = max(turn_deg(float(np.degrees(np.angle(one))), turn) for one in turns)
    if abs(turn) < EGO_TURN_DEG[0] or spread > EGO_TURN_DEG[1]:
        return None
    return Finding(
        "ego-axes", "error", None, "all cameras are turned by the same angle from the directions in their names",
        f"turned by {turn:.0f}°", "0° ± 35°", "the ego frame is x forward, y left, z up: rotate the poses into it",
    )  # fmt: skip


def _swapped_names(named: Mapping[str, float], yaws: Mapping[str, float]) -> tuple[Finding, ...]:
    """One finding if exchanging names makes them fit the poses; else one for each name that contradicts its pose."""
    names = list(named)
    if not names:
        return ()
    cost = np.array([[turn_deg(named[name], yaws[owner]) for owner in names] for name in names])
    rows, owners = linear_sum_assignment(cost)
    gain = float(np.trace(cost) - cost[rows, owners].sum())
    moved = [names[row] for row, owner in zip(rows, owners, strict=True) if row != owner]
    if moved and gain >= SWAP_GAIN_DEG:
        return (_swap_finding(moved, named, yaws),)
    contradicted = [name for name in names if turn_deg(named[name], yaws[name]) > CONTRADICTION_DEG]
    return tuple(
        Finding(
            "name-against-pose", "error", name, "the name and the pose state different directions",
            f"looks {_direction_text(yaws[name])}", _direction_text(named[name]),
            "check which camera this calibration belongs to",
        )
        for name in contradicted
    )  # fmt: skip


def _swap_finding(moved: Sequence[str], named: Mapping[str, float], yaws: Mapping[str, float]) -> Finding:
    names = f"{', '.join(moved[:-1])} and {moved[-1]}"
    return Finding(
        "swapped-names", "error", moved[0], f"the names or poses of {names} are swapped",
        "; ".join(f"{name} looks {_direction_text(yaws[name])}" for name in moved),
        "; ".join(_direction_text(named[name]) for name in moved),
        "exchange the poses, or the names",
    )  # fmt: skip


def _direction_text(yaw_deg: float) -> str:
    """A direction as text, such as "back left (109°)"."""
    return f"{side_of(yaw_deg)} ({yaw_deg:.0f}°)"
