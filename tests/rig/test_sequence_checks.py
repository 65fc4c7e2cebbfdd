"""Ego-motion: a drive made by integrating a speed along a curve, spoilt in the usual ways."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.rig.sequence_checks import check_camera_times, check_ego_motion
from bevcli.sequences.native.ego_motion_file import read_ego_motion


def drive(speed=8.0, seconds=20.0, rate=20.0, start_yaw=0.7, turn=0.05, place=(600.0, 1600.0, 0.0)) -> EgoMotion:
    """A car on a curve: world_from_ego at `rate` rows a second."""
    times = np.arange(0, seconds, 1 / rate)
    yaws = start_yaw + turn * times
    headings = np.stack([np.cos(yaws), np.sin(yaws), np.zeros_like(yaws)], axis=-1)
    places = np.array(place) + np.cumsum(headings * speed / rate, axis=0)
    x, y, z, w = Rotation.from_euler("z", yaws[:, None]).as_quat().T
    return of(times, places, np.stack([w, x, y, z], axis=-1))


def of(times, places, quaternions):
    nanoseconds = (times * 1e9).astype(np.int64) + 10**18
    return EgoMotion(nanoseconds, places, quaternions, *derive_kinematics(nanoseconds, places, quaternions))


def with_poses(motion, places, rotations):
    x, y, z, w = rotations.as_quat().T
    return of((motion.timestamps_ns - 10**18) / 1e9, places, np.stack([w, x, y, z], axis=-1))


def rotations_of(motion):
    w, x, y, z = motion.quaternions.T
    return Rotation.from_quat(np.stack([x, y, z, w], axis=-1))


def turned_ego(degrees):
    """The ego frame's axes turned about z: x points elsewhere than ahead."""
    return lambda m: with_poses(m, m.translations, rotations_of(m) * Rotation.from_euler("z", degrees, degrees=True))


def jumping(motion):
    places = motion.translations.copy()
    places[len(places) // 2 :] += [300.0, 0, 0]
    return of((motion.timestamps_ns - 10**18) / 1e9, places, motion.quaternions)


def inverted(motion):
    rotations = rotations_of(motion).inv()
    return with_poses(motion, -rotations.apply(motion.translations), rotations)


def in_other_order(motion):
    return replace(motion, quaternions=np.roll(motion.quaternions, -1, axis=1))


def tilted(motion):
    return with_poses(motion, motion.translations, rotations_of(motion) * Rotation.from_euler("x", 90, degrees=True))


MISTAKES = {
    "sideways": ("ego-sideways", turned_ego(90)),
    "sideways, the other way": ("ego-sideways", turned_ego(-90)),
    "backwards": ("ego-backwards", turned_ego(180)),
    "millimetres": ("ego-units", lambda m: of((m.timestamps_ns - 10**18) / 1e9, m.translations * 1000, m.quaternions)),
    "microseconds": ("ego-units", lambda m: replace(m, timestamps_ns=m.timestamps_ns // 1000)),
    "a jump": ("ego-jump", jumping),
    "inverted": ("ego-inverted", inverted),
    "xyzw": ("ego-quaternion-order", in_other_order),
    "tilted": ("ego-tilted", tilted),
    "speed in km/h": ("ego-speed", lambda m: replace(m, velocities=m.velocities * 3.6)),
}


@pytest.mark.parametrize("start_yaw", [0.0, 0.7, 2.0, -3.0])
@pytest.mark.parametrize("speed", [0.0, 3.0, 8.0, 35.0])
def test_a_healthy_drive_gives_nothing(speed, start_yaw):
    assert check_ego_motion(drive(speed=speed, start_yaw=start_yaw)) == ()


@pytest.mark.parametrize("start_yaw", [0.7, 2.0, -2.5])
@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_found_alone(name, start_yaw):
    code, spoil = MISTAKES[name]
    assert [finding.code for finding in check_ego_motion(spoil(drive(start_yaw=start_yaw)))] == [code]


def test_parking_in_reverse_for_a_while_is_no_mistake():
    there, back = drive(seconds=15.0), drive(seconds=15.0)
    times = np.arange(len(there.timestamps_ns) * 5 // 4) / 20
    places = np.concatenate([there.translations, there.translations[: -len(there.translations) // 4 - 1 : -1]])
    quaternions = np.concatenate([there.quaternions, back.quaternions[: -len(there.translations) // 4 - 1 : -1]])
    count = min(len(times), len(places))
    assert check_ego_motion(of(times[:count], places[:count], quaternions[:count])) == ()


def test_the_real_drive_gives_nothing(shared):
    assert check_ego_motion(read_ego_motion(shared / "data/nuscenes-scene-0103/ego_motion.csv")) == ()


def test_one_row_gives_nothing():
    motion = drive(seconds=0.05)
    assert len(motion.timestamps_ns) == 1
    assert check_ego_motion(motion) == ()


FRAMES = [10**18 + i * 500_000_000 for i in range(10)]


def late_by(milliseconds):
    return [time + milliseconds * 1_000_000 for time in FRAMES]


def test_cameras_within_a_few_hundredths_of_a_second_give_nothing():
    assert check_camera_times(FRAMES, {"front": FRAMES, "back": late_by(-43), "left": late_by(40)}) == ()


@pytest.mark.parametrize(
    ("offset", "severity"), [(150, "warning"), (-200, "warning"), (700, "error"), (-3000, "error")]
)
def test_a_camera_that_is_late_or_early_is_named(offset, severity):
    (finding,) = check_camera_times(FRAMES, {"front": FRAMES, "back": late_by(offset)})
    assert (finding.code, finding.severity, finding.camera) == ("time-offset", severity, "back")
    assert f"{offset:+d} ms" in finding.found


def test_a_camera_whose_offset_wanders_is_named():
    wandering = [time + (i % 2) * 140_000_000 for i, time in enumerate(FRAMES)]
    (finding,) = check_camera_times(FRAMES, {"front": FRAMES, "back": wandering})
    assert (finding.severity, finding.camera) == ("warning", "back")


def test_a_camera_without_any_image_is_named():
    (finding,) = check_camera_times(FRAMES, {"front": FRAMES, "back": [None] * len(FRAMES)})
    assert (finding.code, finding.camera) == ("camera-without-pictures", "back")
