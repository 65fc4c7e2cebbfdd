"""Positions of receivers and of other programs: the circle of test_poses, in units, frames and files of theirs."""

import re

import numpy as np
import pytest
from test_poses import (
    COMPASS,
    COUNT,
    DATES,
    LATITUDE,
    LEVEL,
    LONGITUDE,
    MS,
    NS,
    QW,
    QZ,
    TIMES,
    YAW,
    ZERO,
    S,
    X,
    Y,
    circle,
    lines,
    matrices,
    read,
    relative,
)  # fmt: skip

from bevcli.errors import InputError
from bevcli.workshop.formats.pose_units import course

__all__ = ["circle"]  # a fixture
SECONDS, NANOSECONDS = [text[:10] for text in S], [str(int(text[11:])) for text in S]
RADIANS = [[f"{np.radians(float(text)):.15f}" for text in column] for column in (LATITUDE, LONGITUDE)]
QUATERNIONS = (ZERO, ZERO, QZ, QW)


def message(*columns, after=0, frames=("map",)):
    names = [[frame] * COUNT for frame in frames]
    return lines(SECONDS, NANOSECONDS, *names, *columns, *[ZERO] * after, separator=",")


def gpx(version="1.1"):
    points = "".join(
        f'<trkpt lat="{latitude}" lon="{longitude}"><ele>520.0</ele><time>{date}</time></trkpt>\n'
        for latitude, longitude, date in zip(LATITUDE, LONGITUDE, DATES, strict=True)
    )
    name = f'xmlns="http://www.topografix.com/GPX/{version.replace(".", "/")}" version="{version}"'
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<gpx {name}><trk><trkseg>{points}</trkseg></trk></gpx>'


def kml():
    whens = "".join(f"<when>{date}</when>" for date in DATES)
    places = "".join(f"<gx:coord>{lon} {lat} 520</gx:coord>" for lat, lon in zip(LATITUDE, LONGITUDE, strict=True))
    name = 'xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"'
    return f"<kml {name}><Document><Placemark><gx:Track>{whens}{places}</gx:Track></Placemark></Document></kml>"


def gopro(fix=("3",) * COUNT, latitude=LATITUDE):
    head = ('"cts","date","GPS (Lat.) [deg]","GPS (Long.) [deg]","GPS (Alt.) [m]","GPS (2D speed) [m/s]",'
            '"GPS (3D speed) [m/s]","fix","precision","altitude system"')  # fmt: skip
    dates, system = [f'"{date}"' for date in DATES], ['"MSLV"'] * COUNT
    return lines(MS, dates, latitude, LONGITUDE, ZERO, ZERO, ZERO, list(fix), ZERO, system, separator=",", header=head)


def nmea():
    sentences = []
    for latitude, longitude, date in zip(LATITUDE, LONGITUDE, DATES, strict=True):
        places = []
        for text, digits in ((latitude, 2), (longitude, 3)):
            whole, fraction = divmod(float(text), 1)
            places.append(f"{int(whole):0{digits}d}{fraction * 60:013.10f}")
        time, day = date[11:19].replace(":", "") + date[19:23], date[8:10] + date[5:7] + date[2:4]
        sentences.append(f"$GNGGA,{time},{places[0]},N,{places[1]},E,4,12,0.6,520.0,M,47.0,M,,*5A")
        sentences.append(f"$GNRMC,{time},A,{places[0]},N,{places[1]},E,15.5,77.0,{day},,,A*5A")
    return "\n".join(sentences)


def table(header, *columns):
    return lines(*columns, separator=",", header=header)


NED = (Y, X, ZERO)  # north, east, down
# Body x forward, y right, z down in a world north, east, down: a turn about z by the compass.
NED_YAW = np.pi / 2 - YAW
WRAPPED = (NED_YAW + np.pi) % (2 * np.pi) - np.pi
# By name: a text, words of the note, and whether its heading is the course.
FILES = {
    "gps without heading": (table("timestamp,lat,lon,alt", S, LATITUDE, LONGITUDE, ZERO), "GPS", True),
    "gpx": (gpx(), "GPS", True),
    "gpx 1.0": (gpx("1.0"), "GPS", True),
    "kml": (kml(), "GPS", True),
    "gopro": (gopro(), "GPS", True),
    "nmea": (nmea(), "GPS", True),
    "radians": (table("time,latitude,longitude,heading", S, *RADIANS, COMPASS), "longitude in radians", False),
    "radians by name": (table("time,lat_rad,lon_rad,heading", S, *RADIANS, COMPASS), "in radians", False),
    "radians beside metres": (
        table("GPSTime,easting,northing,latitude,longitude,heading", S, X + 5e5, Y + 5e6, *RADIANS, COMPASS),
        "latitude and longitude in radians", False),
    "Odometry": (message(X, Y, ZERO, *QUATERNIONS, after=78, frames=("odom", "base")), "seconds and nano", False),
    "PoseStamped": (message(X, Y, ZERO, *QUATERNIONS), "seconds and nanoseconds", False),
    "PoseWithCovarianceStamped": (message(X, Y, ZERO, *QUATERNIONS, after=36), "seconds and nanoseconds", False),
    "TransformStamped": (message(X, Y, ZERO, *QUATERNIONS, frames=("odom", "base")), "seconds and nanoseconds", False),
    "NavSatFix": (message(["0"] * COUNT, ["1"] * COUNT, LATITUDE, LONGITUDE, ZERO, after=10), "GPS", True),
    "north, east, down, quaternion": (
        table("time,north,east,down,qw,qx,qy,qz", S, *NED, np.cos(NED_YAW / 2), *LEVEL, np.sin(NED_YAW / 2)),
        "north, east and down", False),
    "north, east, down, yaw": (table("time,pos_n,pos_e,pos_d,yaw", S, *NED, WRAPPED), "north, east and down", False),
    "millimetres": (table("time_ms,x_mm,y_mm,z_mm,yaw", MS, X * 1e3, Y * 1e3, ZERO, YAW), "CSV", False),
    "centimetres": (table("time,x [cm],y [cm],yaw [rad]", S, X * 100, Y * 100, YAW), "CSV", False),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_positions_in_files_and_units_of_others(name, circle, tmp_path):
    text, words, is_course = FILES[name]
    found = read(tmp_path, text)
    assert np.abs(found.motion.timestamps_ns - TIMES).max() < 2e6
    exact = not is_course and "radians" not in name
    compared = matrices if exact else relative
    np.testing.assert_allclose(compared(found.motion), compared(circle), atol=1e-5 if exact else 0.02)
    [note] = found.notes
    assert words in note
    assert ("the heading is the course" in note) == is_course


def test_rows_without_a_fix_are_left_out(circle, tmp_path):
    fix = ["0" if row in (7, 8, 30) else "3" for row in range(COUNT)]
    latitude = ["0.0" if row == 7 else text for row, text in enumerate(LATITUDE)]
    found = read(tmp_path, gopro(fix, latitude))
    assert len(found.motion.timestamps_ns) == COUNT - 3
    assert "3 without a fix left out" in found.notes[0]
    with pytest.raises(InputError, match=r"no row has a fix: measure the motion by `odometry=True`"):
        read(tmp_path, gopro(["0"] * COUNT))


def test_places_near_zero_are_degrees_of_a_simulator(circle, tmp_path):
    near = [[f"{float(text) - float(column[0]):.12f}" for text in column] for column in (LATITUDE, LONGITUDE)]
    found = read(tmp_path, table("time,latitude,longitude,heading", S, *near, COMPASS))
    assert "radians" not in found.notes[0]
    assert np.linalg.norm(found.motion.translations[-1] - found.motion.translations[0]) > 40
    # The option states it.
    found = read(tmp_path, table("time,latitude,longitude,yaw", S, *RADIANS, YAW), pose_angles="radians")
    np.testing.assert_allclose(relative(found.motion), relative(circle), atol=5e-3)


def test_places_that_fit_no_metres_beside_them_are_asked_for(tmp_path):
    text = table("time,easting,northing,latitude,longitude,heading", S, 9 * X, 9 * Y, *RADIANS, COMPASS)
    with pytest.raises(InputError, match=r"latitude and longitude move by 0.\d m .*pass `pose_angles=radians`"):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            table("time,lat,lon", S, LATITUDE[:1] * COUNT, LONGITUDE[:1] * COUNT),
            r"moves less than 5 m has no course: add",
        ),
        (table("time,x,y", S, X, Y), r"orientation are missing \(.*\): add them, or measure .* `odometry=True`"),
        ('<?xml version="1.0"?><gpx></gpx>', "has no points of a track"),
        (re.sub("<time>.*?</time>", "", gpx()), "point 1 has no time: export the track with times"),
        (gpx()[:300], "broken XML"),
        (
            message(X, Y, ZERO, *QUATERNIONS).replace("1700000000,", "9900000000,"),
            "s is too large for a time",
        ),
        ("$GNRMC,130225.00,V,,,,,,,260911,,,N*53\n", "has no fix with a date"),
    ],
)
def test_a_file_without_a_course_or_times_is_one_line(text, said, tmp_path):
    with pytest.raises(InputError, match=said):
        read(tmp_path, text)


def test_the_course_of_a_vehicle_that_stands_and_reverses():
    """It stands with noise of 0.3 m, drives 40 m ahead, stands, and drives 10 m backwards on the same line."""
    random = np.random.default_rng(0)
    along = np.concatenate([np.zeros(50), np.arange(0, 40, 0.5), np.full(50, 40.0), np.arange(40, 30, -0.5)])
    places = np.column_stack([along * np.cos(0.6), along * np.sin(0.6)]) + random.normal(0, 0.1, (len(along), 2))
    yaws = course(places, np.arange(len(along)) * 10**8)
    np.testing.assert_allclose(yaws, 0.6, atol=0.25)
    assert course(places[:50], np.arange(50) * 10**8) is None
    assert NS[0] == str(TIMES[0])
