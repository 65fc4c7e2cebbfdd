"""Common mistakes in a calibration or in ego-motion: pairs of a finding's code and what plants the mistake."""

from dataclasses import replace

import numpy as np
from healthy_rigs import AHEAD
from scipy.spatial.transform import Rotation

from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics

# Mistakes in a pose change the entry of one camera's pose, or of the bev frame, in place.


def pose_of(entry):
    w, x, y, z = entry["rotation_wxyz"]
    return np.array(entry["translation"]), Rotation.from_quat([x, y, z, w])


def set_pose(entry, place, rotation):
    x, y, z, w = rotation.as_quat()
    entry["translation"], entry["rotation_wxyz"] = np.asarray(place).tolist(), [w, x, y, z]


def millimetres(entry):
    entry["translation"] = [1000 * value for value in entry["translation"]]


def centimetres(entry):
    entry["translation"] = [100 * value for value in entry["translation"]]


def inverted(entry):
    place, rotation = pose_of(entry)
    set_pose(entry, -rotation.inv().apply(place), rotation.inv())


def xyzw(entry):
    w, x, y, z = entry["rotation_wxyz"]
    entry["rotation_wxyz"] = [x, y, z, w]


def body_axes(entry):
    place, rotation = pose_of(entry)
    set_pose(entry, place, rotation * Rotation.from_matrix(AHEAD).inv())


def turned(axis, degrees):
    def turn(entry):
        place, rotation = pose_of(entry)
        set_pose(entry, place, rotation * Rotation.from_euler(axis, degrees, degrees=True))

    return turn


def lowered(entry):
    entry["translation"][2] -= 1.84


def far_away(entry):
    entry["translation"][0] += 20


def as_matrix(factor):
    """The rotation as a matrix, multiplied by a factor (a number or a row)."""

    def write(entry):
        rotation = pose_of(entry)[1].as_matrix()
        del entry["rotation_wxyz"]
        entry["rotation"] = (rotation * factor).tolist()

    return write


def rounded(entry):
    entry["rotation_wxyz"] = [round(value, 1) for value in entry["rotation_wxyz"]]


def both_rotations(entry):
    entry["rotation"] = np.eye(3).tolist()


POSE_MISTAKES = [
    ("translation-unit", millimetres),
    ("translation-unit", centimetres),
    ("transform-inverted", inverted),
    ("camera-axes", body_axes),
    ("looks-at-ground", turned("x", -90)),
    ("looks-at-ground", turned("x", -60)),
    ("looks-at-ground", turned("x", -45)),
    ("looks-at-sky", turned("x", 90)),
    ("looks-at-sky", turned("x", 50)),
    ("camera-rolled", turned("z", 180)),
    ("camera-rolled", turned("z", 90)),
    ("camera-rolled", turned("z", -90)),
    ("camera-rolled", turned("z", 40)),
    ("camera-height", lowered),
    ("camera-far", far_away),
    ("rotation-not-orthonormal", as_matrix(1.01)),
    ("rotation-left-handed", as_matrix([-1, 1, 1])),
]


def x_forward(entry):
    entry["rotation_wxyz"] = [1.0, 0.0, 0.0, 0.0]


def on_the_ground(entry):
    entry["translation"][2] = 0.0


BEV_MISTAKES = [
    ("bev-x-forward", x_forward),
    ("bev-height", on_the_ground),
    ("translation-unit", millimetres),
    ("transform-inverted", inverted),
    ("quaternion-order", xyzw),
    ("bev-tilted", turned("x", 30)),
    ("bev-axes", turned("z", 180)),
    ("bev-far", far_away),
    ("rotation-left-handed", as_matrix([-1, 1, 1])),
]

# Mistakes in a lens change the entry of one camera.


def scaled(factor):
    def scale(camera):
        for row in camera["intrinsics"][:2]:
            row[:] = [factor * value for value in row]

    return scale


def transposed_size(camera):
    camera["width"], camera["height"] = camera["height"], camera["width"]


def focal(factor_x, factor_y=None):
    def change(camera):
        camera["intrinsics"][0][0] *= factor_x
        camera["intrinsics"][1][1] *= factor_x if factor_y is None else factor_y

    return change


def lens(model, coefficients):
    def add(camera):
        camera["distortion"] = {"model": model, "coefficients": coefficients}

    return add


def put(key, value):
    def change(camera):
        camera[key] = value

    return change


def shifted_center(camera):
    camera["intrinsics"][0][2] *= 1.4


def center_outside(camera):
    camera["intrinsics"][0][2] = -0.49 * camera["width"]


def skewed(camera):
    camera["intrinsics"][0][1] = 0.8 * camera["intrinsics"][0][0]


LENS_MISTAKES = [
    ("intrinsics-resolution", scaled(0.5)),
    ("intrinsics-resolution", scaled(2.0)),
    ("intrinsics-resolution", scaled(1920 / 1600)),
    ("intrinsics-resolution", scaled(1280 / 1600)),
    ("intrinsics-resolution", transposed_size),
    ("fov-implausible", focal(15)),
    ("fov-implausible", focal(0.1)),
    ("principal-point", center_outside),
    ("intrinsics-skew", skewed),
    ("distortion-absurd", lens("brown_conrady", [-3.0, 0.0, 0.0, 0.0])),
    ("distortion-absurd", lens("brown_conrady", [0.1, 0.0, 0.9, 0.0])),
    ("distortion-absurd", lens("brown_conrady", [900.0, 0.2, 0.0, 0.0, 0.0])),
    ("distortion-absurd", lens("kannala_brandt", [-1.5, 0.0, 0.0, 0.0])),
    ("distortion-absurd", lens("kannala_brandt", [60.0, 9.0, 0.0, 0.0])),
    ("distortion-coefficients", lens("kannala_brandt", [0.1, 0.0])),
    ("distortion-model", lens("fisheye", [0.1, 0.0, 0.0, 0.0])),
]
LENS_WARNINGS = [
    ("pixels-not-square", focal(1.0, 1.2)),
    ("principal-point", shifted_center),
    ("distortion-missing", focal(0.35)),
]
FIELD_MISTAKES = [
    ("missing-key", lambda camera: camera.pop("width")),
    ("wrong-size", put("width", 0)),
    ("wrong-shape", put("intrinsics", [[1.0, 0.0], [0.0, 1.0]])),
    ("not-finite", put("intrinsics", [[float("nan")] * 3] * 3)),
    ("intrinsics-form", put("intrinsics", [[800.0, 0, 0], [0, 800.0, 0], [800.0, 450.0, 1]])),
    ("intrinsics-singular", put("intrinsics", [[0, 0, 800.0], [0, 800.0, 450.0], [0, 0, 1]])),
    ("intrinsics-absurd", put("intrinsics", [[4.2, 0, 800.0], [0, 4.2, 450.0], [0, 0, 1]])),
]

# Ego-motion: a drive made by integrating a speed along a curve.


def drive(speed=8.0, seconds=20.0, rate=20.0, start_yaw=0.7, turn=0.05, place=(600.0, 1600.0, 0.0)) -> EgoMotion:
    """A car on a curve: world_from_ego at `rate` rows a second."""
    times = np.arange(0, seconds, 1 / rate)
    yaws = start_yaw + turn * times
    headings = np.stack([np.cos(yaws), np.sin(yaws), np.zeros_like(yaws)], axis=-1)
    places = np.array(place) + np.cumsum(headings * speed / rate, axis=0)
    x, y, z, w = Rotation.from_euler("z", yaws[:, None]).as_quat().T
    return motion_of(times, places, np.stack([w, x, y, z], axis=-1))


def motion_of(times, places, quaternions):
    nanoseconds = (times * 1e9).astype(np.int64) + 10**18
    return EgoMotion(nanoseconds, places, quaternions, *derive_kinematics(nanoseconds, places, quaternions))


def _seconds(motion):
    return (motion.timestamps_ns - 10**18) / 1e9


def _with_poses(motion, places, rotations):
    x, y, z, w = rotations.as_quat().T
    return motion_of(_seconds(motion), places, np.stack([w, x, y, z], axis=-1))


def _rotations_of(motion):
    w, x, y, z = motion.quaternions.T
    return Rotation.from_quat(np.stack([x, y, z, w], axis=-1))


def _turned_ego(axis, degrees):
    """The ego frame's axes turned."""

    def turn(motion):
        rotations = _rotations_of(motion) * Rotation.from_euler(axis, degrees, degrees=True)
        return _with_poses(motion, motion.translations, rotations)

    return turn


def _jumping(motion):
    places = motion.translations.copy()
    places[len(places) // 2 :] += [300.0, 0, 0]
    return motion_of(_seconds(motion), places, motion.quaternions)


def _inverted_motion(motion):
    rotations = _rotations_of(motion).inv()
    return _with_poses(motion, -rotations.apply(motion.translations), rotations)


MOTION_MISTAKES = {
    "sideways": ("ego-sideways", _turned_ego("z", 90)),
    "sideways, the other way": ("ego-sideways", _turned_ego("z", -90)),
    "backwards": ("ego-backwards", _turned_ego("z", 180)),
    "millimetres": ("ego-units", lambda m: motion_of(_seconds(m), m.translations * 1000, m.quaternions)),
    "microseconds": ("ego-units", lambda m: replace(m, timestamps_ns=m.timestamps_ns // 1000)),
    "a jump": ("ego-jump", _jumping),
    "inverted": ("ego-inverted", _inverted_motion),
    "xyzw": ("ego-quaternion-order", lambda m: replace(m, quaternions=np.roll(m.quaternions, -1, axis=1))),
    "tilted": ("ego-tilted", _turned_ego("x", 90)),
    "speed in km/h": ("ego-speed", lambda m: replace(m, velocities=m.velocities * 3.6)),
}
