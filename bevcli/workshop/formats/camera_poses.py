"""The readings of the transforms of a calibration: direction, axes, kind of rotation and unit.

Those that no vehicle has are left out: its cameras are upright, look outwards, and where their names say. The images
decide between the others (`bevcli.workshop.readings`).
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, inverse, rigid, rotation_about_z
from bevcli.options import named
from bevcli.sequences.files.readings import RigReading
from bevcli.sequences.options import RigOptions

Direction = Literal["ego_from_camera", "camera_from_ego"]
DIRECTIONS: tuple[Direction, ...] = ("ego_from_camera", "camera_from_ego")
HEIGHTS_M = -3.0, 5.0  # of a camera above the origin, which may be at the roof
EXTENT_M = 0.5, 12.0  # of the farthest camera from the origin, in the unit of its translations
MOST_APART = 100  # times the median distance of the cameras from the origin
STEEPEST_UP, STEEPEST_DOWN = 0.5, -0.9  # z of the viewing direction, the sine of its pitch
LEAST_UPRIGHT = 0.5  # z of the direction that is up in the image
# Cameras look outwards: the mean of how far they lie in their own viewing direction, at least minus this.
INWARDS_M = 0.05
FARTHEST_OFF = np.radians(70)  # of a viewing direction from that of the camera's name
SAME_SIDE, SAME_PLACE_M = np.radians(5), 0.15  # of a camera and of one on the other side of the vehicle
SIDES = {"front|forward|ahead": 1, "back|rear": -1, "left": 1j, "right": -1j}  # in names, and where they are
TOLERANCE = 1e-3
Fields: TypeAlias = dict[str, Any]
# (3, 3) camera_from_axes: from a camera frame with other axes to x right, y down, z forward.
AXES = {
    "optical": np.eye(3),
    "vehicle": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "opengl": np.diag([1.0, -1.0, -1.0]),
}
# (3, 3) ego_from_body: from a vehicle frame with other axes to x forward, y left, z up.
EGO_FROM_BODY = {
    "flu": np.eye(3),
    "frd": np.diag([1.0, -1.0, -1.0]),
    "rfu": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "rdf": AXES["vehicle"].T,
}
UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}
HEIGHT = (
    "if the origin is not on the ground, pass `height=1.5` (`--height 1.5`), the mean height of the cameras above it"
)
ADVICE = {"height": HEIGHT, "unit": "pass `rig_unit` (`--rig-unit`), or convert the translations to metres"}


@dataclass(frozen=True)
class StatedPose:
    """A transform between a camera and the vehicle, as a file states it.

    Attributes:
        matrices: (4, 4) by what the numbers of a rotation may be (`rig_angles`); the only one under "".
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

    def ego_from_camera(self, states: Mapping[str, str]) -> Array:
        """(4, 4) with optical axes, as a reading states it."""
        matrix, then = (
            in_metres(each, states) for each in (self.matrices.get(states["rig_angles"], self.any_matrix), self.then)
        )
        if self.exact:
            with np.errstate(invalid="ignore"):  # infinity is refused where the camera is made
                return (matrix if self.direction == "ego_from_camera" else inverse(matrix)) @ then
        body_from_axes = matrix if states["transform"] == "ego_from_camera" else inverse(matrix)
        ego_from_body = rigid(rotation=EGO_FROM_BODY[states["rig_axes"]])
        return ego_from_body @ body_from_axes @ inverse(rigid(rotation=AXES[states["camera_axes"]])) @ then

    @property
    def any_matrix(self) -> Array:
        """(4, 4) of the first reading of its rotation."""
        return next(iter(self.matrices.values()))


def in_metres(matrix: Array, states: Mapping[str, str]) -> Array:
    """A transform (4, 4) whose translation is in the unit that a reading states."""
    return rigid(UNITS_M[states["rig_unit"]] * matrix[:3, 3], matrix[:3, :3])


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


def rig_readings(
    where: Path, poses: Mapping[str, StatedPose], stated: Mapping[str, str | None], *, height_stated: bool = False
) -> tuple[RigReading, ...]:
    """The possible readings, the usual first. Raises InputError where there is none.

    Args:
        where: the file.
        poses: by camera.
        stated: options that state what the transforms are; None for those that are not given.
        height_stated: the origin need not be on the ground, as the height of the cameras is given.
    """
    free = [pose for pose in poses.values() if not pose.exact]
    if not free:
        states = {"transform": "ego_from_camera", "rig_angles": "", "rig_unit": "m"}
        return (RigReading({}, {name: pose.ego_from_camera(states) for name, pose in poses.items()}),)
    _check_rotations(where, poses)
    rigs = [
        RigReading(states, {name: pose.ego_from_camera(states) for name, pose in poses.items()})
        for states in _states(free, {name: value for name, value in stated.items() if value is not None})
    ]
    reasons = [_impossible(rig.ego_from_camera, height_stated=height_stated) for rig in rigs]
    possible = _distinct([rig for rig, reason in zip(rigs, reasons, strict=True) if reason is None])
    by_name = next((pose.direction for pose in free if pose.direction), None)
    if possible and stated.get("transform") is None:
        possible = [rig for rig in possible if rig.states["transform"] == by_name] or possible
    if not possible:
        _refuse(f"{where}: {free[0].name}", rigs, reasons)
    return tuple(possible)


def _refuse(where: str, rigs: Sequence[RigReading], reasons: Sequence[tuple[str, str] | None]) -> None:
    """Raise InputError that says why the likeliest reading is impossible."""
    codes = ["", "names", *ADVICE]  # the later, the likelier is all else right
    ranks = [codes.index(reason[0]) if reason and reason[0] in codes else 0 for reason in reasons]
    likeliest = int(np.argmax(ranks))
    code, text = reasons[likeliest] or ("", "")
    options = ", ".join(named(RigOptions, name) for name in ("transform", "rig_axes", "camera_axes", "rig_angles"))
    raise InputError(
        f"{where}: no reading of the transforms puts the cameras on a vehicle (expected upright, looking outwards, at "
        f"most {HEIGHTS_M[1]:g} m high); as {rigs[likeliest].words()}, {text}: "
        f"{ADVICE.get(code, f'correct them, state them by {options}, or pass `extrinsics` (`--extrinsics FILE`)')}"
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


def _states(free: Sequence[StatedPose], stated: Mapping[str, str]) -> Iterator[dict[str, str]]:
    """What transforms that are not exact may be. stated: what they are."""
    extent = max(float(np.linalg.norm(pose.any_matrix[:3, 3])) for pose in free)
    units = [unit for unit, metres in UNITS_M.items() if EXTENT_M[0] <= extent * metres <= EXTENT_M[1]] or ["m"]
    # A kind of rotation that not all cameras may have is none.
    kinds = [kind for kind in free[0].matrices if all(kind in pose.matrices for pose in free)] or [""]
    axes = next(([pose.axes] for pose in free if pose.axes), ["optical", "vehicle"])
    choices: dict[str, Sequence[str]] = {
        "transform": DIRECTIONS, "rig_axes": tuple(EGO_FROM_BODY), "camera_axes": axes, "rig_angles": kinds,
        "rig_unit": units,
    }  # fmt: skip
    choices |= {name: [value] for name, value in stated.items()}
    for values in product(*choices.values()):
        yield dict(zip(choices, values, strict=True))


def _distinct(readings: Sequence[RigReading]) -> list[RigReading]:
    """Readings without those that mean the same as an earlier one."""
    kept: list[RigReading] = []
    for reading in readings:
        rig = reading.ego_from_camera
        if not any(
            all(np.allclose(rig[name], other.ego_from_camera[name], atol=1e-3) for name in rig) for other in kept
        ):
            kept.append(reading)
    return kept


def _impossible(rig: Mapping[str, Array], *, height_stated: bool) -> tuple[str, str] | None:
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
        side = side_of(name)
        yaw = np.angle(complex(*pose[:2, 2]))
        if side and abs(np.angle(np.exp(1j * yaw) / side)) > FARTHEST_OFF:
            return "names", f"{name} looks to {np.degrees(yaw):.0f}°"
    farthest = max(rig, key=lambda name: float(np.linalg.norm(rig[name][:3, 3])))
    extents = [float(np.linalg.norm(pose[:3, 3])) for pose in rig.values()]
    if max(extents) > MOST_APART * np.median(extents) > 0:
        return "unit", f"{farthest} is {max(extents) / np.median(extents):.0f} times as far away (in millimetres?)"
    for name, pose in rig.items():
        if not height_stated and not HEIGHTS_M[0] < pose[2, 3] <= HEIGHTS_M[1]:
            if pose[2, 3] > 100 * HEIGHTS_M[1]:
                return "unit", f"{name} is {pose[2, 3]:.0f} m above the origin (in millimetres?)"
            return "height", f"{name} is {pose[2, 3]:.2f} m above the origin"
    return None


def on_both_sides(rig: Mapping[str, Array]) -> int:
    """The number of cameras with one like them on the other side, or that look along the vehicle in its middle."""
    cameras = [(complex(*pose[:2, 2]), complex(*pose[:2, 3])) for pose in rig.values()]
    return sum(
        any(
            abs(np.angle(other * forward)) < SAME_SIDE and abs(at.conjugate() - place) < SAME_PLACE_M
            for other, place in cameras
        )
        for forward, at in cameras
    )


def side_of(camera: str) -> complex:
    """The viewing direction that the name of a camera states, forward + 1j left; 0 for none.

    Left and right alone may be the two cameras of a stereo pair.
    """
    ahead, left = (
        sum(side for words, side in SIDES.items() if re.search(words, camera.lower()) and (side.imag != 0) == is_left)
        for is_left in (False, True)
    )
    return complex(ahead + left) if ahead else 0j


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
