"""Tables of poses: the names of their columns, and their cells.

GPX, KML, NMEA, GoPro's and what `ros2 topic echo --csv` prints are made such tables.
"""

import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.parsing.documents import CSV_BYTES, CsvRow, parse_json, parse_numbers_at_once
from bevcli.parsing.files import read_bytes, read_text
from bevcli.sequences.files.json_fields import array_of_numbers
from bevcli.workshop.formats.markup import parse_xml

VECTOR, QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"m{row}{column}" for row in range(3) for column in range(4))  # world_from_camera, row by row
ANGLES = ("roll", "pitch", "yaw")
TUM = ("time", *VECTOR, "qx", "qy", "qz", "qw")
ROTATION_VECTOR = ("rx", "ry", "rz")
LAST_ROW = ("m30", "m31", "m32", "m33")
# The columns of tables without names: those of which the rotations are some are taken, the first of several.
UNNAMED = [
    (*time, *columns)
    for columns in (
        (*VECTOR, "qx", "qy", "qz", "qw"),
        (*VECTOR, *QUATERNION),
        (*QUATERNION, *VECTOR),
        ("qx", "qy", "qz", "qw", *VECTOR),
        MATRIX,
        [f"m{row}{column}" for column in range(4) for row in range(3)],
        (*MATRIX, *LAST_ROW),
        [f"m{row}{column}" for column in range(4) for row in range(4)],
    )
    for time in ((), ("time",))
] + [("time", *VECTOR, *ANGLES), ("time", *VECTOR[:2], "yaw"), (*VECTOR, *ANGLES)]
EUROC = ("time", *VECTOR, *QUATERNION)
LONGER = (8, 11, 17)  # columns of it: with velocities, as VINS-Fusion's, and with biases; they are left out
ROTATION_TOLERANCE = 0.01  # of the norm of a quaternion, and of the products of a matrix's rows
BLOCK = 65_536  # rows whose places in the text are made numbers at once
_LINE = re.compile(r"([^\r\n]*)(?:\r\n|\r|\n|\Z)")
_UNIT = "(?:_(?:m|mm|cm|km|s|sec|seconds|ms|us|ns|deg|degrees|rad|radians))?"
_LENGTH = "(?:_(?:m|mm|cm|km))?"
_OF = "(?:.*[._])?"  # such as field.pose.pose. in front of position.x
# By quantity, the names of its column in lower case.
NAMES = {
    "time": rf"t|secs?|seconds|(?:gps|unix|utc|date)[_ ]?time{_UNIT}|"
            rf"{_OF}(?:time|times|timestamp|timestamps|stamp|utime|epoch|date|datetime){_UNIT}",
    "seconds": rf"{_OF}secs?",
    "nanoseconds": rf"{_OF}(?:nsecs?|nanosecs?)",
    **{axis: rf"[pt]?_?{axis}{_LENGTH}|p_\w+_{axis}|{_OF}(?:pos|pose|position|translation|location)[._]?{axis}{_LENGTH}"
       f"|(?:pos_|ned_|enu_)?{other}(?:ing)?{_LENGTH}|(?:pos|ned|enu)_{other[0]}{_LENGTH}"
       for axis, other in zip(VECTOR, ("east", "north", "up"), strict=True)},
    "down": rf"(?:pos_|ned_)?down{_LENGTH}|(?:pos|ned)_d{_LENGTH}",
    **{f"q{axis}": rf"q_?{axis}|q_\w+_{axis}|{_OF}(?:quat|quaternion|orientation|rotation|rot)[._]?{axis}"
       rf"|{_OF}(?:heading|attitude)[._]?{axis}"
       for axis in "wxyz"},
    **{name: name for name in MATRIX},
    **{f"r{axis}": rf"r{axis}|(?:rot|rotation|rotation_?vector|rot_?vec|r_?vec|axis_?angle)[._]?{axis}"
       for axis in "xyz"},
    "latitude": rf"{_OF}lat(?:itude)?{_UNIT}",
    "longitude": rf"{_OF}(?:lon|lng|long|longitude){_UNIT}",
    "altitude": rf"{_OF}(?:alt|altitude|elevation|ele|height){_UNIT}",
    "roll": rf"{_OF}roll{_UNIT}|phi",
    "pitch": rf"{_OF}pitch{_UNIT}",  # theta is one beside psi, and alone a yaw
    "yaw": rf"{_OF}yaw{_UNIT}|psi|theta",
    "fix": rf"{_OF}(?:gps_?)?fix(?:_?(?:type|quality|mode))?",
    "status": rf"{_OF}(?:status\.status|status|nav_status)",
    "heading": rf"{_OF}(?:heading|course|azimuth|bearing){_UNIT}",
}  # fmt: skip
# Columns of messages that `ros2 topic echo --csv` prints, by their number.
POSE = "x,y,z,qx,qy,qz,qw"
MESSAGES = {
    10: f"sec,nanosec,frame_id,{POSE}",  # geometry_msgs/PoseStamped
    11: f"sec,nanosec,frame_id,child_frame_id,{POSE}",  # geometry_msgs/TransformStamped
    46: f"sec,nanosec,frame_id,{POSE}" + ",covariance" * 36,  # geometry_msgs/PoseWithCovarianceStamped
    89: f"sec,nanosec,frame_id,child_frame_id,{POSE}" + ",other" * 78,  # nav_msgs/Odometry
    18: "sec,nanosec,frame_id,status,service,latitude,longitude,altitude" + ",other" * 10,  # sensor_msgs/NavSatFix
}
MESSAGE = re.compile(r"[0-9]{1,10},[0-9]{1,9},[^0-9.,-]?[^,]*,")
# GoPro's names, and those here. Other columns of a table are left out.
GOPRO = {
    "date": "time", "gps (lat.) [deg]": "latitude", "gps (long.) [deg]": "longitude", "gps (alt.) [m]": "altitude",
    "fix": "fix",
}  # fmt: skip
NMEA = re.compile(r"\$(?:G[A-Z])(GGA|RMC),")
G2O = (b"VERTEX_", b"EDGE_", b"FIX ")  # begin its lines
AS_TEXT = "CSV with the columns timestamp,x,y,z,qw,qx,qy,qz"
XML = (b"<?xml", b"<gpx", b"<kml ")


@dataclass(frozen=True)
class Table:
    """The cells of a file of poses."""

    path: Path  # the file
    # quantity -> name of its column in the file, "" where the file has no names; in the order of the file
    columns: dict[str, str]
    places: Mapping[str, int]  # index of the column of each quantity
    text: str  # the text of the file
    spans: NDArray[np.int64]  # (T, 3) of each row: its line from 1, its start in the text and its end
    separator: str | None  # of the columns; None for spaces
    # (T,) numbers that take the place of a column, or are a new one
    values: Mapping[str, Array] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # how its numbers were understood

    def __len__(self) -> int:
        return len(self.spans)

    def has(self, *names: str) -> bool:
        """True where it has all of these quantities."""
        return all(name in self.columns for name in names)

    def rows(self) -> Iterator[CsvRow]:
        """All rows, each made when it is asked for: those of a million would fill the memory."""
        return map(self.row, range(len(self)))

    def row(self, index: int) -> CsvRow:
        """The cells of a row by quantity. index: from 0."""
        line, *span = self.spans[index].tolist()
        cells = _cells(self._text(span), self.separator)
        made = {name: cells[place] for name, place in self.places.items()}
        return CsvRow(
            self.path, line, made | {name: repr(float(column[index])) for name, column in self.values.items()}
        )

    def texts(self, name: str) -> Iterator[str]:
        """The cells of a column of the file."""
        place = self.places[name]
        return (_plain(line.split(self.separator, place + 1)[place]) for line in self.lines())

    def lines(self) -> Iterator[str]:
        """The lines of the rows, with points in numbers."""
        for first in range(0, len(self), BLOCK):
            yield from map(self._text, self.spans[first : first + BLOCK, 1:].tolist())

    def numbers(self, *names: str) -> Array:
        """(T, N) quantities; 0 where the table lacks one. Raises InputError that names line and column."""
        places = {name: self.places[name] for name in names if name in self.columns and name not in self.values}
        types = np.dtype([(name, "f8") for name in places])
        table = (
            parse_numbers_at_once(self.lines(), types, self.separator, places=[*places.values()]) if places else None
        )
        if table is None:
            table = np.zeros(len(self), types)
            for index, row in enumerate(self.rows() if places else ()):
                table[index] = tuple(row.number(name) for name in places)
        given = {**{name: table[name] for name in places}, **self.values}
        return np.stack([given.get(name, np.zeros(len(self))) for name in names], axis=1)

    def _text(self, span: list[int]) -> str:
        line = self.text[slice(*span)].strip()
        return line.replace(",", ".") if self.separator in (";", "\t") else line


def read_table(path: Path) -> Table | None:
    """The cells of a text file with columns; None where it has no rows, or not two columns that are known.

    Names of columns stand in the line above the rows, which may be a comment. Raises InputError for a row with another
    number of cells.
    """
    text, header, spans = table_text(path), "", array("q")
    for number, match in enumerate(_LINE.finditer(text), 1):
        line = match[1].strip()
        if line.startswith(("#", "%")) or (not spans and re.match("[\"'A-Za-z_]", line) and not _is_row(line)):
            header = header if spans else line.lstrip("#% ").lower()
        elif line:
            spans.extend((number, *match.span(1)))
    if not spans:
        return None
    row = text[spans[1] : spans[2]].strip()
    separator = next((sign for sign in (";", "\t", ",") if sign in row), None)
    count = len(_cells(row, separator))
    names = _cells(header, separator)
    names = names if len(names) == count else re.split(r"[,;\s]+", header)
    first = int("r33" in names)  # of the numbers of rows and columns
    names = [re.sub("^r([0-3])([0-3])$", lambda of: f"m{int(of[1]) - first}{int(of[2]) - first}", name)
             for name in names]  # fmt: skip
    if "psi" in names:
        names = ["pitch" if name == "theta" else name for name in names]
    places = _columns(path, names) if len(names) == count else {}
    if "m00" in places and {*VECTOR} <= places.keys():
        places |= {f"m{row}3": places[axis] for row, axis in enumerate(VECTOR)}
    if len(places) < 2:
        rows = [text[start:end] for _, start, end in np.reshape(spans, (-1, 3))[[0, len(spans) // 6, -1]].tolist()]
        unnamed = _unnamed([[number_of(cell) for cell in _cells(row, separator)] for row in rows], separator)
        places, names = {quantity: index for index, quantity in enumerate(unnamed)}, [""] * count
    if not places:
        return None
    columns = {quantity: names[index] for quantity, index in places.items()}
    table = Table(path, columns, places, text, np.array(spans).reshape(-1, 3), separator)
    for index, line in enumerate(table.lines()):
        if (found := len(_split(line, separator))) != count:
            number = table.spans[index, 0]
            raise InputError(f"{path}: line {number} has {found} cells (expected {count}, as in the first row)")
    return table


def _is_row(line: str) -> bool:
    """True for a line with the numbers of a pose, perhaps after a text."""
    return sum(number_of(cell) is not None for cell in re.split(r"[,;\s]+", line)) >= len(VECTOR)


def _unnamed(rows: list[list[float | None]], separator: str | None) -> Sequence[str]:
    """The columns of a table without names, by some of its rows; none where their number is not known."""
    count = len(rows[0])
    if separator == "," and count in LONGER:  # EuRoC's own order goes before that of TUM
        possible = [EUROC, *UNNAMED]
    else:
        possible = UNNAMED
    possible = [columns for columns in possible if len(columns) == count or (columns is EUROC and count in LONGER)]
    lengths = [np.linalg.norm(np.array(row[3:], np.float64)) for row in rows]
    if max(abs(length - 1) for length in lengths) < 10 * ROTATION_TOLERANCE:  # quaternions with wrong digits
        possible = [columns for columns in possible if "yaw" not in columns]
    return next((columns for columns in possible if all(_is_rotation(columns, row) for row in rows)),
                next(iter(possible), ()))  # fmt: skip


def _is_rotation(columns: Sequence[str], row: Sequence[float | None]) -> bool:
    """True where the numbers of a row are those of a rotation."""
    if len(row) < len(columns) or None in row:
        return False
    numbers = dict(zip(columns, np.array(row, np.float64), strict=False))
    if "yaw" in columns:
        return True
    if "qw" in columns:
        return bool(abs(np.linalg.norm([numbers[name] for name in QUATERNION]) - 1) < ROTATION_TOLERANCE)
    matrix = np.reshape([numbers[name] for name in MATRIX], (3, 4))[:, :3]
    last = [numbers.get(name, float(name == "m33")) for name in LAST_ROW]
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() < ROTATION_TOLERANCE and last == [0, 0, 0, 1])


def number_of(word: str) -> float | None:
    """The number that a word is; None for another word."""
    try:
        return float(word)
    except ValueError:
        return None


def read_column(path: Path, quantity: str) -> Table:
    """A table of a text that has one quantity a line. Raises InputError."""
    text = read_text(path, CSV_BYTES)
    spans = [(number, *line.span(1)) for number, line in enumerate(_LINE.finditer(text), 1) if line[1].strip()]
    return Table(path, {quantity: ""}, {quantity: 0}, text, np.array(spans, np.int64).reshape(-1, 3), "\n")


def _cells(text: str, separator: str | None) -> list[str]:
    return [_plain(cell) for cell in _split(text, separator)]


def _split(text: str, separator: str | None) -> list[str]:
    cells = text.strip().split(separator)
    return cells[:-1] if cells and not _plain(cells[-1]) else cells


def _plain(cell: str) -> str:
    return cell.strip().strip("\"'")


def _columns(path: Path, names: Sequence[str]) -> dict[str, int]:
    """The place of each known quantity. Raises InputError where two columns have the same."""
    places: dict[str, int] = {}
    for index, name in enumerate(names):
        plain = re.sub(r"\s*[\[(].*", "", name)  # without the unit
        quantity = next((quantity for quantity, pattern in NAMES.items() if re.fullmatch(pattern, plain)), None)
        # The time in a message, as rostopic has it, goes before that of its arrival.
        if quantity == "time" and quantity in places and name.endswith("stamp"):
            del places[quantity]
        if quantity in places:
            both = f'"{names[places[quantity]]}" and "{name}"'
            raise InputError(f"{path}: the columns {both} are both {quantity}: remove one")
        if quantity is not None:
            places[quantity] = index
    return places


def table_text(path: Path) -> str:
    """The text of a table of poses; of a file of another kind, a table of what it states. Raises InputError."""
    content = read_bytes(path, CSV_BYTES)
    if content.removeprefix(b"\xef\xbb\xbf").lstrip()[:5].lower() in XML:
        return "\n".join(_of_track(path))
    if b"\0" in content[:BLOCK] or content.lstrip().startswith(G2O):
        what = "is no text" if b"\0" in content[:BLOCK] else "is a graph of g2o, which has no times"
        raise InputError(f"{path}: {what}: write its poses as {AS_TEXT}")
    text = read_text(path, CSV_BYTES).removeprefix("\ufeff")
    first = text.lstrip().partition("\n")[0].strip()
    if first.startswith(("[", "{")):
        return "\n".join(_of_objects(path, text))
    if NMEA.match(first) or first.startswith("$G"):
        return "\n".join(_of_nmea(path, text))
    if MESSAGE.match(first) and (header := MESSAGES.get(first.count(",") + 1)):
        return f"{header}\n{text}"
    names = [name.strip().strip('"').lower() for name in first.split(",")]
    if "gps (lat.) [deg]" in names:
        header = ",".join(GOPRO.get(name, f"other{index}") for index, name in enumerate(names))
        return f"{header}\n{text.lstrip().partition(chr(10))[2]}"
    return text


def _of_objects(path: Path, text: str) -> Iterator[str]:
    """The poses of a JSON file: a list of objects, alone or in an object, or one object a line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if len(lines) > 1 and all(line.startswith("{") and line.endswith("}") for line in lines):
        text = "[" + ",\n".join(lines) + "]"
    entries = parse_json(text.encode(), path)
    if isinstance(entries, dict) and None not in map(number_of, entries):  # by their times
        entries = [{"time": time, **(of if isinstance(of, dict) else {"pose": of})} for time, of in entries.items()]
    elif isinstance(entries, dict):
        entries = next((each for each in entries.values() if isinstance(each, list)), [])
    rows = [dict(_flat("", entry)) for entry in entries if isinstance(entry, dict)]
    for index, row in enumerate(rows):
        if row.keys() != rows[0].keys():
            raise InputError(f"{path}: pose {index} has other fields than the first one: {', '.join(row)[:200]}")
    yield from (",".join(map(str, row)) for row in ([*rows[0]], *(row.values() for row in rows))) if rows else ()


def _flat(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The numbers and texts of a value in JSON by names of columns."""
    numbers = array_of_numbers(value) if isinstance(value, list) else None
    if isinstance(value, dict):
        for key, each in value.items():
            yield from _flat(f"{name}.{key}" if name else str(key), each)
    elif numbers is not None and numbers.shape in ((3, 4), (4, 4)):
        yield from zip(MATRIX, map(repr, numbers[:3].ravel().tolist()), strict=True)
    elif numbers is not None and numbers.shape in ((3,), (4,)):
        order = QUATERNION if name.endswith("wxyz") else ("qx [?]", "qy [?]", "qz [?]", "qw [?]")
        columns = [f"{name}.{axis}" for axis in VECTOR] if len(numbers) == 3 else order
        yield from zip(columns, map(repr, numbers.tolist()), strict=True)
    else:
        yield name, re.sub(r"[,\r\n]+", " ", str(value))


def _of_track(path: Path) -> Iterator[str]:
    """The points of a track in GPX, or in KML (gx:Track)."""
    yield "time,latitude,longitude,altitude"
    elements: dict[str, list[Element]] = {}
    for element in parse_xml(read_bytes(path, CSV_BYTES), path).iter():
        elements.setdefault(_tag(element), []).append(element)
    points, places, times = (elements.get(name, []) for name in ("trkpt", "coord", "when"))
    if not points and not places:
        raise InputError(f"{path}: has no points of a track (expected <trkpt> of GPX, or <gx:coord> of KML)")
    if places and len(places) != len(times):
        raise InputError(f"{path}: has {len(places)} places and {len(times)} times: export the track with times")
    for place, when in zip(places, times, strict=True):
        longitude, latitude, altitude = [*(place.text or "").split(), "", "", "0"][:3]
        yield f"{(when.text or '').strip()},{latitude},{longitude},{altitude or 0}"
    for number, point in enumerate(points, 1):
        values = {_tag(child): (child.text or "").strip() for child in point}
        if not values.get("time"):
            raise InputError(f"{path}: point {number} has no time: export the track with times")
        yield f"{values['time']},{point.get('lat', '')},{point.get('lon', '')},{values.get('ele') or 0}"


def _tag(element: Element) -> str:
    """The name of an element, without its namespace."""
    return re.sub(r"\{.*\}|.*:", "", str(element.tag))


def _of_nmea(path: Path, text: str) -> Iterator[str]:
    """The fixes of a receiver. GGA has no date: that of the RMC before is taken."""
    yield "time,latitude,longitude,altitude"
    date, altitude = "", "0"
    for line in text.splitlines():
        words = line.strip().partition("*")[0].split(",")
        kind = words[0][3:]
        if kind == "GGA" and len(words) > 9 and words[6] not in ("", "0"):
            altitude = words[9] or "0"
        if kind == "RMC" and len(words) > 9 and words[2] == "A":
            date = f"20{words[9][4:6]}-{words[9][2:4]}-{words[9][:2]}"
            time = f"{date}T{words[1][:2]}:{words[1][2:4]}:{words[1][4:].ljust(2, '0')}Z"
            yield f"{time},{_degrees(words[3], words[4])},{_degrees(words[5], words[6])},{altitude}"
    if not date:
        raise InputError(f"{path}: has no fix with a date (expected $GPRMC with status A)")


def _degrees(text: str, side: str) -> str:
    """Degrees of NMEA's degrees and minutes, such as 4808.21006, and N, S, E or W."""
    whole, _, fraction = text.partition(".")
    try:
        degrees = int(whole[:-2] or 0) + float(f"{whole[-2:]}.{fraction}") / 60
    except ValueError:
        return ""
    return repr(-degrees if side in ("S", "W") else degrees)
