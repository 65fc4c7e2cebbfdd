"""The meaning of the transforms of a calibration: direction and axes are decided by what is possible.

The cameras of a vehicle are above the ground, their images are upright, and they look outwards.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, inverse, rigid, rotation_about_z

Direction = Literal["ego_from_camera", "camera_from_ego"]
DIRECTIONS: tuple[Direction, ...] = ("ego_from_camera", "camera_from_ego")
HIGHEST_M = 4.0  # of a camera above the ground
STEEPEST_UP, STEEPEST_DOWN = 0.5, -0.9  # z of the viewing direction, the sine of its pitch
LEAST_UPRIGHT = 0.5  # z of the direction that is up in the image
INWARDS_M = (
    0.05  # cameras look outwards: the mean of how far they lie in their own viewing direction, at least minus this
)
TOLERANCE = 1e-3
Fields: TypeAlias = dict[str, Any]
# (3, 3) camera_from_axes: from a camera frame with other axes to x right, y down, z forward.
AXES = {
    "optical": np.eye(3),
    "vehicle": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "opengl": np.diag([1.0, -1.0, -1.0]),
}
AXES_TEXT = {
    "optical": "x right, y down, z forward",
    "vehicle": "x forward, y left, z up",
    "opengl": "x right, y up, z backward",
}


ORIGIN = (
    "if the origin is not on the ground, pass `height=1.5` (`--height 1.5`), the mean height of the cameras above it"
)
ADVICE = {"below": ORIGIN, "height": ORIGIN, "unit": "convert the translations to metres"}


@dataclass(frozen=True)
class StatedPose:
    """A transform between a camera and the vehicle, as a file states it.

    Attributes:
        matrices: (4, 4) by the order of a quaternion whose order is not known; the only one under "".
        direction: that the name of the transform states; None for none.
        axes: of the camera frame, if they are known: a key of `AXES`.
        exact: the direction is certain, and so are the optical axes: nothing is decided.
        name: in the file.
        then: (4, 4) camera_from_this: the pose of a neighbour in a chain, from this camera.
    """

    matrices: Mapping[str, Array]
    direction: Direction | None = None
    axes: str | None = None
    exact: bool = False
    name: str = ""
    then: Array = field(default_factory=lambda: np.eye(4))

    def moved(self, camera_from_other: Array) -> "StatedPose":
        """The pose of another camera with optical axes, by that of this one."""
        return replace(self, then=self.then @ camera_from_other)

    def ego_from_camera(self, reading: "Reading") -> Array:
        """(4, 4) with optical axes, as a reading has it."""
        matrix = self.matrices.get(reading.order, next(iter(self.matrices.values())))
        if self.exact:
            return (matrix if self.direction == "ego_from_camera" else inverse(matrix)) @ self.then
        ego_from_axes = matrix if reading.direction == "ego_from_camera" else inverse(matrix)
        return ego_from_axes @ inverse(rigid(rotation=AXES[reading.axes])) @ self.then


@dataclass(frozen=True)
class StatedCamera:
    """What a file states of a camera.

    Attributes:
        intrinsics: (3, 3) nested lists, pixels; None if they are not stated.
        size: (width, height) in pixels; None if it is not stated.
        distortion: as in calibration.json.
        pose: None if it is not stated.
        moves: the file has several poses of the camera, as a reconstruction of a drive has.
        from_previous: (4, 4) camera_from_previous_camera of a Kalibr chain.
        lens_is_open: four coefficients without the name of a lens, which a fisheye has too.
    """

    intrinsics: Any = None
    size: tuple[Any, Any] | None = None
    distortion: Fields | None = None
    pose: StatedPose | None = None
    moves: bool = False
    from_previous: Array | None = None
    lens_is_open: bool = False


Cameras: TypeAlias = dict[str, StatedCamera]


@dataclass(frozen=True)
class Reading:
    """One of the ways to read the transforms of a rig."""

    direction: Direction
    axes: str
    order: str

    @property
    def text(self) -> str:
        """In words."""
        order = f", quaternions {self.order}" if self.order else ""
        return f"{self.direction}, camera axes {AXES_TEXT[self.axes]}{order}"


def decide_poses(
    where: Path, poses: Mapping[str, StatedPose], asked: Direction | None, *, level_known: bool = False
) -> tuple[dict[str, Array], str]:
    """ego_from_camera (4, 4) by camera, with optical axes, and how the transforms were read.

    asked: the direction that the user states. level_known: the origin need not be on the ground, as heights are given.
    Raises InputError where no reading is possible, or where several are and neither a name nor `asked` decides.
    """
    free = [pose for pose in poses.values() if not pose.exact]
    if not free:
        exact = Reading("ego_from_camera", "optical", "")
        return {name: pose.ego_from_camera(exact) for name, pose in poses.items()}, "poses as stated"
    _check_rotations(where, poses)
    rigs = {each: {name: pose.ego_from_camera(each) for name, pose in poses.items()} for each in _readings(free, asked)}
    reasons = {reading: _impossible(rig, level_known=level_known) for reading, rig in rigs.items()}
    possible = _distinct([reading for reading in rigs if not reasons[reading]], rigs)
    named = next((pose.direction for pose in free if pose.direction), None)
    fitting = [reading for reading in possible if reading.direction == named] or possible
    _check_certain(f"{where}: {free[0].name}", fitting, reasons, named)
    why = "as stated" if asked or len(possible) > 1 else "the only reading with the cameras on a vehicle"
    if named and named != fitting[0].direction and not asked:
        why += f"; its name says {named}"
    return rigs[fitting[0]], f"{free[0].name} is {fitting[0].text} ({why})"


def _check_certain(
    where: str, chosen: list[Reading], reasons: Mapping[Reading, tuple[str, str] | None], named: Direction | None
) -> None:
    """Raise InputError unless one reading is chosen, and more than the sign of a height decides it.

    reasons: why readings are impossible. named: the direction that a name states.
    """
    if not chosen:
        nearest = min(reasons, key=lambda reading: (reasons[reading] or ("",))[0] not in ADVICE)
        code, text = reasons[nearest] or ("", "")
        raise InputError(
            f"{where}: no reading of the transforms puts the cameras on a vehicle (expected above the ground, "
            f"at most {HIGHEST_M:g} m high, upright, looking outwards); as {nearest.text}, {text}: "
            f"{ADVICE.get(code, 'correct them, or pass `extrinsics` (`--extrinsics FILE`)')}"
        )
    first = chosen[0].direction
    if any(reading.direction != first for reading in chosen):
        raise InputError(
            f"{where}: can be read in two directions, and both put the cameras on a vehicle: pass "
            f'`transform="{DIRECTIONS[0]}"` (`--transform {DIRECTIONS[0]}`) or `transform="{DIRECTIONS[1]}"` '
            f"(`--transform {DIRECTIONS[1]}`)"
        )
    if len(chosen) > 1:
        raise InputError(
            f"{where}: the order of the quaternions is not certain: name them rotation_wxyz or rotation_xyzw"
        )
    for other, reason in reasons.items():
        if first != named and other.direction != first and reason and reason[0] == "below":  # the origin of a lidar?
            raise InputError(
                f"{where}: as {other.text}, {reason[1]}, and as {first} above it: pass "
                f'`transform="{first}"` (`--transform {first}`); or `transform="{other.direction}"` (`--transform '
                f"{other.direction}`) and `height=1.5` (`--height 1.5`)"
            )


def _check_rotations(where: Path, poses: Mapping[str, StatedPose]) -> None:
    for name, pose in poses.items():
        for matrix in pose.matrices.values():
            rotation = matrix[:3, :3]
            finite = bool(np.isfinite(matrix).all())
            if not finite or np.abs(rotation @ rotation.T - np.eye(3)).max() > TOLERANCE or np.linalg.det(rotation) < 0:
                raise InputError(
                    f"{where}: camera {name}: {pose.name}: the rotation is not orthonormal and right-handed: "
                    "check its digits"
                )


def _readings(free: Sequence[StatedPose], asked: Direction | None) -> Iterator[Reading]:
    """The ways to read transforms that are not exact. asked: the only direction."""
    orders = sorted({order for pose in free for order in pose.matrices})
    axes = next(((pose.axes,) for pose in free if pose.axes), ("optical", "vehicle"))
    for direction, camera_axes, order in product((asked,) if asked else DIRECTIONS, axes, orders):
        yield Reading(direction, camera_axes, order)


def _distinct(readings: list[Reading], rigs: Mapping[Reading, Mapping[str, Array]]) -> list[Reading]:
    """Readings without those that mean the same as an earlier one."""
    kept: list[Reading] = []
    for reading in readings:
        rig = rigs[reading]
        if not any(all(np.allclose(rig[name], rigs[other][name], atol=1e-6) for name in rig) for other in kept):
            kept.append(reading)
    return kept


def _impossible(rig: Mapping[str, Array], *, level_known: bool) -> tuple[str, str] | None:
    """Why cameras cannot be on a vehicle: a code and a text. None if they can."""
    for name, pose in rig.items():
        forward, up = pose[:3, 2], -pose[:3, 1]
        if up[2] < LEAST_UPRIGHT:
            return "upright", f"the images of {name} are not upright"
        if not STEEPEST_DOWN <= forward[2] <= STEEPEST_UP:
            return (
                "pitch",
                f"{name} looks {'up' if forward[2] > 0 else 'down'} by {abs(np.degrees(np.arcsin(forward[2]))):.0f}°",
            )
    places = np.array([pose[:2, 3] for pose in rig.values()])
    forwards = np.array([pose[:2, 2] for pose in rig.values()])
    outwards = ((places - places.mean(0)) * forwards).sum(1).mean()
    if outwards < -INWARDS_M:
        return "inwards", f"the cameras look inwards, by {-outwards:.2f} m on average"
    for name, pose in rig.items():
        if not level_known and not 0 < pose[2, 3] <= HIGHEST_M:
            if pose[2, 3] > 100 * HIGHEST_M:
                return "unit", f"{name} is {pose[2, 3]:.0f} m above the origin (in millimetres?)"
            if pose[2, 3] <= 0:
                return "below", f"{name} is {-pose[2, 3]:.2f} m below the origin"
            return "height", f"{name} is {pose[2, 3]:.2f} m above the origin"
    return None


def raised(poses: Mapping[str, Array], heights: Mapping[str, float]) -> dict[str, Array]:
    """The rig at a height: all cameras are moved by the same way up, that of their mean height."""
    shift = np.mean([heights[name] - pose[2, 3] for name, pose in poses.items()])
    return {name: rigid((0, 0, shift)) @ pose for name, pose in poses.items()}


def guessed_pose(height: float, yaw: float) -> Array:
    """(4, 4) ego_from_camera of a level camera. yaw: radians, counter-clockwise from ahead.

    It lies where nuScenes' cameras are: 1.7 m ahead of the rear axle if it looks ahead, above the axle if it looks
    back, and 0.5 m to the side in between.
    """
    position = (0.85 + 0.85 * np.cos(yaw), 0.5 * np.sin(yaw), height)
    return rigid(position, rotation_about_z(yaw) @ AXES["vehicle"].T)
