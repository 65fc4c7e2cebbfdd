"""Ego-motion that cannot be: units, jumps, and axes that make the vehicle drive sideways or backwards all the time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bevcli.findings import Finding
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.geometry.transforms import Array, rotation_from_quaternion

FASTEST = 70.0  # m/s, 250 km/h
SLOWEST_MOVING = 1.0  # m/s; below, the direction of motion is noise
SPEED_FACTOR = 1.3  # stated speed against the spacing of the poses
MOST_TILT_DEG = 20.0
FORWARD_DEG = 45.0
MOSTLY = 0.8  # this share of the way makes "all the time"
SHORTEST_WAY_M = 5.0  # on less nothing is said about the direction of motion
JUMP_FACTOR = 5.0  # a step so much longer than its neighbours is a jump


@dataclass(frozen=True)
class _Drive:
    """rotations: (T, 3, 3) world_from_ego. steps: (T-1, 3) metres in the world. seconds: (T-1,)."""

    rotations: Array
    translations: Array
    steps: Array
    seconds: Array

    @property
    def speeds(self) -> Array:
        """(T-1,) m/s from the spacing of the poses."""
        return np.linalg.norm(self.steps, axis=1) / self.seconds

    def tilt_deg(self) -> float:
        """The median angle of the ego frame's z against the world's, degrees."""
        return float(np.degrees(np.median(np.arccos(np.clip(self.rotations[:, 2, 2], -1, 1)))))

    def way(self) -> float:
        """Metres driven, without what is noise at rest."""
        return float(np.linalg.norm(self.steps, axis=1)[self.speeds > SLOWEST_MOVING].sum())

    def headings_deg(self) -> Array:
        """(M,) degrees counter-clockwise from ego x of the steps on which the vehicle moves; none on a short way."""
        moving = (self.speeds > SLOWEST_MOVING) & (self.way() >= SHORTEST_WAY_M)
        steps = np.einsum("tji,tj->ti", self.rotations[:-1], self.steps)[moving]
        return np.degrees(np.arctan2(steps[:, 1], steps[:, 0]))

    def is_sane(self) -> bool:
        """Level, not faster than a car, and forward for most of the time."""
        headings = self.headings_deg()
        ahead = len(headings) == 0 or (np.abs(headings) <= FORWARD_DEG).mean() >= MOSTLY
        return bool(self.tilt_deg() <= MOST_TILT_DEG and np.median(self.speeds) <= FASTEST and ahead)


def check_ego_motion(ego_motion: EgoMotion) -> tuple[Finding, ...]:
    """What is wrong with the poses of one scene, or else with its stated speeds; nothing of a single row."""
    drive = _drive(ego_motion, ego_motion.translations, ego_motion.quaternions)
    if len(drive.steps) == 0:
        return ()
    cause = None if drive.is_sane() else _mistake(drive, ego_motion) or _units(drive)
    if cause is not None:
        return (cause,)
    findings = [finding for finding in (_jump(drive, ego_motion), _direction(drive)) if finding is not None]
    speed = None if findings else _stated_speed(drive, ego_motion)
    return (*findings, speed) if speed is not None else tuple(findings)


def _drive(ego_motion: EgoMotion, translations: Array, quaternions: Array) -> _Drive:
    rotations = np.stack([rotation_from_quaternion(quaternion) for quaternion in quaternions])
    seconds = np.diff(ego_motion.timestamps_ns) / 1e9
    return _Drive(rotations, translations, np.diff(translations, axis=0), seconds)


def _units(drive: _Drive) -> Finding | None:
    """Translations in millimetres, or times not in nanoseconds, make every speed absurd."""
    median = float(np.median(drive.speeds))
    if median <= FASTEST:
        return None
    advice = "give metres and nanoseconds; a factor of 1000 or a million points to the unit"
    found, expected = f"{median:.0f} m/s in the middle", f"at most {FASTEST:g} m/s"
    message = "the vehicle is impossibly fast throughout: wrong units of times or translations"
    return Finding("ego-units", "error", None, message, found, expected, advice)


def _jump(drive: _Drive, ego_motion: EgoMotion) -> Finding | None:
    speeds = drive.speeds
    jumps = np.flatnonzero((speeds > FASTEST) & (speeds > JUMP_FACTOR * np.median(speeds)))
    if len(jumps) == 0:
        return None
    first = int(jumps[0])
    found = f"{len(jumps)} of {len(speeds)} steps; {np.linalg.norm(drive.steps[first]):.1f} m in "
    found += f"{drive.seconds[first]:.2f} s at {int(ego_motion.timestamps_ns[first + 1])} ns"
    message, advice = "the vehicle jumps", "start a new scene there, or mend the poses"
    return Finding("ego-jump", "error", None, message, found, f"at most {FASTEST:g} m/s", advice)


def _mistake(drive: _Drive, ego_motion: EgoMotion) -> Finding | None:
    """The mistake after whose undoing the vehicle drives as vehicles do."""
    for code, message, advice, undone in _undone(ego_motion):
        if undone.is_sane():
            return _error(code, message, _words(drive), "level, and ahead", advice)
    return None


def _direction(drive: _Drive) -> Finding | None:
    """Tilted, sideways or backwards all the time."""
    if drive.tilt_deg() > MOST_TILT_DEG:
        message, advice = "the ego frame is tilted in the world", "ego z and world z point up: check the axes"
        return _error("ego-tilted", message, _words(drive), "level", advice)
    headings = drive.headings_deg()
    if len(headings) == 0:
        return None
    ahead = float((np.abs(headings) <= FORWARD_DEG).mean())
    back = float((np.abs(headings) >= 180 - FORWARD_DEG).mean())
    if back >= MOSTLY:
        advice = "ego x points forward: turn the ego frame, unless the drive is in reverse"
        return _error("ego-backwards", "the vehicle drives backwards all the time", _words(drive), "ahead", advice)
    if 1 - ahead - back >= MOSTLY:
        advice = "ego is x forward, y left: turn the ego frame"
        return _error("ego-sideways", "the vehicle drives sideways all the time", _words(drive), "ahead", advice)
    return None


def _words(drive: _Drive) -> str:
    headings, tilt = drive.headings_deg(), f"tilt {drive.tilt_deg():.0f}°"
    if len(headings) == 0:
        return tilt
    middle = float(np.degrees(np.angle(np.exp(1j * np.radians(headings)).mean())))
    return f"moves {middle:.0f}° from ahead on {drive.way():.0f} m, {tilt}"


def _undone(ego_motion: EgoMotion) -> list[tuple[str, str, str, _Drive]]:
    """The drive with each usual mistake undone."""
    translations, quaternions = ego_motion.translations, ego_motion.quaternions
    conjugated = quaternions * [1, -1, -1, -1]
    turned = np.stack([rotation_from_quaternion(q) for q in quaternions])
    inverted = -np.einsum("tji,tj->ti", turned, translations)
    order, advice = "the quaternions are not in the order w, x, y, z", "put qw first"
    return [
        ("ego-quaternion-order", order, advice, _drive(ego_motion, translations, np.roll(quaternions, 1, axis=1))),
        ("ego-quaternion-order", order, advice, _drive(ego_motion, translations, np.roll(quaternions, -1, axis=1))),
        ("ego-inverted", "the poses are ego_from_world, inverted", "invert them",
         _drive(ego_motion, inverted, conjugated)),
    ]  # fmt: skip


def _stated_speed(drive: _Drive, ego_motion: EgoMotion) -> Finding | None:
    """Velocities that the file states against the spacing of its poses."""
    moving = drive.speeds > SLOWEST_MOVING
    if not moving.any():
        return None
    stated = np.linalg.norm((ego_motion.velocities[:-1] + ego_motion.velocities[1:]) / 2, axis=1)[moving]
    ratio = float(np.median(stated / drive.speeds[moving]))
    if 1 / SPEED_FACTOR <= ratio <= SPEED_FACTOR:
        return None
    found = f"stated {np.median(stated):.1f} m/s, spacing {np.median(drive.speeds[moving]):.1f} m/s"
    message, advice = (
        "the stated speed does not fit the spacing of the poses",
        "give vx, vy, vz in m/s, or leave them out",
    )
    return _error("ego-speed", message, found, f"alike within a factor {SPEED_FACTOR:g}", advice)


def _error(code: str, message: str, found: str, expected: str, advice: str) -> Finding:
    return Finding(code, "error", None, message, found, expected, advice)
