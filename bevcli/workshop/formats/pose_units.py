"""Tables of poses in metres, in degrees on Earth, with z up, and with the course of a vehicle as its heading."""

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, GeoOrigin
from bevcli.parsing.documents import CsvRow
from bevcli.sequences.options import RigOptions
from bevcli.workshop.formats.pose_readings import product
from bevcli.workshop.formats.pose_table import MATRIX, QUATERNION, ROTATION_VECTOR, VECTOR, Table

LENGTH = re.compile(r"[_\[( ](mm|cm|km)\b")
METRES = {"mm": 1e-3, "cm": 1e-2, "km": 1e3}
NO_FIX = ("", "0", "no", "none", "false", "nofix", "no fix", "nan")
ENU_FROM_NED = np.array([[0.0, 0.5**0.5, 0.5**0.5, 0.0]])  # quaternions w, x, y, z
FRD_FROM_FLU = np.array([[0.0, 1.0, 0.0, 0.0]])
HIGHEST_M = 9000.0  # of an altitude in metres
NEAR_ZERO = 0.1  # latitude and longitude: places of a simulator in degrees, none on land in radians
AGREE = 1.2  # ratio of two distances that are the same
COURSE_M = 2.0  # between two positions, whose direction is the course
MOVING_M = 5.0  # shorter ways show no course


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
    return (
        replace(table, spans=table.spans[fixes], notes=(*table.notes, f"{lost} without a fix left out"))
        if lost
        else table
    )


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
    is_gps = table.has("latitude", "longitude")
    yaws = course(positions[:, :2], times_ns) if is_gps else None
    if yaws is None:
        why = f", and a vehicle that moves less than {MOVING_M:g} m has no course" if is_gps else ""
        raise InputError(
            f"{table.path}: columns of the orientation are missing (expected qw, qx, qy, qz; yaw; or heading){why}: "
            "add them, or measure the motion by `odometry=True` (`--odometry`)"
        )
    level = np.zeros(len(yaws))
    columns = dict(zip(QUATERNION, (np.cos(yaws / 2), level, level, np.sin(yaws / 2)), strict=True))
    table = with_numbers(table, columns, "course")
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
    if len(steps) < 2 or np.linalg.norm(steps, axis=1).sum() < MOVING_M:
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
