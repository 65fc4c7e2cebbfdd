"""What a camera's name says about where it looks, against where its pose looks."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from scipy.optimize import linear_sum_assignment

from bevcli.findings import Finding
from bevcli.geometry.cameras import Camera
from bevcli.rig.pose import mounting_of, seen_fov_deg

WORDS = {"front": "front", "forward": "front", "fwd": "front", "back": "back", "rear": "back", "backward": "back"}
# Sectors' middles in degrees counter-clockwise from straight ahead.
SECTORS = {
    ("front", ""): 0.0, ("front", "left"): 50.0, ("", "left"): 90.0, ("back", "left"): 130.0, ("back", ""): 180.0,
    ("back", "right"): -130.0, ("", "right"): -90.0, ("front", "right"): -50.0,
}  # fmt: skip
CONTRADICTION_DEG = 95.0  # a name and a pose further apart than this cannot both be right
SWAP_GAIN_DEG = 60.0  # by how much the names must fit better after a swap
EGO_TURN_DEG = (60.0, 35.0)  # all cameras turned by more than the first, and alike to within the second
SAME_PLACE_M, SAME_DIRECTION_DEG = 0.02, 1.0
SAME_FOV = 0.2  # two cameras in one place may be a wide one and a tele: alike by this share they are one twice


def direction_of_name(name: str) -> float | None:
    """Degrees counter-clockwise from ahead that a name as "CAM_BACK_LEFT" or "rearRight" says; None if it says none."""
    words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())
    ends = {end for word, end in WORDS.items() if _says(words, word)}
    sides = {side for side in ("left", "right") if _says(words, side)}
    if len(ends) > 1 or len(sides) > 1:
        return None
    return SECTORS.get(("".join(ends), "".join(sides)))


def turn_deg(a: float, b: float) -> float:
    """The angle between two directions in degrees, 0 to 180."""
    return abs((a - b + 180.0) % 360.0 - 180.0)


def check_names(cameras: Sequence[Camera]) -> tuple[Finding, ...]:
    """Cameras twice, names swapped, an ego frame whose x does not point ahead; at most one of these per camera."""
    twice = _same_poses(cameras)
    doubled = {name for names, _ in twice for name in names}
    said = {c.name: direction_of_name(c.name) for c in cameras if c.name not in doubled}
    named = {name: direction for name, direction in said.items() if direction is not None}
    looks = {camera.name: mounting_of(camera.ego_from_camera).yaw_deg for camera in cameras}
    findings = tuple(finding for _, finding in twice)
    turned = _ego_turn(named, looks)
    return findings + ((turned,) if turned else _swaps(named, looks))


def _says(words: Sequence[str], word: str) -> bool:
    return any(part == word or part.startswith(word) or part.endswith(word) for part in words)


def _same_poses(cameras: Sequence[Camera]) -> list[tuple[tuple[str, str], Finding]]:
    found = []
    for a, b in combinations(cameras, 2):
        apart = float(np.linalg.norm(a.ego_from_camera[:3, 3] - b.ego_from_camera[:3, 3]))
        between = np.clip((np.trace(a.ego_from_camera[:3, :3].T @ b.ego_from_camera[:3, :3]) - 1) / 2, -1, 1)
        turned = float(np.degrees(np.arccos(between)))
        fov_a, fov_b = seen_fov_deg(a)[0], seen_fov_deg(b)[0]
        if apart < SAME_PLACE_M and turned < SAME_DIRECTION_DEG and abs(fov_a - fov_b) <= SAME_FOV * max(fov_a, fov_b):
            finding = Finding(
                "same-pose", "error", b.name, f"has the same pose as {a.name}",
                f"{apart:.3f} m and {turned:.2f}° apart", "two places or two directions",
                "one of the two was copied: give it its own pose",
            )  # fmt: skip
            found.append(((a.name, b.name), finding))
    return found


def _ego_turn(named: Mapping[str, float], looks: Mapping[str, float]) -> Finding | None:
    """All cameras turned by one angle: the ego frame's x does not point ahead."""
    if len(named) < 3:
        return None
    turns = np.exp(1j * np.radians([looks[name] - named[name] for name in named]))
    turn = float(np.degrees(np.angle(turns.mean())))
    spread = max(turn_deg(float(np.degrees(np.angle(one))), turn) for one in turns)
    if abs(turn) < EGO_TURN_DEG[0] or spread > EGO_TURN_DEG[1]:
        return None
    return Finding(
        "ego-axes", "error", None, "all cameras look in directions turned from what their names say",
        f"turned by {turn:.0f}°", "0° ± 35°", "the ego frame is x forward, y left, z up; turn the poses into it",
    )  # fmt: skip


def _swaps(named: Mapping[str, float], looks: Mapping[str, float]) -> tuple[Finding, ...]:
    names = list(named)
    if not names:
        return ()
    cost = np.array([[turn_deg(named[name], looks[owner]) for owner in names] for name in names])
    rows, owners = linear_sum_assignment(cost)
    gain = float(np.trace(cost) - cost[rows, owners].sum())
    moved = [names[row] for row, owner in zip(rows, owners, strict=True) if row != owner]
    if moved and gain >= SWAP_GAIN_DEG:
        return (_swap_finding(moved, named, looks),)
    contradicted = [name for name in names if turn_deg(named[name], looks[name]) > CONTRADICTION_DEG]
    return tuple(
        Finding(
            "name-against-pose", "error", name, "the name says another direction than the pose",
            f"looks {words_of(looks[name])}", f"{words_of(named[name])}",
            "check which camera this calibration belongs to",
        )
        for name in contradicted
    )  # fmt: skip


def _swap_finding(moved: Sequence[str], named: Mapping[str, float], looks: Mapping[str, float]) -> Finding:
    names = f"{', '.join(moved[:-1])} and {moved[-1]}"
    return Finding(
        "swapped-names", "error", moved[0], f"{names} have their names swapped, as their poses look",
        "; ".join(f"{name} looks {words_of(looks[name])}" for name in moved),
        "; ".join(f"{words_of(named[name])}" for name in moved),
        "swap the poses back, or the names",
    )  # fmt: skip


def words_of(yaw_deg: float) -> str:
    """A direction as a person says it: "back left (109°)"."""
    return f"{side_of(yaw_deg)} ({yaw_deg:.0f}°)"


def side_of(yaw_deg: float) -> str:
    """Where a direction points: "back left"."""
    middles = {"ahead": 0, "front left": 50, "left": 90, "back left": 130, "back": 180}
    middles |= {"back right": -130, "right": -90, "front right": -50}
    return min(middles, key=lambda word: turn_deg(middles[word], yaw_deg))
