"""Files of positions without named columns, as tables: GPX, KML, NMEA, and what `ros2 topic echo --csv` prints."""

import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

from bevcli.errors import InputError
from bevcli.parsing.documents import CSV_BYTES
from bevcli.parsing.files import read_bytes, read_text
from bevcli.workshop.formats.markup import parse_xml

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
XML = (b"<?xml", b"<gpx", b"<kml ")


def table_text(path: Path) -> str:
    """The text of a table of poses; of a file of another kind, a table of what it states. Raises InputError."""
    if read_bytes(path, CSV_BYTES).removeprefix(b"\xef\xbb\xbf").lstrip()[:5].lower() in XML:
        return "\n".join(_of_track(path))
    text = read_text(path, CSV_BYTES).removeprefix("\ufeff")
    first = text.lstrip().partition("\n")[0].strip()
    if NMEA.match(first) or first.startswith("$G"):
        return "\n".join(_of_nmea(path, text))
    if MESSAGE.match(first) and (header := MESSAGES.get(first.count(",") + 1)):
        return f"{header}\n{text}"
    names = [name.strip().strip('"').lower() for name in first.split(",")]
    if "gps (lat.) [deg]" in names:
        header = ",".join(GOPRO.get(name, f"other{index}") for index, name in enumerate(names))
        return f"{header}\n{text.lstrip().partition(chr(10))[2]}"
    return text


def _of_track(path: Path) -> Iterator[str]:
    """The points of a track in GPX, or in KML (gx:Track)."""
    yield "time,latitude,longitude,altitude"
    elements: dict[str, list[Element]] = {}
    for element in parse_xml(read_bytes(path, CSV_BYTES), path).iter():
        elements.setdefault(_plain(element), []).append(element)
    points, places, times = (elements.get(name, []) for name in ("trkpt", "coord", "when"))
    if not points and not places:
        raise InputError(f"{path}: has no points of a track (expected <trkpt> of GPX, or <gx:coord> of KML)")
    if places and len(places) != len(times):
        raise InputError(f"{path}: has {len(places)} places and {len(times)} times: export the track with times")
    for place, when in zip(places, times, strict=True):
        longitude, latitude, altitude = [*(place.text or "").split(), "", "", "0"][:3]
        yield f"{(when.text or '').strip()},{latitude},{longitude},{altitude or 0}"
    for number, point in enumerate(points, 1):
        values = {_plain(child): (child.text or "").strip() for child in point}
        if not values.get("time"):
            raise InputError(f"{path}: point {number} has no time: export the track with times")
        yield f"{values['time']},{point.get('lat', '')},{point.get('lon', '')},{values.get('ele') or 0}"


def _plain(element: Element) -> str:
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
