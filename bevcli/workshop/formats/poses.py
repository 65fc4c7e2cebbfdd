"""The vehicle's poses in files of other programs: TUM, KITTI, EuRoC, and tables with named columns, of GPS too.

The kind of a file follows from its contents: its names of columns, or their number. What its numbers mean (degrees or
radians, the order of a quaternion, the body and the direction of the poses) are readings between which the images
decide; the unit of times follows from the times of the frames. A note says what was understood.
"""

import re
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TypeAlias, cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.errors import InputError
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import TOLERANCE_NS, EgoMotion, derive_kinematics
from bevcli.geometry.transforms import EAST_DEG, Array, GeoOrigin, quaternion_from_rotation
from bevcli.options import named
from bevcli.parsing.documents import LARGEST_INTEGER, CsvRow
from bevcli.parsing.files import is_there
from bevcli.printing import counted
from bevcli.sequences.files.ego_motion_file import NORM_TOLERANCE, DrivePoses, FrameTimesNeeded, ReadPoses
from bevcli.sequences.files.readings import PoseReading
from bevcli.sequences.native import TimeKind
from bevcli.sequences.options import RigOptions
from bevcli.workshop.formats.kitti import read_oxts
from bevcli.workshop.formats.name_times import SINCE_1970_NS, UNITS_NS, WORDS
from bevcli.workshop.formats.pose_readings import (
    COURSE,
    FASTEST_M_S,
    compared_rows,
    conjugate,
    in_usual_axes,
    in_usual_units,
    of_bodies,
    of_ego,
    quaternions_of_angles,
    rotated,
    with_course,
)
from bevcli.workshop.formats.pose_table import (
    MATRIX,
    QUATERNION,
    ROTATION_TOLERANCE,
    ROTATION_VECTOR,
    TUM,
    VECTOR,
    Table,
    read_column,
    read_table,
)

AHEAD = np.radians(45)  # largest yaw of a camera that looks ahead
_UNIT_OF_NAME = re.compile(r"[_\[( ](s|ms|us|ns)[a-z]*[\])]?$|^(s)ec")
PERIODS_S = 4e-4, 20.0  # between two rows: at most 2500 a second, and at least three a minute
UNIT_ROWS = 50_000  # at the start, and the last one, whose times tell the unit
_DIGITS = re.compile(r"\d{1,18}(?:\.\d{0,18})?", re.ASCII)  # a time with all of its digits
POSE_STATEMENTS = ("poses_of", "pose_axes", "pose_transform", "pose_angles", "pose_unit")
FOLDER = "the sequence folder (`bevcli convert` writes one)"  # whose poses the options may state
ANGLES = ("vector", "radians", "degrees", "compass", "compass-radians", "clockwise", "clockwise-radians")
UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}  # those of feet are stated
LARGEST_NUMBER = 10**7  # of a frame
LARGEST_RADIANS = 6.5  # a little more than a turn; larger angles are degrees


def read_poses(path: Path, drive: DrivePoses) -> ReadPoses | None:
    """The poses of a file, and what was understood; None for a file of no known kind.

    Raises InputError for a file that lacks something, or that can be read in two ways.
    """
    if path.is_dir():
        refuse_statements(path, drive.stated)
        return read_oxts(path)
    table = read_table(path)
    name = "" if table is None else _kind(table)
    if table is None or not name:
        return None
    table = in_usual_units(table, drive.stated)
    numbered = _of_numbered_frames(table, drive)
    table = table if numbered is None else numbered[0]
    positions, origin = _positions(table)
    times, time_words = _times(table, positions, drive) if numbered is None else numbered[1:]
    table = with_course(table, positions, times)
    late = np.diff(times) <= 0
    if late.any():
        line = table.spans[1 + int(late.argmax()), 0]
        raise InputError(f"{path}: line {line}: its time is not later than that of the row before: sort them")
    _check_camera(drive)
    readings = list(_readings(table, positions, drive, times))
    is_stated = any(getattr(drive.stated, option) for option in POSE_STATEMENTS)
    free = replace(drive, stated=RigOptions())
    others = tuple(_readings(table, positions, free, times)) if is_stated else ()
    if not readings:
        raise InputError(
            f"{path}: in no reading of the poses the vehicle drives along its x axis, at most {FASTEST_M_S:g} m/s: "
            "correct them, or measure the motion by `odometry=True` (`--odometry`)"
        )
    rate = f" at {1e9 / np.median(np.diff(times)):.1f} Hz" if len(times) > 1 else ""
    first = ", ".join([f"{name}, {counted(len(times), 'rows')}{rate}", time_words, *table.notes])
    del table, positions  # of a long drive, they take as much memory as all that is derived from them
    last = ""
    if drive.times_ns is not None:
        covered = _covered(int(times[0]), int(times[-1]), drive.times_ns)
        count = len(drive.times_ns)
        last = f"; cover {'all' if covered == count else f'{covered} of {count}'} frames"
    readings = [replace(each, note=f"poses: {first}, {each.words()}{last}") for each in readings]
    read = of_reading(readings[0], times, drive.rig)
    return replace(read, geo_origin=origin, readings=tuple(readings), others=others, file=path)


def refuse_statements(path: Path, stated: RigOptions) -> None:
    """Raise InputError where options state what poses are that are certain."""
    name = next((name for name in (*POSE_STATEMENTS, "pose_times") if getattr(stated, name) is not None), None)
    if name is not None:
        raise InputError(f"{path}: states what its poses are: pass {named(RigOptions, name)} with {FOLDER}, or none")


def _kind(table: Table) -> str:
    """The kind of a file of poses; "" for one that is not known."""
    order = table.columns.get("qw")
    kinds = {
        "KITTI": table.has(*MATRIX) and not table.has("time"),
        "matrices": table.has(*MATRIX),
        "EuRoC": order is not None and (order.startswith("q_rs_") or (table.separator == "," and not order)),
        "TUM": table.separator in (None, "\t") and tuple(table.columns) == TUM,
        "GPS": table.has("latitude", "longitude"),
        "CSV": table.has("x", "y"),
    }
    return next((name for name, is_it in kinds.items() if is_it), "")


def of_reading(reading: PoseReading, times_ns: NDArray[np.int64], rig: CameraRig) -> ReadPoses:
    """The poses of the vehicle with a rig, as a reading has them."""
    poses = in_usual_axes(reading)
    poses = of_ego(*poses, rig[reading.camera].ego_from_camera) if reading.camera else poses
    kinematics = derive_kinematics(times_ns, *poses)
    return ReadPoses(EgoMotion(times_ns, *poses, *kinematics, velocities_are_stated=False), (reading.note,))


def _positions(table: Table) -> tuple[Array, GeoOrigin | None]:
    """(T, 3) positions in metres; those of GPS are east, north and up of the first one, which is the origin."""
    if table.has(*MATRIX):
        return table.numbers("m03", "m13", "m23"), None
    if not table.has("latitude", "longitude"):
        return table.numbers(*VECTOR), None
    degrees, up = table.numbers("latitude", "longitude"), table.numbers("altitude")
    wrong = (np.abs(degrees) > (90, 360)).any(axis=1)
    if wrong.any():
        latitude, longitude = degrees[row := int(wrong.argmax())]
        raise table.row(row).error("latitude", f"{latitude:g}, {longitude:g} is no place on Earth (expected degrees)")
    origin = GeoOrigin(float(degrees[0, 0]), float(degrees[0, 1]), EAST_DEG)
    return np.column_stack([origin.points(degrees), up - up[0]]), origin


def _times(table: Table, positions: Array, drive: DrivePoses) -> tuple[NDArray[np.int64], str]:
    """(T,) times in ns, and what was understood. KITTI's are in times.txt beside, or those of the frames."""
    path, count = table.path, len(table)
    is_named = any(table.columns.values()) and not table.has(*MATRIX)
    is_timed = table.has("time") or table.has("seconds", "nanoseconds")
    if not is_timed and not (is_named and drive.times_ns is not None and count != len(drive.times_ns)):
        beside = (path.with_name("times.txt"), path.parent.parent / "sequences" / path.stem / "times.txt")
        file = next((each for each in beside if is_there(each)), None)
        if file is None and drive.times_ns is not None and count == len(drive.times_ns):
            return drive.times_ns, "the times of the frames"
        if file is None:
            frames = "" if drive.times_ns is None else f", and the drive has {len(drive.times_ns)} frames"
            message = f"{path}: has {count} poses without times{frames}: put times.txt beside it, with {count} lines"
            raise (FrameTimesNeeded if drive.times_ns is None else InputError)(message)
        table = read_column(file, "time")
        if len(table) != count:
            raise InputError(f"{file}: has {len(table)} times (expected {count}, one for each line of {path.name})")
    elif table.has("nanoseconds") and (seconds := next((each for each in ("seconds", "time") if table.has(each)), "")):
        return _both(table, seconds), "seconds and nanoseconds"
    elif not table.has("time"):
        examples = "t, time, timestamp, stamp, or with the unit, such as timestamp_ns"
        raise InputError(f"{table.path}: a column of times is missing (expected a name such as {examples})")
    unit_in_name = _UNIT_OF_NAME.search(table.columns["time"])
    of_name = cast("TimeKind | None", unit_in_name and (unit_in_name[1] or unit_in_name[2]))
    unit = drive.stated.pose_times or of_name or _unit(table, positions, drive)
    try:
        times = np.fromiter((round(time * UNITS_NS[unit]) for time in _exact(table)), np.int64, count)
    except OverflowError:
        times = np.array([LARGEST_INTEGER + 1])
    if np.abs(times).max() > LARGEST_INTEGER:
        raise InputError(f"{table.path}: the times are too large for {WORDS[unit]}: pass `pose_times` (`--pose-times`)")
    return times, WORDS[unit] + (" since 1970" if SINCE_1970_NS[0] <= times[0] <= SINCE_1970_NS[1] else "")


def _of_numbered_frames(table: Table, drive: DrivePoses) -> tuple[Table, NDArray[np.int64], str] | None:
    """The rows of frames, their times and words, where each row begins with the number of a frame, as in KITTI-360."""
    if not table.has("time", *MATRIX) or table.columns["time"] or drive.stated.pose_times is not None:
        return None
    numbers = np.fromiter(map(float, _exact(table)), np.float64, len(table))
    if (numbers % 1).any() or numbers.max() > LARGEST_NUMBER:
        return None
    if drive.times_ns is None:
        raise FrameTimesNeeded(f"{table.path}: its rows may begin with the numbers of frames")
    if drive.numbers is None or 2 * np.isin(drive.numbers, numbers).sum() < len(drive.numbers):
        return None
    time_of = dict(zip(drive.numbers.tolist(), drive.times_ns.tolist(), strict=True))
    known = np.isin(numbers, drive.numbers)
    times = np.array([time_of[number] for number in numbers[known].tolist()], dtype=np.int64)
    return replace(table, spans=table.spans[known]), times, "with the numbers of the frames"


def _both(table: Table, seconds: str) -> NDArray[np.int64]:
    """Seconds of a column and nanoseconds of another one."""
    times = array("q")
    for row in table.rows():
        part = row.integer("nanoseconds")
        time = row.integer(seconds) * 10**9 + part
        if not 0 <= part < 10**9:
            advice = f"remove the column {table.columns[seconds]}, if this has all of the time"
            raise row.error(table.columns["nanoseconds"], f"{part} is no part of a second: {advice}")
        if abs(time) > LARGEST_INTEGER:
            advice = (
                f"is its unit seconds? Remove the column {table.columns['nanoseconds']}, if that has all of the time"
            )
            raise row.error(table.columns[seconds], f"{row.cells[seconds]} s is too large for a time: {advice}")
        times.append(time)
    return np.array(times)


def _exact(table: Table) -> Iterator[Decimal]:
    """The times without a unit, in all of their digits."""
    for index, text in enumerate(table.texts("time")):
        yield Decimal(text) if _DIGITS.fullmatch(text) else _decimal(table.row(index))


def _decimal(row: CsvRow) -> Decimal:
    """The time of a row: a number with all of its digits, or a date of ISO 8601, of which seconds since 1970."""
    text = row.cells["time"]
    try:
        value = Decimal(text if text.isascii() and "_" not in text else "")
    except InvalidOperation:
        try:
            date = datetime.fromisoformat(text)
        except ValueError:
            raise row.error("time", f'expected a number or a date, found "{text:.40}"') from None
        since = (date if date.tzinfo else date.replace(tzinfo=UTC)) - datetime(1970, 1, 1, tzinfo=UTC)
        return Decimal(since // timedelta(microseconds=1)) / 10**6
    if not value.is_finite():
        raise row.error("time", f'expected a time, found "{text:.24}": correct or remove the row')
    if value.as_tuple().exponent > 0:  # type: ignore[operator]
        raise row.error("time", f'the last digits of "{text:.24}" are lost: write the file anew from its source')
    if abs(value) > LARGEST_INTEGER:
        raise row.error("time", f'"{text:.24}" is too large for a time in any unit')
    return value


def _unit(table: Table, positions: Array, drive: DrivePoses) -> TimeKind:
    """The unit of times without one: rows and speeds that can be, the frames covered, times since 1970."""
    rows = np.unique([*range(min(len(table), UNIT_ROWS)), len(table) - 1])
    units, rough = list(UNITS_NS), np.fromiter(_exact(replace(table, spans=table.spans[rows])), np.float64, len(rows))
    durations, lengths = np.diff(rough), np.linalg.norm(np.diff(positions[rows], axis=0), axis=1)
    if len(durations) and (durations > 0).any():
        period = float(np.median(durations[durations > 0])) / 1e9
        speed = float(np.median(lengths[durations > 0] / durations[durations > 0])) * 1e9
        units = [
            unit for unit, ns in UNITS_NS.items()
            if PERIODS_S[0] <= period * ns <= PERIODS_S[1] and speed / ns <= FASTEST_M_S
        ] or units  # fmt: skip
    ends = {unit: (rough[[0, -1]] * UNITS_NS[unit]).tolist() for unit in units}
    if drive.times_ns is not None:
        covered = {unit: _covered(ends[unit][0], ends[unit][1], drive.times_ns) for unit in units}
        units = [unit for unit in units if covered[unit] == max(covered.values())]
    recent = [unit for unit in units if SINCE_1970_NS[0] <= ends[unit][0] <= SINCE_1970_NS[1]]
    units = recent or units
    if len(units) > 1:
        words = " or ".join(WORDS[unit] for unit in units)
        options = " or ".join(f"`pose_times={unit}` (`--pose-times`)" for unit in units)
        message = f"{table.path}: the times ({table.row(0).cells['time']:.40}, …) may be {words}: pass {options}"
        raise (FrameTimesNeeded if drive.times_ns is None else InputError)(message)
    return units[0]


def _covered(first: float, last: float, times_ns: NDArray[np.int64]) -> int:
    """Number of frames that poses from `first` to `last`, ns, cover."""
    return sum(first - TOLERANCE_NS <= time <= last + TOLERANCE_NS for time in times_ns.tolist())


def _check_camera(drive: DrivePoses) -> None:
    if drive.stated.poses_of not in (None, "vehicle", *drive.rig.names):
        expected = ", ".join(("vehicle", *drive.rig.names))
        raise InputError(
            f"`poses_of={drive.stated.poses_of}` (`--poses-of`): is not in the rig (expected one of {expected})"
        )


def _readings(table: Table, positions: Array, drive: DrivePoses, times_ns: NDArray[np.int64]) -> Iterator[PoseReading]:
    """What the poses may be, the usual first: those of KITTI are of its camera 0."""
    rotations, cameras = _rotations(table, drive), list(drive.rig.names)
    stated = {name: getattr(drive.stated, name) for name in POSE_STATEMENTS[:3]}
    if stated["pose_axes"] is not None:
        stated["poses_of"] = stated["poses_of"] or "vehicle"
    of_gps = table.has("latitude", "longitude")
    is_free = any(table.has(*each) for each in (QUATERNION, MATRIX, ROTATION_VECTOR))
    if of_gps or not is_free or table.columns.get("qw") == COURSE:  # angles are those of a vehicle in the world
        cameras, stated["pose_transform"] = [], stated["pose_transform"] or "world_from_body"
    if of_gps:
        stated["pose_axes"] = stated["pose_axes"] or "flu"
    zeroth = next((name for name in cameras if re.search("(?<![0-9])0+$", name)), "")
    zeroth = zeroth or next((camera.name for camera in drive.rig.cameras if abs(camera.yaw) <= AHEAD), "")
    known = {name: None if drive.rig_is_open else drive.rig[name].ego_from_camera for name in cameras}
    readings = []
    for unit in _units(positions, rotations.values(), times_ns, drive):
        of_unit = of_bodies(UNITS_M[unit] * positions, rotations, times_ns, known, stated)
        for each in of_unit:
            rank = each.rank + int(drive.stated.pose_angles is None and _is_unusual(each.states["pose_angles"], table))
            states = {**each.states, **({} if unit == "m" else {"pose_unit": unit})}
            readings.append(replace(each, states=states, rank=rank))
    yield from sorted(readings, key=lambda each: (each.rank, tuple(table.columns) == MATRIX and each.camera != zeroth))


def _units(positions: Array, rotations: Iterable[Array], times_ns: NDArray[np.int64], drive: DrivePoses) -> list[str]:
    """The units that positions may have: other ones than metres where a vehicle would be too fast either way.

    Positions of a world that is far away move fast in the frame of a vehicle that turns.
    """
    if drive.stated.pose_unit is not None:
        return [drive.stated.pose_unit]
    rows = compared_rows(times_ns)
    seconds = np.maximum(np.diff(times_ns[rows]), 1) / 1e9
    for at in (positions[rows], *(rotated(conjugate(each[rows]), positions[rows]) for each in rotations)):
        lengths = np.linalg.norm(np.diff(at, axis=0), axis=1)
        if not len(lengths) or np.median(lengths / seconds) < FASTEST_M_S:
            return ["m"]
    return ["cm", "mm"]


def _is_unusual(angles: str, table: Table) -> bool:
    """True for angles that are seldom meant by a name of a column, and for a quaternion that TUM does not have."""
    if angles == "wxyz" and tuple(table.columns) == TUM and table.separator in (None, "\t"):
        return True
    is_of_north = table.has("heading") or table.has("latitude")
    return angles.startswith("clockwise") or (angles.startswith("compass") and not is_of_north)


def _rotations(table: Table, drive: DrivePoses) -> dict[str, Array]:
    """(T, 4) quaternions by the value of `pose_angles`; "" where there is one reading."""
    if table.has(*MATRIX):
        matrices = table.numbers(*MATRIX).reshape(-1, 3, 4)[..., :3]
        errors = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        for wrong, why in (
            (errors > ROTATION_TOLERANCE, ""), (np.linalg.det(matrices) < 0, ": they mirror (determinant -1)"),
        ):  # fmt: skip
            if wrong.any():
                line = table.spans[int(wrong.argmax()), 0]
                what = f"the first three columns of its matrix are no rotation{why}"
                raise InputError(f"{table.path}: line {line}: {what}")
        return {"": quaternion_from_rotation(matrices)}
    if table.has(*QUATERNION):
        return _of_quaternions(table, drive)
    return _of_angles(table, drive)


def _of_quaternions(table: Table, drive: DrivePoses) -> dict[str, Array]:
    """The quaternions of a file with names, and both orders of one without."""
    quaternions = table.numbers(*QUATERNION)
    norms = np.linalg.norm(quaternions, axis=1)
    wrong = np.abs(norms - 1) > NORM_TOLERANCE
    if wrong.any():
        row = int(wrong.argmax())
        message = f"the quaternion's norm is {norms[row]:.6g} (expected 1): check its digits"
        raise table.row(row).error("qw..qz", message)
    quaternions = quaternions / norms[:, None]
    order = "wxyz" if next(name for name in table.columns if name in QUATERNION) == "qw" else "xyzw"
    orders = {order: quaternions}
    if table.columns["qw"] in ("", "qw [?]"):
        first = order == "wxyz"
        orders["xyzw" if first else "wxyz"] = np.roll(quaternions, 1 if first else -1, axis=1)
    return {name: orders[name] for name in orders if drive.stated.pose_angles in (None, name)} or orders


def _of_angles(table: Table, drive: DrivePoses) -> dict[str, Array]:
    """Degrees or radians, counter-clockwise from x or clockwise from y, which is north."""
    name = "heading" if table.has("heading") else "yaw"
    if table.has("heading", "yaw"):
        raise InputError(f"{table.path}: has a column of yaw and one of heading: remove one")
    angles, of_gps = table.numbers("roll", "pitch", name), table.has("latitude")
    kinds = list(ANGLES[0 if table.has(*ROTATION_VECTOR) else 1 :])
    if name == "heading" and of_gps:
        kinds.sort(key=lambda kind: (kind != "compass", kind != "compass-radians"))
    if mark := re.search(r"[_\[( ](deg|rad)", table.columns[name]):
        kinds = [kind for kind in kinds if ("rad" in kind) == (mark[1] == "rad")]
    if np.abs(angles).max() > LARGEST_RADIANS:
        kinds = [kind for kind in kinds if "rad" not in kind and kind != "vector"]
    rotations = {}
    for kind in [drive.stated.pose_angles] if drive.stated.pose_angles in ANGLES else kinds:
        if kind == "vector":
            rotations[kind] = np.roll(Rotation.from_rotvec(angles).as_quat(), 1, axis=1)
            continue
        roll, pitch, yaw = (angles if "rad" in kind else np.radians(angles)).T
        if kind.startswith(("compass", "clockwise")):
            pitch, yaw = -pitch, (np.pi / 2 if kind.startswith("compass") else 0) - yaw
        rotations[kind] = quaternions_of_angles(roll, pitch, yaw)
    return rotations


# Times (T,) in ns, translations (T, 3) in metres in the world frame, and quaternions (T, 4) of world_from_ego.
PoseTable: TypeAlias = tuple[NDArray[np.int64], Array, Array]


def motion_of_keyframes(keyframes: PoseTable, others: PoseTable) -> EgoMotion:
    """The poses at the times of keyframes, which increase, and at other times in any order.

    Kinematics are derived from the keyframes only: differentiating poses a few milliseconds apart amplifies noise.
    """
    key_times = keyframes[0]
    rough = EgoMotion(*keyframes, *derive_kinematics(*keyframes))
    # Of equal times the first is kept, so that keyframes take precedence.
    times, first = np.unique(np.concatenate([key_times, others[0]]), return_index=True)
    translations, quaternions = (np.concatenate([keyframes[k], others[k]])[first] for k in (1, 2))
    derived = [rough.kinematics_at(int(time)) for time in np.clip(times, key_times[0], key_times[-1])]
    kinematics = zip(*(vars(at_time).values() for at_time in derived), strict=True)
    return EgoMotion(times, translations, quaternions, *map(np.stack, kinematics))
