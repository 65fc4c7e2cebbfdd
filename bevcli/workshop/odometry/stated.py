"""What stated poses are compared by: measured steps with their deviations, and common mistakes, undone one by one."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.geometry.ego_motion import TOLERANCE_NS, EgoMotion
from bevcli.geometry.transforms import Array, inverse, rotation_about_z
from bevcli.workshop.odometry.measure import MeasuredMotion

DEGREES = 180 / np.pi
DIRECTIONS = (("forward", "backward"), ("left", "right"), ("up", "down"))  # of the axes of the ego frame, + and -
CHORD_NS = 100_000_000  # half the time for a direction of travel
STRAIGHT = np.radians(1.0)  # largest difference of yaws that do not turn
TURN_INTO_EGO = "turn the poses into x forward, y left, z up"
# Angles of x from north that a yaw may count from, clockwise, degrees -> in words.
CLOCKWISE = {
    0: "clockwise from x",
    90: "clockwise from y, as a compass",
    180: "clockwise from -x",
    270: "clockwise from -y",
}


@dataclass(frozen=True)
class Poses:
    """Poses of T rows, for arithmetic with many times at once."""

    times_ns: NDArray[np.int64]  # (T,) strictly increasing
    rotations: Array  # (T, 3, 3) of world_from_ego
    positions: Array  # (T, 3) metres, world frame

    @cached_property
    def quaternions(self) -> Array:
        """(T, 4) of the rotations, x, y, z, w."""
        return np.asarray(Rotation.from_matrix(self.rotations).as_quat())

    @classmethod
    def of(cls, motion: EgoMotion) -> "Poses":
        """The poses of ego-motion."""
        rotations = Rotation.from_quat(np.roll(motion.quaternions, -1, axis=1)).as_matrix()
        return cls(motion.timestamps_ns, rotations, motion.translations)

    def at(self, times_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        """Poses (..., 4, 4) at times (...), and whether the rows cover them; between rows they are interpolated."""
        covered = (times_ns >= self.times_ns[0] - TOLERANCE_NS) & (times_ns <= self.times_ns[-1] + TOLERANCE_NS)
        last = len(self.times_ns) - 1
        row = np.clip(np.searchsorted(self.times_ns, times_ns, side="right") - 1, 0, max(last - 1, 0))
        later = np.minimum(row + 1, last)
        duration = np.maximum(self.times_ns[later] - self.times_ns[row], 1)  # 0 for a single row
        fraction = np.clip((times_ns - self.times_ns[row]) / duration, 0, 1)[..., None]
        start, end = self.quaternions[row], self.quaternions[later]
        end = np.where((start * end).sum(-1, keepdims=True) < 0, -end, end)
        mixed = start + fraction * (end - start)  # neighbouring rows differ by little
        poses = np.broadcast_to(np.eye(4), (*times_ns.shape, 4, 4)).copy()
        poses[..., :3, :3] = Rotation.from_quat(mixed.reshape(-1, 4)).as_matrix().reshape(*times_ns.shape, 3, 3)
        poses[..., :3, 3] = self.positions[row] + fraction * (self.positions[later] - self.positions[row])
        return poses, covered


def steps_between(poses: Array) -> Array:
    """Steps (..., F - 1, 4, 4), ego_a_from_ego_b, between poses (..., F, 4, 4)."""
    return inverse(poses[..., :-1, :, :]) @ poses[..., 1:, :, :]


@dataclass(frozen=True)
class Mistake:
    """A mistake in stated poses, with the texts of its finding, and the steps (K, 4, 4) after it is undone."""

    code: str
    message: str
    found: str
    expected: str
    advice: str
    steps: Array


def mistakes(rows: Poses, times_ns: NDArray[np.int64], measured: Array) -> Iterator[Mistake]:
    """Each common mistake, undone: the likelier first, where the steps do not tell which.

    Args:
        rows: the stated poses.
        times_ns: (F,) of the frames.
        measured: (F, 4, 4) measured poses, world_from_ego; any world.
    """
    poses, _ = rows.at(times_ns)
    yield from _axes(steps_between(poses))
    yield from _position_axes(poses)
    yield from _angles(rows, times_ns, poses, measured)
    rotations = np.swapaxes(rows.rotations, 1, 2)
    inverted = replace(rows, rotations=rotations, positions=-np.einsum("tij,tj->ti", rotations, rows.positions))
    yield Mistake(
        "motion-inverted", "the poses are ego_from_world, the inverse", "", "world_from_ego", "invert them",
        steps_between(inverted.at(times_ns)[0]),
    )  # fmt: skip
    first_ns, last_ns = rows.times_ns[[0, -1]]
    backwards = Poses(first_ns + (last_ns - rows.times_ns[::-1]), rows.rotations[::-1], rows.positions[::-1])
    yield Mistake(
        "motion-reversed", "the poses run backwards in time", "", "", "reverse the order of their rows",
        steps_between(backwards.at(times_ns)[0]),
    )  # fmt: skip


def signed_permutations() -> list[Array]:
    """The matrices (3, 3) that exchange or negate axes, 46 with an effect on a level drive.

    Those that keep z upright come first, and proper ones first.
    """
    matrices = [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    changing = [matrix for matrix in matrices if not np.array_equal(matrix[:2, :2], np.eye(2))]
    return sorted(changing, key=lambda matrix: (matrix[2, 2] != 1, np.linalg.det(matrix) < 0))


def _axes(steps: Array) -> Iterator[Mistake]:
    """Both frames, that of the vehicle and the world, have other axes."""
    for stated_from_ego in signed_permutations():
        undone = steps.copy()
        undone[:, :3, :3] = stated_from_ego.T @ steps[:, :3, :3] @ stated_from_ego
        undone[:, :3, 3] = steps[:, :3, 3] @ stated_from_ego
        names = []
        for axis, row in zip("xyz", stated_from_ego, strict=True):
            column = int(np.abs(row).argmax())
            names.append(f"{axis} {DIRECTIONS[column][int(row[column] < 0)]}")
        flat = abs(stated_from_ego[2, 2]) == 1  # the ground: whether z is up or down is not told
        is_mirrored = np.linalg.det(stated_from_ego[:2, :2]) < 0 if flat else np.linalg.det(stated_from_ego) < 0
        message = "the axes of the poses are not those of the ego frame"
        if is_mirrored:
            message = "the poses are left-handed" + (", or their z points down" if flat else "")
        description = ", ".join(names[:2] if flat else names)
        advice = "mirror y of positions and rotations, or turn z up" if is_mirrored and flat else TURN_INTO_EGO
        yield Mistake("motion-axes", message, description, "x forward, y left, z up", advice, undone)


def _position_axes(poses: Array) -> Iterator[Mistake]:
    """The positions have other axes than the rotations."""
    for stated_from_world in signed_permutations():
        undone = poses.copy()
        undone[:, :3, 3] = poses[:, :3, 3] @ stated_from_world
        order = [int(np.abs(row).argmax()) for row in stated_from_world]
        signs = ["-" if row.min() < 0 else "" for row in stated_from_world]
        held = ", ".join(sign + "xyz"[axis] for sign, axis in zip(signs, order, strict=True))
        message = "axes of the positions are swapped" if order != [0, 1, 2] else "axes of the positions are negated"
        description = f"x, y, z of the positions hold {held} of the rotations' world"
        yield Mistake(
            "motion-axes", message, description, "one world frame, right-handed, z up",
            "correct the columns x, y, z, or the rotations", steps_between(undone),
        )  # fmt: skip


def _angles(rows: Poses, times_ns: NDArray[np.int64], poses: Array, measured: Array) -> Iterator[Mistake]:
    """Rotations that are not the yaw in radians, counter-clockwise from x."""
    code, expected = "motion-angles", "yaw in radians, counter-clockwise from x"
    yaws = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    for from_deg, words in CLOCKWISE.items():
        turned = _with_yaws(poses, np.radians(from_deg) - yaws)
        yield Mistake(
            code, f"the yaw of the poses counts {words}", "", expected,
            f"take {from_deg}° minus the angle" if from_deg else "negate the angle", steps_between(turned),
        )  # fmt: skip
    row_yaws = np.arctan2(rows.rotations[:, 1, 0], rows.rotations[:, 0, 0])
    shown = np.unwrap(np.arctan2(measured[:, 1, 0], measured[:, 0, 0]))
    for factor, taken, advice in (
        (DEGREES, "degrees of the yaw were taken for radians", f"divide the yaw by {DEGREES:.1f}"),
        (1 / DEGREES, "radians of the yaw were taken for degrees", f"multiply the yaw by {DEGREES:.1f}"),
    ):
        likely = factor * np.interp(rows.times_ns - times_ns[0], times_ns - times_ns[0], shown)  # as the file has it
        turns = np.round((likely - likely[0] - (row_yaws - row_yaws[0])) / (2 * np.pi))
        undone = np.interp(times_ns - times_ns[0], rows.times_ns - times_ns[0], (row_yaws + 2 * np.pi * turns) / factor)
        steps = _aligned(steps_between(_with_yaws(poses, undone)), steps_between(measured))
        yield Mistake(code, taken, "", expected, advice, steps)
    if np.ptp(np.unwrap(yaws)) < STRAIGHT:
        undone = steps_between(_with_yaws(poses, _directions(rows, times_ns)))
        message, advice = "the poses do not turn, but the images do", "give the rotations, such as those of the way"
        yield Mistake(code, message, "", expected, advice, undone)


def _with_yaws(poses: Array, yaws: Array) -> Array:
    """Level poses with other yaws (F,)."""
    turned = poses.copy()
    turned[:, :3, :3] = Rotation.from_rotvec(np.outer(yaws, (0, 0, 1))).as_matrix()
    return turned


def _directions(rows: Poses, times_ns: NDArray[np.int64]) -> Array:
    """The direction of travel (F,) at times: from a little before to a little after each."""
    around = max(CHORD_NS, int(np.median(np.diff(rows.times_ns)))) if len(rows.times_ns) > 1 else CHORD_NS
    before, after = (rows.at(times_ns + sign * around)[0][:, :2, 3] for sign in (-1, 1))
    return np.arctan2(*(after - before).T[::-1])


def _aligned(steps: Array, measured: Array) -> Array:
    """The steps with their translations turned about z by one angle, so that they point as the measured ones."""
    turn = turn_between(steps, measured, np.ones(len(steps)))
    aligned = steps.copy()
    aligned[:, :3, 3] = steps[:, :3, 3] @ rotation_about_z(turn).T
    return aligned


def turn_between(steps: Array, measured: Array, weights: Array) -> float:
    """The angle about z, radians, from the translations of steps (K, 4, 4) to the measured ones; weights: (K,)."""
    flat, shown = (motion[:, 0, 3] + 1j * motion[:, 1, 3] for motion in (steps, measured))
    return float(np.angle((weights * shown * flat.conj()).sum()))


WIDEST = np.radians(2.0), 0.2, 0.3  # deviations of a step that counts as measured: yaw; length in its own, or metres
# Deviations of sound poses: roll, pitch and yaw of a step; its translation, and that in its length.
POSE_DEVIATIONS, LENGTH_DEVIATION = np.array([np.radians(1.0)] * 2 + [np.radians(0.1)] + [0.02, 0.02, 0.1]), 0.01
FREEDOMS = 6  # of a step


@dataclass(frozen=True)
class MeasuredSteps:
    """K measured steps, and how far other steps are from them in standard deviations."""

    times_ns: NDArray[np.int64]  # (K + 1,) of the frames
    poses: Array  # (K + 1, 4, 4) world_from_ego
    steps: Array  # (K, 4, 4)
    precisions: Array  # (K, 6, 6) of the difference to a sound stated step
    is_used: NDArray[np.bool_]  # (K,) measured well, and covered by the stated poses

    @classmethod
    def of(cls, motion: MeasuredMotion) -> "MeasuredSteps":
        """The steps of a measured motion; those without a reason and with small deviations are used."""
        steps = np.stack([step.ego_a_from_ego_b for step in motion.steps])
        covariances = np.stack([step.covariance for step in motion.steps])
        lengths = np.linalg.norm(steps[:, :3, 3], axis=1)
        deviations = np.broadcast_to(POSE_DEVIATIONS, (len(steps), 6)).copy()
        deviations[:, 3:5] = np.hypot(deviations[:, 3:5], LENGTH_DEVIATION * lengths[:, None])
        yaw, share, metres = WIDEST
        spread = np.sqrt(covariances[:, 3, 3] + covariances[:, 4, 4])
        is_used = (np.sqrt(covariances[:, 2, 2]) < yaw) & (spread < np.maximum(share * lengths, metres))
        is_used &= [not step.reason for step in motion.steps]
        precisions = np.linalg.inv(covariances + np.einsum("ki,ij->kij", deviations**2, np.eye(6)))
        return cls(motion.timestamps_ns, motion.poses, steps, precisions, is_used)

    def differences(self, steps: Array) -> Array:
        """(..., K, 6) rotation and translation of steps (..., K, 4, 4) minus the measured ones."""
        turns = steps[..., :3, :3] @ np.swapaxes(self.steps[:, :3, :3], 1, 2)
        vectors = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(*steps.shape[:-2], 3)
        return np.concatenate([vectors, steps[..., :3, 3] - self.steps[:, :3, 3]], axis=-1)

    def distances(self, steps: Array) -> Array:
        """(..., K) the length of the differences in standard deviations."""
        return np.sqrt(self.squared(self.differences(steps)))

    def squared(self, differences: Array) -> Array:
        """(..., K) squared distances of differences (..., K, 6)."""
        return np.einsum("...ki,kij,...kj->...k", differences, self.precisions, differences)

    def cost(self, distances: Array, is_used: NDArray[np.bool_] | None = None) -> Array:
        """(...) robust cost of distances (..., K): that of the steps in use, times the number of all that are used."""
        used = self.is_used if is_used is None else self.is_used & is_used
        of_used = np.where(used, FREEDOMS * np.log1p(distances**2 / FREEDOMS), 0).sum(-1)
        return of_used * self.is_used.sum() / np.maximum(used.sum(-1), 1)

    def weights(self, squared: Array) -> Array:
        """(..., K) robust weights of squared distances."""
        return self.is_used / (1 + squared / FREEDOMS)
