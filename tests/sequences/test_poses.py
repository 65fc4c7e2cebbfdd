"""Files of poses and positions: a circle, driven at a stated speed, is the same ego-motion in every format and unit."""

import json
import re
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.transforms import Pose, inverse, rigid
from bevcli.sequences.files.ego_motion_file import DrivePoses, FrameTimesNeeded, ReadPoses, read_ego_motion, read_poses
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import RigOptions
from bevcli.workshop.formats.pose_readings import course

SPEED, RADIUS = 8.0, 40.0  # m/s, metres
START = 1_700_000_000_250_000_000
STEP = 100_000_000
COUNT = 60
TIMES = START + STEP * np.arange(COUNT)
TURN = SPEED / RADIUS * STEP * 1e-9 * np.arange(COUNT)  # radians since the start
YAW = TURN + 0.3
X, Y = RADIUS * np.sin(YAW), -RADIUS * np.cos(YAW)  # a turn to the left
QW, QZ = np.cos(YAW / 2), np.sin(YAW / 2)
# A camera that looks ahead, 10 degrees down and 5 to the left.
LOOKS = (
    rigid((0, 0, 0), [[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    @ Pose(np.zeros(3), np.array([np.cos(0.09), -np.sin(0.09), 0, 0])).matrix
)
LEFT = Camera("image_0", 1226, 370, np.diag([700.0, 700, 1]), rigid((1.1, 0.2, 1.6), LOOKS[:3, :3]))
RIG = CameraRig((replace(LEFT, name="CAM_2"), LEFT), default_ego_from_bev())
FRAMES = TIMES[5:50:5]


def read(path: Path, text: str, rig: CameraRig = RIG, frames=FRAMES, **stated) -> ReadPoses:
    path = path / "poses.txt"
    path.write_text(text)
    return read_poses(path, DrivePoses(rig, RigOptions(**stated), None if frames is None else np.asarray(frames)))


def lines(*columns, separator=" ", header="") -> str:
    rows = [separator.join(cell if isinstance(cell, str) else f"{cell:.9f}" for cell in row)
            for row in zip(*columns, strict=True)]  # fmt: skip
    return "\n".join(([header] if header else []) + rows) + "\n"


def in_unit(unit_ns: int, times=TIMES) -> list[str]:
    """The times as texts with all digits, as integer arithmetic makes them."""
    return [f"{time // unit_ns}" + (f".{time % unit_ns:09d}"[: len(str(unit_ns))] if unit_ns > 1 else "")
            for time in times.tolist()]  # fmt: skip


ZERO = np.zeros(COUNT)
S, MS, US, NS = (in_unit(unit) for unit in (10**9, 10**6, 10**3, 1))
LEVEL = (ZERO, ZERO)


def degrees_of(east, north, latitude=48.0, longitude=11.0):
    """Latitude and longitude by the lengths of a degree in series, which tables of geography state."""
    phi = np.radians(latitude)
    north_m = 111132.954 - 559.822 * np.cos(2 * phi) + 1.175 * np.cos(4 * phi)
    east_m = 111412.84 * np.cos(phi) - 93.5 * np.cos(3 * phi) + 0.118 * np.cos(5 * phi)
    return latitude + (north - north[0]) / north_m, longitude + (east - east[0]) / east_m


LATITUDE, LONGITUDE = ([f"{value:.12f}" for value in column] for column in degrees_of(X, Y))
COMPASS = np.degrees(np.pi / 2 - YAW) % 360
WRAPPED = np.degrees((YAW + np.pi) % (2 * np.pi) - np.pi)

DATES = [f"{np.datetime64(time, 'ns')}Z" for time in TIMES.tolist()]
MATRICES = np.tile(np.eye(4), (COUNT, 1, 1))  # world_from_ego
MATRICES[:, :2, 0] = np.stack([np.cos(YAW), np.sin(YAW)], 1)
MATRICES[:, :2, 1] = np.stack([-np.sin(YAW), np.cos(YAW)], 1)
MATRICES[:, :2, 3] = np.stack([X, Y], 1)

FORMATS = {
    "tum": (lines(S, X, Y, ZERO, *LEVEL, QZ, QW), "TUM, 60 rows at 10.0 Hz, seconds since 1970, quaternion x y z w"),
    "tum, commented": (
        lines(S, X, Y, ZERO, *LEVEL, QZ, QW, header="# ground truth\n# timestamp tx ty tz qx qy qz qw"),
        "TUM, 60 rows at 10.0 Hz, seconds since 1970, quaternion x y z w",
    ),
    "tum in ns": (lines(NS, X, Y, ZERO, *LEVEL, QZ, QW), "TUM, 60 rows at 10.0 Hz, nanoseconds since 1970"),
    "w first without names": (lines(S, X, Y, ZERO, QW, *LEVEL, QZ), "quaternion w x y z"),
    "quaternion first": (lines(S, QW, *LEVEL, QZ, X, Y, ZERO), "quaternion w x y z"),
    "without times": (lines(X, Y, ZERO, *LEVEL, QZ, QW), "the times of the frames, quaternion x y z w"),
    "3x4 with times": (lines(S, *MATRICES[:, :3].reshape(COUNT, 12).T), "matrices, 60 rows at 10.0 Hz, seconds since"),
    "4x4": (lines(*MATRICES.reshape(COUNT, 16).T), "KITTI, 60 rows at 10.0 Hz, the times of the frames"),
    "4x4 with times": (lines(S, *MATRICES.reshape(COUNT, 16).T, separator=","), "seconds since 1970"),
    "3x4 by columns": (lines(*MATRICES[:, :3].swapaxes(1, 2).reshape(COUNT, 12).T), "the times of the frames"),
    "rotation vectors": (
        lines(S, X, Y, ZERO, *LEVEL, YAW, separator=",", header="t,x,y,z,rx,ry,rz"), "rotation vectors"),
    "rows and columns": (
        lines(S, *MATRICES[:, :3, :3].reshape(COUNT, 9).T, X, Y, ZERO, separator=",",
              header="date,r11,r12,r13,r21,r22,r23,r31,r32,r33,tx,ty,tz"), "matrices, 60 rows"),
    "angles in Greek": (
        lines(S, X, Y, *LEVEL, YAW, separator=",", header="t,x,y,phi,theta,psi"), "yaw in radians"),
    "rostopic echo -p": (
        lines(range(COUNT), NS, X, Y, ZERO, *LEVEL, QZ, QW, separator=",", header="%time,field.header.stamp,"
              + ",".join(f"field.pose.pose.{name}" for name in (*(f"position.{axis}" for axis in "xyz"),
                                                                *(f"orientation.{axis}" for axis in "xyzw")))),
        "nanoseconds since 1970, quaternion x y z w"),
    "AirSim": (
        "VehicleName\tTimeStamp\tPOS_X\tPOS_Y\tPOS_Z\tQ_W\tQ_X\tQ_Y\tQ_Z\n"
        + lines(["Car"] * COUNT, MS, X, Y, ZERO, QW, *LEVEL, QZ, separator="\t"), "quaternion w x y z"),
    "VINS-Fusion": (lines(NS, X, Y, ZERO, QW, *LEVEL, QZ, *[ZERO] * 3, [""] * COUNT, separator=","), "EuRoC, 60 rows"),
    "x, y and yaw without names": (lines(S, X, Y, YAW), "seconds since 1970, yaw in radians"),
    "angles without names": (lines(S, X, Y, ZERO, *LEVEL, YAW), "seconds since 1970, yaw in radians"),
    "PandaSet": (
        lines(S, X, Y, ZERO, QW, *LEVEL, QZ, separator=",", header="t,position.x,position.y,position.z,heading.w,"
              "heading.x,heading.y,heading.z"), "quaternion w x y z"),
    "json by times": (
        json.dumps(dict(zip(map(str, TIMES.tolist()), MATRICES.tolist(), strict=True))), "matrices, 60 rows"),
    "theta": (lines(S, X, Y, YAW, separator=",", header="t,x,y,theta"), "yaw in radians"),
    "indices": (lines(range(COUNT), X, Y, YAW, separator=",", header="frame,x,y,yaw"), "the times of the frames"),
    "json": (json.dumps({"poses": [
        {"stamp": time, "pose": {"position": [x, y, 0.0], "rotation": [0.0, 0.0, z, w]}}
        for time, x, y, z, w in zip(TIMES.tolist(), X, Y, QZ, QW, strict=True)]}), "quaternion x y z w"),
    "a json object a line": (
        "\n".join(json.dumps({"timestamp_us": time // 1000, "pose": matrix.tolist()})
                  for time, matrix in zip(TIMES.tolist(), MATRICES, strict=True)), "microseconds since 1970"),
    "gps in integers": (
        lines(S, *(np.round(np.array(each, float) * 1e7).astype(int) for each in (LATITUDE, LONGITUDE)), COMPASS,
              separator=",", header="timestamp,lat,lon,heading"), "in 1e-7 degrees"),
    "euroc": (
        lines(NS, X, Y, ZERO, QW, *LEVEL, QZ, *[ZERO] * 3, separator=",", header="#timestamp, "
              "p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
              "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]"),
        "EuRoC, 60 rows at 10.0 Hz, nanoseconds since 1970, quaternion w x y z",
    ),
    "euroc without names": (lines(NS, X, Y, ZERO, QW, *LEVEL, QZ, separator=","), "EuRoC, 60 rows"),
    "yaw": (lines(S, X, Y, YAW, separator=",", header="time,x,y,yaw"), "seconds since 1970, yaw in radians"),
    "yaw in degrees, milliseconds": (
        lines(MS, X, Y, WRAPPED, separator=",", header="t,pos_x,pos_y,yaw"), "milliseconds since 1970, yaw in degrees"),
    "heading from north": (lines(US, X, Y, COMPASS, separator=",", header="stamp,x,y,heading"),
                           "microseconds since 1970, heading in degrees clockwise from north"),
    "angles, semicolons, decimal commas": (
        lines(S, *LEVEL, WRAPPED, X, Y, ZERO, separator=";", header="time [s];roll [deg];pitch [deg];yaw [deg];x;y;z")
        .replace(".", ","), "yaw in degrees"),
    "ros": (lines(NS, X, Y, ZERO, *LEVEL, QZ, QW, separator=",", header="%time," + ",".join(
        [f"field.pose.pose.position.{axis}" for axis in "xyz"] +
        [f"field.pose.pose.orientation.{axis}" for axis in "xyzw"])), "CSV, 60 rows"),
    "seconds and nanoseconds": (
        lines([str(time // 10**9) for time in TIMES.tolist()], [str(time % 10**9) for time in TIMES.tolist()], X, Y, QW,
              *LEVEL, QZ, separator=",", header="sec,nanosec,x,y,qw,qx,qy,qz"), "seconds and nanoseconds"),
    "gps": (lines(S, LATITUDE, LONGITUDE, ZERO + 520, COMPASS, separator=",", header="timestamp,lat,lon,alt,heading"),
            "GPS, 60 rows at 10.0 Hz, seconds since 1970, heading in degrees clockwise from north"),
    "gps, dates": (
        lines(DATES, LATITUDE, LONGITUDE, COMPASS, separator=",", header="Timestamp,Latitude,Longitude,Bearing"),
        "GPS, 60 rows"),
}  # fmt: skip


@pytest.fixture(scope="module")
def circle(tmp_path_factory):
    """The ego-motion of the circle, by ego_motion.csv."""
    path = tmp_path_factory.mktemp("circle") / "ego_motion.csv"
    rows = lines(NS, X, Y, ZERO, QW, *LEVEL, QZ, separator=",", header="timestamp_ns,x,y,z,qw,qx,qy,qz")
    path.write_text(rows)
    return read_ego_motion(path)


def matrices(motion) -> np.ndarray:
    return np.stack([motion.pose_at(int(time)).matrix for time in motion.timestamps_ns])


def relative(motion) -> np.ndarray:
    """The poses seen from the first one, as the world of some formats is another one."""
    poses = matrices(motion)
    return inverse(poses[0]) @ poses


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_the_same_motion(name, circle, tmp_path):
    text, words = FORMATS[name]
    found = read(tmp_path, text, frames=TIMES if "times of the frames" in words else FRAMES)
    np.testing.assert_array_equal(found.motion.timestamps_ns, TIMES)
    tolerance = 0.02 if "integers" in name else 0.005 if "gps" in name else 1e-6
    compared = relative if "gps" in name else matrices
    np.testing.assert_allclose(compared(found.motion), compared(circle), atol=tolerance)
    np.testing.assert_allclose(
        np.linalg.norm(found.motion.velocities[1:-1], axis=1), SPEED, rtol=0.01 if "integers" in name else 1e-3
    )
    (note,) = found.notes
    assert re.fullmatch(f"poses: .*{re.escape(words)}.*, of the vehicle; cover all frames", note)


def camera_poses(first_world: bool) -> list[np.ndarray]:
    """Poses of the camera: in a world with z up, or in the frame of the camera at the first pose."""
    world_from_camera = [Pose(np.array([x, y, 0]), np.array([w, 0, 0, z])).matrix @ LEFT.ego_from_camera
                         for x, y, w, z in zip(X, Y, QW, QZ, strict=True)]  # fmt: skip
    return [inverse(world_from_camera[0]) @ pose if first_world else pose for pose in world_from_camera]


def kitti(poses) -> str:
    return "\n".join(" ".join(f"{value:.9e}" for value in pose[:3].ravel()) for pose in poses)


def test_kitti_is_of_camera_0_with_times_beside_it(circle, tmp_path):
    with pytest.raises(InputError, match=r"60 poses without times, and the drive has 9 frames: put times.txt beside"):
        read(tmp_path, kitti(camera_poses(first_world=True)))
    (tmp_path / "times.txt").write_text("\n".join(f"{STEP * place * 1e-9:.6e}" for place in range(COUNT)))
    found = read(tmp_path, kitti(camera_poses(first_world=True)), frames=FRAMES - START)
    np.testing.assert_array_equal(found.motion.timestamps_ns, TIMES - START)
    np.testing.assert_allclose(relative(found.motion), relative(circle), atol=1e-6)
    assert (
        "KITTI, 60 rows at 10.0 Hz, seconds, world_from_body, axes x right, y down, z forward, of image_0; cover all"
        in found.notes[0]
    )


@pytest.mark.parametrize("first_world", [True, False])
def test_poses_of_a_camera_are_a_reading(first_world, circle, tmp_path):
    poses = [Pose.from_matrix(pose) for pose in camera_poses(first_world)]
    columns = np.array([[*pose.translation, *np.roll(pose.quaternion, -1)] for pose in poses]).T
    text = lines(S, *columns)
    assert {each.camera for each in read(tmp_path, text).readings} >= {"CAM_2", "image_0"}
    found = read(tmp_path, text, poses_of="image_0")
    np.testing.assert_allclose(relative(found.motion), relative(circle), atol=1e-6)
    assert "of image_0" in found.notes[0]
    with pytest.raises(InputError, match=r"`poses_of=left` .`--poses-of`.: is not in the rig \(.* vehicle, CAM"):
        read(tmp_path, text, poses_of="left")


def test_a_world_far_away_is_in_metres_too(tmp_path):
    """In the frame of a vehicle that turns, its origin moves faster than vehicles do."""
    far = np.linalg.inv(MATRICES + 10_000 * np.eye(4, k=3))
    found = read(tmp_path, lines(S, *far[:, :3].reshape(COUNT, 12).T))
    assert {each.states.get("pose_unit", "m") for each in found.readings} == {"m"}


def test_real_kitti_poses_are_those_of_the_folder(shared, tmp_path):
    drive = open_sequence(shared / "data/kitti-straight", ego_motion="optional")
    motion, camera = drive.ego_motion, drive.rig.cameras[0]
    in_camera = [camera.camera_from_ego @ pose @ camera.ego_from_camera for pose in matrices(motion)]
    found = read(tmp_path, kitti(in_camera), rig=drive.rig, frames=motion.timestamps_ns)
    np.testing.assert_allclose(matrices(found.motion), matrices(motion), atol=1e-6)


def standing(text_yaw: str) -> str:
    return lines(S, ZERO, ZERO, [text_yaw] * 30 + ["0.5"] * 30, separator=",", header="t,x,y,yaw")


@pytest.mark.parametrize(("unit", "turn"), [("degrees", np.radians(0.5)), ("radians", 0.5)])
def test_angles_that_nothing_decides_are_readings(unit, turn, tmp_path):
    usual = {each.states["pose_angles"] for each in read(tmp_path, standing("0")).readings if not each.rank}
    assert usual == {"degrees", "radians"}
    found = read(tmp_path, standing("0"), pose_angles=unit)
    assert Pose(np.zeros(3), found.motion.quaternions[-1]).yaw == pytest.approx(turn)
    assert read(tmp_path, standing("0.5")).motion.velocities == pytest.approx(0)  # one that does not turn needs no unit


def test_w_first_is_no_usual_reading_of_tum(tmp_path):
    """It is believed only where it fits much better: a vehicle that stands shows nothing."""
    found = read(tmp_path, lines(S, ZERO, ZERO, ZERO, *LEVEL, QZ, QW))
    assert {each.states["pose_angles"] for each in found.readings if not each.rank} == {"xyzw"}


def test_times_of_frames_that_are_not_known_are_asked_for(circle, tmp_path):
    for name in ("tum", "yaw in degrees, milliseconds", "gps"):
        found = read(tmp_path, FORMATS[name][0], frames=None)
        np.testing.assert_array_equal(found.motion.timestamps_ns, TIMES)
        assert found.notes[0].endswith(", of the vehicle")
    for text in (kitti(camera_poses(first_world=True)), SLOW):
        with pytest.raises(FrameTimesNeeded):
            read(tmp_path, text, frames=None)


# A row a second of a slow vehicle, or one a millisecond.
SLOW = lines([f"{place}" for place in range(COUNT)], X / 1000, Y / 1000, ZERO, *LEVEL, QZ, QW)


def test_times_with_two_readings_are_asked_for(tmp_path):
    frames = [5_000_000, 10_000_000]
    with pytest.raises(InputError, match=r"may be seconds or milliseconds: pass `pose_times=s` .* or `pose_times=ms`"):
        read(tmp_path, SLOW, frames=frames)
    assert read(tmp_path, SLOW, frames=frames, pose_times="ms").motion.last_ns == 59_000_000
    assert "seconds" in read(tmp_path, SLOW, frames=[5 * 10**9, 55 * 10**9]).notes[0]  # only these cover the frames


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (lines(["1.70000E+09"] * COUNT, X, Y, ZERO, *LEVEL, QZ, QW), 'line 1, column time: the last digits of "1.7'),
        (lines(S[::-1], X, Y, ZERO, *LEVEL, QZ, QW), "line 2: its time is not later"),
        (lines(S, X, Y, ZERO, *LEVEL, QZ, QW + 0.01), "quaternion's norm is .*expected 1"),
        (lines(S, *LEVEL, separator=",", header="t,x,y"), "columns of the orientation are missing"),
        (lines(X[1:], Y[1:], YAW[1:], separator=",", header="x,y,yaw"), "a column of times is missing"),
        ("VERTEX_SE3:QUAT 0 1 2 0 0 0 0 1", "is a graph of g2o, which has no times: write its poses as CSV with"),
        ("\x93NUMPY\x01\0", "is no text: write its poses as CSV with the columns timestamp,x,y,z,qw,qx,qy,qz"),
        ('{"poses": [{"t": 1, "x": 2', "broken JSON"),
        ("[" * 100_000, "nested too deeply"),
        ('[{"t": 1, "x": 0, "y": 0}, {"t": 2, "x": 0}]', "pose 1 has other fields than the first one"),
        (lines(S, X, Y, YAW, YAW, separator=",", header="t,x,y,yaw,heading"), "yaw and one of heading"),
        (lines(S, X, X, Y, YAW, separator=",", header="t,x,px,y,yaw"), 'columns "x" and "px" are both x'),
        (lines(S, X + 91, Y, YAW, separator=",", header="t,lat,lon,yaw"), "is no place on Earth"),
        (lines(S, X, Y, ZERO, *LEVEL, QZ, QW) + "1 2 3\n", "line 61 has 3 cells"),
        (lines(S, ["nan"] * COUNT, Y, ZERO, *LEVEL, QZ, QW), "expected a finite number"),
        (kitti([2 * pose for pose in camera_poses(True)]), "line 1: .* are no rotation"),
        (kitti([pose @ np.diag([-1.0, 1, 1, 1]) for pose in camera_poses(True)]), "line 1: .*: they mirror"),
        (kitti([pose * [[-1], [-1], [-1], [1]] for pose in camera_poses(True)]), "line 1: .*: they mirror"),
        (lines(NS, ["0"] * COUNT, X, Y, YAW, separator=",", header="time,nsecs,x,y,yaw"), "time: .* s is too large"),
        (lines(["1"] * COUNT, NS, X, Y, YAW, separator=",", header="secs,nsecs,x,y,yaw"), "nsecs: .* no part of"),
        (lines(["9" * 30] * COUNT, X, Y, YAW, separator=",", header="t,x,y,yaw"), "too large for a time in any unit"),
        (lines(["1e19"] * COUNT, X, Y, YAW, separator=",", header="t,x,y,yaw"), "the last digits|too large"),
        (lines(NS, X, Y, YAW, separator=",", header="time_s,x,y,yaw"), "too large for seconds"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_that_names_the_place(text, said, tmp_path):
    with pytest.raises(InputError, match=said):
        read(tmp_path, text, frames=TIMES)


@pytest.mark.slow
def test_poses_of_a_long_drive_take_little_memory(tmp_path):
    """The file has 6 MB, and the poses 19."""
    count = 140_000
    times = (START + 10**6 * np.arange(count)).tolist()
    own, other = tmp_path / "own.csv", tmp_path / "other.csv"
    rows = [f"{time},{place / 100:.2f},0,0,1,0,0,0\n" for place, time in enumerate(times)]
    own.write_text("timestamp_ns,x,y,z,qw,qx,qy,qz\n" + "".join(rows))
    other.write_text("time_ns,x,y,z,qw,qx,qy,qz\n" + "".join(rows))
    motions = []
    for path in (own, other):
        tracemalloc.start()
        try:
            motions.append(read_poses(path, DrivePoses(RIG, RigOptions(), FRAMES)).motion)
            assert tracemalloc.get_traced_memory()[1] < 90 << 20
        finally:
            tracemalloc.stop()
    assert motions[0].timestamps_ns.tolist() == times
    for name in ("timestamps_ns", "translations", "quaternions", "velocities", "accelerations", "angular_rates"):
        np.testing.assert_array_equal(getattr(motions[0], name), getattr(motions[1], name))


def test_a_drive_takes_a_file_and_says_what_it_understood(drive, tmp_path):
    seconds = np.arange(0.9, 2.7, 0.1)
    still = np.zeros(len(seconds))
    path = tmp_path / "trajectory.log"
    path.write_text(lines(seconds, seconds * 10, *[still] * 5, still + 1))
    opened = open_sequence(drive, ego_motion_file=path, image_check=False)  # the images are of another drive
    own = open_sequence(drive)
    assert opened.load(1).world_from_ego.translation == pytest.approx(own.load(1).world_from_ego.translation)
    assert any(re.match(r"poses: TUM, 18 rows at 10.0 Hz, seconds, .*cover all frames", note) for note in opened.notes)
    path.write_text(lines(seconds + 5, seconds * 10, *[still] * 5, still + 1))
    with pytest.raises(InputError, match=r"read as poses: TUM, 18 rows .*; cover 0 of 4 frames"):
        open_sequence(drive, ego_motion_file=path)


def test_a_place_on_earth_becomes_that_of_the_drive(drive, tmp_path):
    seconds = np.arange(0.9, 2.7, 0.1)
    path = tmp_path / "gps.csv"
    north = [f"{48 + 5e-5 * place}" for place in range(len(seconds))]
    path.write_text(lines(seconds, north, ["11.5"] * 18, ["0"] * 18, separator=",", header="t,lat,lon,heading"))
    opened = open_sequence(drive, ego_motion_file=path)
    assert (opened.facts.geo_origin.latitude_deg, opened.facts.geo_origin.longitude_deg) == (48, 11.5)
    moved = opened.load(2).world_from_ego.translation - opened.load(0).world_from_ego.translation
    assert moved == pytest.approx([0, 55.6, 0], abs=0.1)  # a second, 0.0005 degrees of latitude


def test_pitch_lifts_the_nose_with_a_heading_from_north(tmp_path):
    climbs = ZERO + 2.0  # degrees
    up = np.tan(np.radians(2)) * SPEED * 0.1 * np.arange(COUNT)
    header = "t,lat,lon,alt,roll_deg,pitch_deg,heading_deg"
    text = lines(S, LATITUDE, LONGITUDE, up, ZERO, climbs, COMPASS, separator=",", header=header)
    velocities = read(tmp_path, text).motion.velocities[1:-1]
    assert velocities[:, 2] == pytest.approx(0, abs=0.02)
    assert velocities[:, 0] == pytest.approx(SPEED / np.cos(np.radians(2)), abs=0.02)


# Positions of receivers and of other programs.
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
NED_TURN = (NED_YAW + np.pi) % (2 * np.pi) - np.pi
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
    "north, east, down, yaw": (table("time,pos_n,pos_e,pos_d,yaw", S, *NED, NED_TURN), "north, east and down", False),
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
