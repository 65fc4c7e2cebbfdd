"""The choice between readings of a file of poses, such as degrees or radians: a vehicle is level and drives forward."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, Pose, rotation_from_quaternion
from bevcli.sequences.files.ego_motion_file import DrivePoses

MOVING_M_S, MOVING_M = 1.0, 5.0  # slower steps, and drives with less distance, show no direction
STEP_S = 0.2  # between two compared poses: shorter steps are noise
LARGEST_MISFIT_DEG = 20.0
SAME_DEG = 1.0  # readings that differ less are the same


@dataclass(frozen=True)
class Reading:
    """T poses, as a file may mean them. words: for the user; "" where there is nothing to say."""

    words: str
    translations: Array  # (T, 3) metres, world frame
    quaternions: Array  # (T, 4) w, x, y, z, norm 1

    def misfit_deg(self, times_ns: NDArray[np.int64]) -> tuple[float, bool]:
        """The larger of tilt and angle between x and the direction of motion, medians; whether the vehicle moves."""
        seconds = (times_ns - times_ns[0]) / 1e9
        period = float(np.median(np.diff(seconds))) if len(seconds) > 1 else STEP_S
        rows = np.arange(0, len(seconds), max(1, round(STEP_S / period)))
        rotations = np.stack([rotation_from_quaternion(q) for q in self.quaternions[rows]])
        tilt = float(np.degrees(np.median(np.arccos(np.clip(rotations[:, 2, 2], -1, 1)))))
        steps = np.diff(self.translations[rows], axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        moving = lengths > MOVING_M_S * np.diff(seconds[rows])
        if lengths[moving].sum() < MOVING_M:
            return tilt, False
        in_ego = np.einsum("tji,tj->ti", rotations[:-1], steps)[moving]
        aside = np.degrees(np.abs(np.arctan2(np.linalg.norm(in_ego[:, 1:], axis=1), in_ego[:, 0])))
        return max(tilt, float(np.median(aside))), True

    def differs_from(self, other: "Reading") -> bool:
        """Whether the vehicle turns otherwise, beyond `SAME_DEG`, as the world's own orientation is arbitrary."""
        turns = [product(conjugate(reading.quaternions[:1]), reading.quaternions) for reading in (self, other)]
        cosines = np.abs(np.sum(turns[0] * turns[1], axis=1)).clip(0, 1)
        return bool(np.degrees(2 * np.arccos(cosines)).max() > SAME_DEG)


def best_reading(
    path: Path, readings: Sequence[Reading], times_ns: NDArray[np.int64], ask: str, drive: DrivePoses
) -> Reading:
    """The reading that fits a vehicle, the first one of those that fit as well.

    ask: what the user may pass where the poses do not decide; "" where the first reading is the usual one.
    Raises InputError, also where the poses fit a camera that looks ahead, and not the vehicle.
    """
    fits = [reading.misfit_deg(times_ns) for reading in readings]
    misfits, moves = [misfit for misfit, _ in fits], fits[0][1]
    least, first = min(misfits), readings[0]
    decided = least <= LARGEST_MISFIT_DEG and (moves or not any(first.differs_from(other) for other in readings[1:]))
    if ask and len(readings) > 1 and not decided:
        words = " or ".join(each.words for each in readings)
        why = f"none fits how the vehicle moves, the best is {least:.0f}° off" if moves else "the vehicle does not move"
        raise InputError(f"{path}: may have {words}; {why}, which would decide: pass {ask}")
    if least > LARGEST_MISFIT_DEG:
        _refuse_poses_of_camera(path, first, times_ns, drive)
        return first
    return next(each for each, misfit in zip(readings, misfits, strict=True) if misfit <= least + SAME_DEG)


def _refuse_poses_of_camera(path: Path, reading: Reading, times_ns: NDArray[np.int64], drive: DrivePoses) -> None:
    for camera in drive.cameras_ahead if drive.stated.poses_of is None else ():
        if min(candidate.misfit_deg(times_ns)[0] for candidate in of_vehicle(reading, camera)) <= LARGEST_MISFIT_DEG:
            raise InputError(
                f"{path}: the poses are not those of the vehicle (x forward, z up), but fit a camera that looks ahead: "
                f"pass `poses_of={camera.name}` (`--poses-of {camera.name}`), or `poses_of=vehicle` (`--poses-of "
                "vehicle`) to keep them"
            )


def of_vehicle(reading: Reading, camera: Camera) -> list[Reading]:
    """The vehicle's poses from those of its camera, in the two usual worlds: with z up, and the first camera's frame.

    The second world becomes the frame of the vehicle at that pose.
    """
    camera_from_ego = Pose.from_matrix(camera.camera_from_ego)
    translations = reading.translations + rotated(reading.quaternions, camera_from_ego.translation)
    quaternions = product(reading.quaternions, camera_from_ego.quaternion[None])
    ego_from_camera = Pose.from_matrix(camera.ego_from_camera)
    turned = rotated(ego_from_camera.quaternion[None], translations) + ego_from_camera.translation
    return [
        Reading(reading.words, turned, product(ego_from_camera.quaternion[None], quaternions)),
        Reading(reading.words, translations, quaternions),
    ]


def quaternions_of_angles(roll: Array, pitch: Array, yaw: Array) -> Array:
    """(T, 4) w, x, y, z of rotations about x, then y, then z, radians."""
    quaternions = []
    for axis, angles in enumerate((roll, pitch, yaw)):
        half = np.zeros((len(yaw), 4))
        half[:, 0], half[:, axis + 1] = np.cos(angles / 2), np.sin(angles / 2)
        quaternions.append(half)
    return product(product(quaternions[2], quaternions[1]), quaternions[0])


def product(a: Array, b: Array) -> Array:
    """(T, 4) products of quaternions w, x, y, z."""
    w, v = a[:, :1] * b[:, :1] - np.sum(a[:, 1:] * b[:, 1:], axis=1, keepdims=True), np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([w, a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + v], axis=1)


def conjugate(quaternions: Array) -> Array:
    """(T, 4) the opposite rotations."""
    return quaternions * (1, -1, -1, -1)


def rotated(quaternions: Array, points: Array) -> Array:
    """(T, 3) points, (3,) or (T, 3), turned by quaternions (T, 4)."""
    count = max(len(quaternions), len(np.atleast_2d(points)))
    as_quaternions = np.concatenate([np.zeros((count, 1)), np.broadcast_to(points, (count, 3))], axis=1)
    turned = np.broadcast_to(quaternions, (count, 4))
    return product(product(turned, as_quaternions), conjugate(turned))[:, 1:]
