import numpy as np
import pytest

from bevcli.errors import InputError
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics


def circle_drive(radius=20.0, speed=8.0, count=200, step_s=0.02):
    """A drive on a circle: constant speed, turning left."""
    seconds = np.arange(count) * step_s
    yaws = seconds * speed / radius
    translations = np.stack([radius * np.sin(yaws), radius * (1 - np.cos(yaws)), 0 * yaws], axis=-1)
    quaternions = np.stack([np.cos(yaws / 2), 0 * yaws, 0 * yaws, np.sin(yaws / 2)], axis=-1)
    times = (seconds * 1e9).astype(np.int64) + 1_533_151_603_000_000_001
    return EgoMotion(times, translations, quaternions, *derive_kinematics(times, translations, quaternions))


def test_derived_kinematics_of_a_circle():
    drive = circle_drive()
    at = drive.kinematics_at(int(drive.timestamps_ns[100]))
    assert at.velocity == pytest.approx([8, 0, 0], abs=0.01)
    assert at.angular_rate == pytest.approx([0, 0, 0.4], abs=0.001)
    assert at.acceleration == pytest.approx([0, 3.2, 9.81], abs=0.01)  # v²/r to the left, and gravity


def test_time_of_a_row_gives_exactly_that_row():
    drive = circle_drive()
    pose = drive.pose_at(int(drive.timestamps_ns[7]))
    assert (pose.translation == drive.translations[7]).all()
    assert (pose.quaternion == drive.quaternions[7]).all()


def test_between_rows_the_pose_lies_between():
    drive = circle_drive(step_s=0.5, count=4)
    middle = (int(drive.timestamps_ns[0]) + int(drive.timestamps_ns[1])) // 2
    assert drive.pose_at(middle).yaw == pytest.approx(0.1)


def test_time_more_than_50_ms_outside_is_an_error():
    drive = circle_drive()
    last = int(drive.timestamps_ns[-1])
    assert (drive.pose_at(last + 50_000_000).translation == drive.translations[-1]).all()
    with pytest.raises(InputError, match="50 ms"):
        drive.pose_at(last + 50_000_001)


def upright(pitches, slope_deg=4.0, step_s=0.02):
    """A straight drive at 10 m/s down a slope, whose body pitches over it. pitches: (T,) degrees."""
    half = np.radians(slope_deg + pitches) / 2
    quaternions = np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half], axis=-1)
    seconds = step_s * np.arange(len(pitches))
    times, slope = (seconds * 1e9).astype(np.int64), np.radians(slope_deg)
    translations = 10 * seconds[:, None] * (np.cos(slope), 0, -np.sin(slope))
    return EgoMotion(times, translations, quaternions, *derive_kinematics(times, translations, quaternions))


def test_the_road_is_as_the_vehicle_stands_on_the_mean():
    """On a slope too, where gravity tells another direction."""
    seconds = np.arange(0, 20, 0.02)
    drive = upright(np.sin(2 * np.pi * seconds / 2))
    for row in (300, 425, 575, 700):
        pitch = np.radians(np.sin(np.pi * seconds[row]))
        normal = drive.road_normal_at(int(drive.timestamps_ns[row]))
        assert normal == pytest.approx([-np.sin(pitch), 0, np.cos(pitch)], abs=5e-4)  # nose down: up is aft


def test_a_body_that_never_moves_stands_on_its_road():
    drive = upright(np.zeros(50))
    assert drive.road_normal_at(int(drive.timestamps_ns[20])) == pytest.approx([0, 0, 1])
    one = drive.of_rows(np.array([3]))
    assert one.road_normal_at(one.first_ns) == pytest.approx([0, 0, 1])
