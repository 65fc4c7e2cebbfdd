"""Ego-motion with the common mistakes, and timestamps of images: each mistake is found, and nothing else."""

import numpy as np
import pytest
from mistakes import MOTION_MISTAKES, drive, motion_of

from bevcli.rig.check_calibration import check_camera_times
from bevcli.rig.sequence_checks import check_ego_motion
from bevcli.sequences.files.ego_motion_file import read_ego_motion


@pytest.mark.parametrize("start_yaw", [0.0, 0.7, 2.0, -3.0])
@pytest.mark.parametrize("speed", [0.0, 3.0, 8.0, 35.0])
def test_a_healthy_drive_gives_no_finding(speed, start_yaw):
    assert check_ego_motion(drive(speed=speed, start_yaw=start_yaw)) == ()


@pytest.mark.parametrize("start_yaw", [0.7, 2.0, -2.5])
@pytest.mark.parametrize("name", MOTION_MISTAKES)
def test_a_mistake_is_found_alone(name, start_yaw):
    code, spoil = MOTION_MISTAKES[name]
    assert [finding.code for finding in check_ego_motion(spoil(drive(start_yaw=start_yaw)))] == [code]


def test_parking_in_reverse_for_a_while_is_no_mistake():
    there, back = drive(seconds=15.0), drive(seconds=15.0)
    times = np.arange(len(there.timestamps_ns) * 5 // 4) / 20
    places = np.concatenate([there.translations, there.translations[: -len(there.translations) // 4 - 1 : -1]])
    quaternions = np.concatenate([there.quaternions, back.quaternions[: -len(there.translations) // 4 - 1 : -1]])
    count = min(len(times), len(places))
    assert check_ego_motion(motion_of(times[:count], places[:count], quaternions[:count])) == ()


def test_the_real_drive_gives_no_finding(shared):
    assert check_ego_motion(read_ego_motion(shared / "data/nuscenes-scene-0103/ego_motion.csv")) == ()


def test_one_row_gives_no_finding():
    motion = drive(seconds=0.05)
    assert len(motion.timestamps_ns) == 1
    assert check_ego_motion(motion) == ()


FRAMES = [10**18 + i * 500_000_000 for i in range(10)]


def late_by(milliseconds):
    return [time + milliseconds * 1_000_000 for time in FRAMES]


def test_cameras_within_hundredths_of_a_second_give_no_finding():
    assert check_camera_times(FRAMES, {"front": FRAMES, "back": late_by(-43), "left": late_by(40)}) == ()


@pytest.mark.parametrize(
    ("offset", "severity"), [(150, "warning"), (-200, "warning"), (700, "error"), (-3000, "error")]
)
def test_a_camera_that_is_late_or_early_is_named(offset, severity):
    (finding,) = check_camera_times(FRAMES, {"front": FRAMES, "back": late_by(offset)})
    assert (finding.code, finding.severity, finding.camera) == ("time-offset", severity, "back")
    assert f"{offset:+d} ms" in finding.found


def test_a_camera_with_jitter_is_named():
    wandering = [time + (i % 2) * 140_000_000 for i, time in enumerate(FRAMES)]
    (finding,) = check_camera_times(FRAMES, {"front": FRAMES, "back": wandering})
    assert (finding.severity, finding.camera) == ("warning", "back")


def test_a_camera_without_any_image_is_named():
    (finding,) = check_camera_times(FRAMES, {"front": FRAMES, "back": [None] * len(FRAMES)})
    assert (finding.code, finding.camera) == ("camera-without-images", "back")


def test_velocities_from_uneven_poses_are_not_blamed(tmp_path):
    times = np.cumsum([0, *[10, 990] * 20]) * 1_000_000 + 10**18
    speeds = np.repeat([0.5, 30.0], 20)
    lines = ["timestamp_ns,x,y,z,qw,qx,qy,qz"]
    places = np.concatenate([[0], np.cumsum(speeds * np.diff(times) / 1e9)])
    lines += [f"{time},{x},0,0,1,0,0,0" for time, x in zip(times, places, strict=True)]
    path = tmp_path / "ego_motion.csv"
    path.write_text("\n".join(lines) + "\n")
    motion = read_ego_motion(path)
    assert not motion.velocities_are_stated
    assert "ego-speed" not in [finding.code for finding in check_ego_motion(motion)]
    path.write_text("\n".join([lines[0] + ",vx,vy,vz", *(line + ",1,0,0" for line in lines[1:])]) + "\n")
    assert "ego-speed" in [finding.code for finding in check_ego_motion(read_ego_motion(path))]
