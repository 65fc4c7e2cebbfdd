"""What stated poses are, where the images contradict them and another reading fits."""

from collections.abc import Iterator, Mapping
from itertools import product

import numpy as np

from bevcli.errors import Finding
from bevcli.frame import Drive
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.geometry.transforms import Array
from bevcli.sequences.files.calibration_file import RigDraft
from bevcli.sequences.files.ego_motion_file import ReadPoses
from bevcli.sequences.files.readings import PoseReading, differing
from bevcli.sequences.options import RigOptions
from bevcli.workshop.formats.pose_readings import of_bodies, rotated
from bevcli.workshop.formats.poses import FOLDER, of_reading
from bevcli.workshop.readings.judge import AROUND_NS, Judged

DEGREES = 180 / np.pi
STRAIGHT = np.radians(1.0)  # largest difference of yaws that do not turn
STATED = {"pose_transform": "world_from_body", "pose_axes": "flu", "poses_of": "vehicle"}
# What differs -> the code of the finding, its message, what is expected; and the advice where no option states it.
MISTAKES = {
    "positions": ("motion-axes", "axes of the positions are swapped or negated", "one right-handed world", "columns"),
    "yaws": ("motion-angles", "the yaws of the poses are others", "yaw in radians, counter-clockwise from x", "yaws"),
    "pose_transform": ("motion-inverted", "the poses are ego_from_world, the inverse", "world_from_ego", ""),
    "pose_axes": ("motion-axes", "the axes of the poses are not those of the ego frame", "x forward, y left, z up", ""),
    "poses_of": ("motion-axes", "the poses are those of a camera", "the vehicle's", ""),
}


def fitting_poses(drive: Drive, stated: EgoMotion) -> tuple[Finding, EgoMotion] | None:
    """What the stated poses of a drive are by its images, and the poses so read; None where they may be as stated."""
    times = [stamp.timestamp_ns for stamp in drive.stamps]  # a file may have many more poses
    first, last = stated.timestamps_ns.searchsorted((min(times) - AROUND_NS, max(times) + AROUND_NS))
    stated = stated.of_rows(np.arange(max(first - 1, 0), min(last + 1, len(stated.timestamps_ns))))
    as_it_is = PoseReading({"yaws": "", "positions": "", **STATED}, stated.translations, stated.quaternions)
    readings = tuple(_readings(stated, {camera.name: camera.ego_from_camera for camera in drive.rig.cameras}))
    rig = RigDraft(drive.rig, ())
    judged = Judged(rig, ReadPoses(stated, readings=(as_it_is,), others=readings), drive, RigOptions())
    found = judged.fitting(next(iter(judged.candidates(rig, ReadPoses(stated, readings=(as_it_is,)))), None))
    if found is None:
        return None
    fitting, residual_px = found
    assert fitting.poses is not None
    names = differing([as_it_is, fitting.poses])
    code, message, expected, columns = MISTAKES[next(name for name in MISTAKES if name in names)]
    advice = (
        f"correct the {columns}"
        if columns
        else f"pass `{fitting.poses.flags(names)}` with {FOLDER}, or transform the poses"
    )
    described = f"{fitting.poses.words(names)}: {fitting.residual_px:.1f} px in the images, as stated {residual_px}"
    motion = of_reading(fitting.poses, stated.timestamps_ns, drive.rig).motion
    assert motion is not None
    return Finding(code, "error", None, message, described, expected, advice), motion


def _readings(stated: EgoMotion, cameras: Mapping[str, Array]) -> Iterator[PoseReading]:
    """What stated poses may be in place of those of the vehicle in the world."""
    at, times, as_stated = stated.translations, stated.timestamps_ns, {"": stated.quaternions}
    yield from _named(of_bodies(at, as_stated, times, cameras, {}))
    for words, yaws in _other_yaws(stated):
        turned = np.column_stack([np.cos(yaws / 2), 0 * yaws, 0 * yaws, np.sin(yaws / 2)])
        yield from _named(of_bodies(at, {"": turned}, times, {}, STATED), yaws=words)
    for order, sign in product(([0, 1], [1, 0]), (1, -1)):  # mirrored: other turns are those of axes
        signs = (sign, -sign) if order == [0, 1] else (sign, sign)
        words = ", ".join("-"[each > 0 :] + "xy"[axis] for axis, each in zip(order, signs, strict=True))
        moved = np.column_stack([at[:, order] * signs, at[:, 2]])
        yield from _named(
            of_bodies(moved, as_stated, times, {}, STATED), positions=f"x, y of the positions hold {words}"
        )


def _named(readings: Iterator[PoseReading], **unusual: str) -> Iterator[PoseReading]:
    """The readings with what is unusual about them."""
    for each in readings:
        states = {**dict.fromkeys(("yaws", "positions"), ""), **unusual, **each.states}
        states.pop("pose_angles")
        yield PoseReading(states, each.translations, each.quaternions, each.camera, rank=each.rank + bool(unusual))


def _other_yaws(stated: EgoMotion) -> Iterator[tuple[str, Array]]:
    """What the yaws (T,) may be if they are not in radians, counter-clockwise from x."""
    ahead = rotated(stated.quaternions, np.array([1.0, 0.0, 0.0]))
    yaws = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    moved = np.gradient(stated.translations[:, :2], axis=0)
    course = np.arctan2(moved[:, 1], moved[:, 0])
    for angle_deg, words in ((90, "y, as a compass"), (0, "x"), (180, "-x"), (270, "-y")):
        yield f"yaws clockwise from {words}", np.radians(angle_deg) - yaws
    slow = yaws / DEGREES
    off = np.angle(np.exp(1j * (course - slow)) @ np.linalg.norm(moved, axis=1))
    yield "yaws in degrees, taken for radians", slow + off
    yield "yaws in radians, taken for degrees", yaws * DEGREES
    if np.ptp(yaws) < STRAIGHT:
        yield "the course, as the poses do not turn", course
