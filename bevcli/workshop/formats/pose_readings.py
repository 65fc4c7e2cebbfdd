"""Poses in usual units, and their readings: which body they are of, and in which direction.

Tables are made those in metres, in degrees on Earth, with z up, and with the course of a vehicle as its heading. A
vehicle drives along its x axis. `Poses` are for arithmetic with many times at once.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product as combined

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.errors import InputError
from bevcli.geometry.ego_motion import TOLERANCE_NS, EgoMotion, rows_around
from bevcli.geometry.transforms import Array, GeoOrigin, Pose, inverse, rigid
from bevcli.parsing.documents import CsvRow
from bevcli.sequences.files.readings import (
    ALL_AXES,
    CAMERA_AXES,
    LEFT_HANDED,
    PoseReading,
)
from bevcli.sequences.options import RigOptions
from bevcli.workshop.formats.camera_poses import ego_from_axes, is_left_handed
from bevcli.workshop.formats.pose_table import MATRIX, QUATERNION, ROTATION_VECTOR, VECTOR, Table

MOVING_M_S, MOVING_M = 1.0, 2.0  # slower steps, and drives with less distance, show no direction
COMPARED = 10_000  # of a longer drive, every second, third, … pose is compared
STEP_S = 0.2  # between two compared poses: shorter steps are noise
FASTEST_M_S = 80.0
ASIDE = np.radians(25.0)  # largest angle between x and the direction of motion, on average
LEVEL = 0.9  # cosine of the largest tilt of a vehicle in a world with z up
VEHICLE_AXES = ("flu", "frd", "rfu")
OTHER_AXES = [axes for axes in ALL_AXES if axes not in VEHICLE_AXES and not is_left_handed(axes)] + list(LEFT_HANDED)
OPPOSITE = dict(zip("fblrud", "bfrldu", strict=True))
LENGTH = re.compile(r"[_\[( ](mm|cm|km)\b")
METRES = {"mm": 1e-3, "cm": 1e-2, "km": 1e3}
NO_FIX = ("", "0", "no", "none", "false", "nofix", "no fix", "nan")
ENU_FROM_NED = np.array([[0.0, 0.5**0.5, 0.5**0.5, 0.0]])  # quaternions w, x, y, z
FRD_FROM_FLU = np.array([[0.0, 1.0, 0.0, 0.0]])
HIGHEST_M = 9000.0  # of an altitude in metres
NEAR_ZERO = 0.1  # latitude and longitude: places of a simulator in degrees, none on land in radians
AGREE = 1.2  # ratio of two distances that are the same
COURSE_M = 2.0  # between two positions, whose direction is the course
COURSE = "course"  # the name of columns of an orientation that is this
LEAST_M = 5.0  # shorter ways show no course


def of_bodies(
    positions: Array,
    rotations: Mapping[str, Array],
    times_ns: NDArray[np.int64],
    cameras: Mapping[str, Array | None],
    stated: Mapping[str, str | None],
) -> Iterator[PoseReading]:
    """The possible readings of poses, the usual first: those in which the vehicle drives along its x axis.

    Args:
        positions: (T, 3) metres.
        rotations: (T, 4) quaternions w, x, y, z by the value of `pose_angles`, "" where that is certain.
        times_ns: (T,).
        cameras: whose poses they may be, beside the vehicle's, in the order in which they are tried; (4, 4)
            ego_from_camera, None where that is not known.
        stated: the options that state a reading; None for those that are not given.
    """
    rows = compared_rows(times_ns)
    wanted = {name: value for name, value in stated.items() if value is not None}
    axes_of = {"vehicle": [*VEHICLE_AXES, *OTHER_AXES], **{name: [*CAMERA_AXES.values()] for name in cameras}}
    for angles, transform in combined(rotations, ("world_from_body", "body_from_world")):
        quaternions, at = rotations[angles], positions
        if transform == "body_from_world":
            quaternions = conjugate(quaternions)
            at = -rotated(quaternions, positions)
        steps = BodySteps.of(at[rows], quaternions[rows], times_ns[rows])
        for body, axes in ((body, axes) for body, each in axes_of.items() for axes in each):
            states = {"pose_angles": angles, "pose_transform": transform, "pose_axes": axes, "poses_of": body}
            is_vehicle = body == "vehicle"
            known = np.eye(4) if is_vehicle else cameras[body]
            if not wanted.items() <= states.items() or (
                known is not None and not steps.lead_along_x(known @ rigid(rotation=_turn(axes, is_vehicle=is_vehicle)))
            ):
                continue
            rank = int(axes not in (VEHICLE_AXES if is_vehicle else ("rdf",)) and "pose_axes" not in wanted)
            yield PoseReading(states, at, quaternions, camera="" if is_vehicle else body, rank=rank)


def _turn(axes: str, *, is_vehicle: bool) -> Array:
    """(3, 3) from a body with some axes to those of the vehicle, or of a camera with x right, y down, z forward."""
    return ego_from_axes(axes) if is_vehicle else ego_from_axes("rdf").T @ ego_from_axes(axes)


def in_usual_axes(reading: PoseReading, rows: slice = slice(None)) -> tuple[Array, Array]:
    """Translations (T, 3) and quaternions (T, 4) of the vehicle, or of a camera with x right, y down, z forward."""
    at, quaternions, axes = reading.translations[rows], reading.quaternions[rows], reading.states["pose_axes"]
    if is_left_handed(axes):  # the mirror image of a right-handed world
        at, quaternions = at * (1, -1, 1), quaternions * (1, -1, 1, -1)
        axes = axes[0] + OPPOSITE[axes[1]] + axes[2]
    if not reading.camera:
        return of_ego(at, quaternions, rigid(rotation=ego_from_axes(axes)))
    turn = Pose.from_matrix(rigid(rotation=_turn(axes, is_vehicle=False).T)).quaternion
    return at, product(quaternions, turn[None])


@dataclass(frozen=True)
class BodySteps:
    """The steps of a body on a vehicle, of which it is known by how much the body is turned in the world."""

    moved: Array  # (T, 3) metres, in the frame of the body
    turned: Array  # (T, 3, 3) body_from_next_body, minus the identity
    seconds: Array  # (T,)

    @classmethod
    def of(cls, positions: Array, quaternions: Array, times_ns: NDArray[np.int64]) -> "BodySteps":
        """Of poses world_from_body: (T, 3), (T, 4) w, x, y, z and their times (T,)."""
        rotations = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
        back = np.swapaxes(rotations[:-1], 1, 2)
        moved = np.einsum("tij,tj->ti", back, np.diff(positions, axis=0))
        return cls(moved, back @ rotations[1:] - np.eye(3), np.diff(times_ns) / 1e9)

    def lead_along_x(self, ego_from_body: Array) -> bool:
        """False for a vehicle that moves aside, or faster than vehicles do; True for one that hardly moves.

        ego_from_body: (4, 4), which may mirror.
        """
        steps = (self.moved + self.turned @ inverse(ego_from_body)[:3, 3]) @ ego_from_body[:3, :3].T
        lengths = np.linalg.norm(steps, axis=1)
        moving = lengths > MOVING_M_S * self.seconds
        if lengths[moving].sum() < MOVING_M:
            return True
        aside = np.arctan2(np.linalg.norm(steps[moving, 1:], axis=1), np.abs(steps[moving, 0]))
        speed = np.median(lengths[moving] / self.seconds[moving])
        return bool(speed < FASTEST_M_S and np.median(aside) < ASIDE)


def of_ego(translations: Array, quaternions: Array, ego_from_body: Array) -> tuple[Array, Array]:
    """The vehicle's translations (T, 3) and quaternions (T, 4) from those of a body on it, (4, 4) ego_from_body.

    The world has z up: it is that of the poses, or the frame of the vehicle where the body was the world, or at the
    first pose.
    """
    if is_level(quaternions) and np.array_equal(ego_from_body, np.eye(4)):
        return translations, quaternions
    body, pose = Pose.from_matrix(inverse(ego_from_body)), Pose.from_matrix(ego_from_body)
    at, turned = translations + rotated(quaternions, body.translation), product(quaternions, body.quaternion[None])
    if is_level(turned):
        return at, turned
    around = rotated(pose.quaternion[None], at) + pose.translation, product(pose.quaternion[None], turned)
    if is_level(around[1]):
        return around
    back = conjugate(turned[:1])
    return rotated(back, at - at[0]), product(back, turned)


def is_level(quaternions: Array) -> bool:
    """True where z of a vehicle with these rotations points up in the world."""
    quaternions = quaternions[:: 1 + len(quaternions) // COMPARED]
    return float(np.median(rotated(quaternions, np.array([0.0, 0.0, 1.0]))[:, 2])) > LEVEL


def compared_rows(times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """The indices of poses that are compared: shorter steps are noise."""
    period = float(np.median(np.diff(times_ns))) / 1e9 if len(times_ns) > 1 else STEP_S
    return np.arange(0, len(times_ns), max(1, round(STEP_S / period)))


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
    (aw, ax, ay, az), (bw, bx, by, bz) = a.T, b.T
    made = np.empty((max(len(a), len(b)), 4))  # column by column: a million poses take little memory
    made[:, 0] = aw * bw - (ax * bx + ay * by + az * bz)
    made[:, 1] = aw * bx + bw * ax + (ay * bz - az * by)
    made[:, 2] = aw * by + bw * ay + (az * bx - ax * bz)
    made[:, 3] = aw * bz + bw * az + (ax * by - ay * bx)
    return made


def conjugate(quaternions: Array) -> Array:
    """(T, 4) the opposite rotations."""
    return quaternions * (1, -1, -1, -1)


def rotated(quaternions: Array, points: Array) -> Array:
    """(T, 3) points, (3,) or (T, 3), turned by quaternions (T, 4)."""
    count = max(len(quaternions), len(np.atleast_2d(points)))
    as_quaternions = np.concatenate([np.zeros((count, 1)), np.broadcast_to(points, (count, 3))], axis=1)
    turned = np.broadcast_to(quaternions, (count, 4))
    return product(product(turned, as_quaternions), conjugate(turned))[:, 1:]


def in_usual_units(table: Table, stated: RigOptions) -> Table:
    """The table in metres and degrees, with z up, without rows that have no fix. Raises InputError."""
    table = _radians_as_degrees(_of_integers(_with_fix(table)), stated)
    if table.has(*ROTATION_VECTOR) and not table.has("yaw"):
        angles = table.numbers(*ROTATION_VECTOR).T
        table = with_numbers(table, dict(zip(("roll", "pitch", "yaw"), angles, strict=True)), "rz")
    scales = {axis: METRES[found[1]] for axis in (*VECTOR, "down", "altitude")
              if (found := LENGTH.search(table.columns.get(axis, "")))}  # fmt: skip
    if scales:
        table = with_numbers(table, {axis: table.numbers(axis)[:, 0] * scale for axis, scale in scales.items()})
    if not table.has("down"):
        return table
    columns = {"z": -table.numbers("down")[:, 0]}
    if table.has(*QUATERNION):
        turned = product(product(ENU_FROM_NED, table.numbers(*QUATERNION)), FRD_FROM_FLU)
        columns |= dict(zip(QUATERNION, turned.T, strict=True))
    table = with_numbers(table, columns)
    if table.has("yaw") and not table.has("heading"):  # clockwise from north
        table = with_numbers(table, {"heading": table.numbers("yaw")[:, 0]}, table.columns["yaw"])
        table = replace(table, columns={key: name for key, name in table.columns.items() if key != "yaw"})
    return replace(table, notes=(*table.notes, "north, east and down"))


def with_numbers(table: Table, columns: Mapping[str, Array], name: str = "") -> Table:
    """The table with (T,) other or new columns. name: of those that are new."""
    return replace(table, values={**table.values, **columns}, columns={**dict.fromkeys(columns, name), **table.columns})


def _with_fix(table: Table) -> Table:
    """The table without rows of a receiver that had no fix."""
    if not table.has("latitude", "longitude"):
        return table
    fixes = np.fromiter(map(_has_fix, table.rows()), dtype=np.bool_, count=len(table))
    lost = int((~fixes).sum())
    if not fixes.any():
        raise InputError(f"{table.path}: no row has a fix: measure the motion by `odometry=True` (`--odometry`)")
    notes = (f"{lost} without a fix left out",) if lost else ()
    return replace(table, spans=table.spans[fixes], notes=(*table.notes, *notes))


def _has_fix(row: CsvRow) -> bool:
    place = [row.cells[name].strip().lower() for name in ("latitude", "longitude")]
    if any(cell in ("", "nan") for cell in place) or row.cells.get("fix", "3").strip().lower() in NO_FIX:
        return False
    return any(cell.strip("0.+-") for cell in place) and row.cells.get("status", "0").strip() != "-1"


def _of_integers(table: Table) -> Table:
    """The table with places in degrees and metres, where they are integers, 1e-7 degrees and millimetres (MAVLink)."""
    if not table.has("latitude", "longitude") or np.abs(places := table.numbers("latitude", "longitude")).max() < 1e6:
        return table
    latitude, longitude = places.T * 1e-7
    columns = {"latitude": latitude, "longitude": longitude}
    if table.has("altitude") and np.abs(altitudes := table.numbers("altitude")[:, 0]).max() > HIGHEST_M:
        columns["altitude"] = altitudes * 1e-3
    return replace(with_numbers(table, columns), notes=(*table.notes, "latitude and longitude in 1e-7 degrees"))


def _radians_as_degrees(table: Table, stated: RigOptions) -> Table:
    """The table with places in degrees. Where both units are possible, positions beside them or the place decide."""
    if not table.has("latitude", "longitude"):
        return table
    places, name = table.numbers("latitude", "longitude"), table.columns["latitude"]
    is_possible = np.abs(places[:, 0]).max() <= np.pi / 2 and np.abs(places[:, 1]).max() <= 2 * np.pi
    if not is_possible or re.search(r"[_\[( ]deg", name) or stated.pose_angles == "degrees":
        return table
    if re.search(r"[_\[( ]rad", name) is None and stated.pose_angles != "radians":
        moved = _extent(GeoOrigin(*np.degrees(places[0])).points(np.degrees(places)))
        other = _extent(table.numbers("x", "y")) if table.has("x", "y") else 0.0
        agrees = [1 / AGREE < other / max(length, 1e-9) < AGREE for length in (moved, np.radians(moved))]
        if other > 1 and not any(agrees):
            raise InputError(
                f"{table.path}: latitude and longitude move by {np.radians(moved):.1f} m (as radians: {moved:.1f} m), "
                f"and {table.columns['x']} and {table.columns['y']} by {other:.1f} m: pass `pose_angles=radians` "
                "(`--pose-angles radians`) or `pose_angles=degrees` (`--pose-angles degrees`)"
            )
        if agrees[1] if other > 1 else np.abs(places).max() < NEAR_ZERO:
            return table
    degrees = np.degrees(places)
    table = with_numbers(table, {"latitude": degrees[:, 0], "longitude": degrees[:, 1]})
    return replace(table, notes=(*table.notes, "latitude and longitude in radians"))


def _extent(points: Array) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def with_course(table: Table, positions: Array, times_ns: NDArray[np.int64]) -> Table:
    """The table with a heading: for positions of GPS without one, the course of a vehicle that drives forward.

    positions: (T, 3) metres. Raises InputError for a vehicle that does not move.
    """
    if any(table.has(*names) for names in (QUATERNION, MATRIX, ("yaw",), ("heading",))):
        return table
    yaws = course(positions[:, :2], times_ns)
    if yaws is None:
        raise InputError(
            f"{table.path}: columns of the orientation are missing (expected qw, qx, qy, qz; yaw; or heading), and a "
            f"vehicle that moves less than {LEAST_M:g} m has no course: add them, or measure the motion by "
            "`odometry=True` (`--odometry`)"
        )
    level = np.zeros(len(yaws))
    columns = dict(zip(QUATERNION, (np.cos(yaws / 2), level, level, np.sin(yaws / 2)), strict=True))
    table = with_numbers(table, columns, COURSE)
    return replace(table, notes=(*table.notes, "the heading is the course, as it states none"))


def course(places: Array, times_ns: NDArray[np.int64]) -> Array | None:
    """(T,) headings of a vehicle in the plane, radians from x; None where it moves too little.

    Where the direction turns round from one step to the next, the vehicle drives backwards. places: (T, 2) metres.
    """
    anchors = [0]
    for index, place in enumerate(places):
        if np.linalg.norm(place - places[anchors[-1]]) >= COURSE_M:
            anchors.append(index)
    steps = np.diff(places[anchors], axis=0)
    if len(steps) < 2 or np.linalg.norm(steps, axis=1).sum() < LEAST_M:
        return None
    directions = np.arctan2(steps[:, 1], steps[:, 0])
    yaws = np.unwrap(directions, period=np.pi)
    if np.sum(np.cos(yaws - directions)) < 0:
        yaws = yaws + np.pi
    seconds = (times_ns - times_ns[0]) / 1e9
    middles = (seconds[anchors][:-1] + seconds[anchors][1:]) / 2
    ends = []
    for end, near, next_to in ((seconds[0], 0, 1), (seconds[-1], -1, -2)):
        step = middles[near] - middles[next_to]
        share = np.clip((end - middles[near]) / step, 0, 1)  # of a step: longer, the vehicle stands
        ends.append(yaws[near] + share * (yaws[near] - yaws[next_to]))
    return np.interp(seconds, [seconds[0], *middles, seconds[-1]], [ends[0], *yaws, ends[1]])


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
        """Poses (..., 4, 4) at times (...) as `EgoMotion.pose_at` has them, and whether the rows cover them."""
        covered = (times_ns >= self.times_ns[0] - TOLERANCE_NS) & (times_ns <= self.times_ns[-1] + TOLERANCE_NS)
        row, later, fraction = rows_around(self.times_ns, times_ns)
        fraction = fraction[..., None]
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
