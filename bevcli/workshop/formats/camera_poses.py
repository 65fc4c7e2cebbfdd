"""The readings of the transforms of a calibration: direction, axes, kind of rotation and unit.

Those that no vehicle has are left out: its cameras are upright, look outwards, and where their names say. The images
decide between the others (`bevcli.workshop.readings`).
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, inverse, rigid, rotation_about_z
from bevcli.options import named
from bevcli.sequences.files.readings import (
    ALL_AXES,
    CAMERA_AXES,
    LEFT_HANDED,
    USUAL_AXES,
    RigReading,
)
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
SAME = 1e-3  # largest difference of matrices that are the same
Fields: TypeAlias = dict[str, Any]
PAIR = "rig_axes", "camera_axes"


@cache
def ego_from_axes(letters: str) -> Array:
    """(3, 3), read-only, from a frame with other axes to x forward, y left, z up; it mirrors left-handed ones.

    Raises InputError for letters that are not of `ALL_AXES`.
    """
    if letters not in ALL_AXES:
        raise InputError(f'axes "{letters:.20}" mean nothing (expected three letters such as flu, frd or rub)')
    signed = [("flu".find(letter), "brd".find(letter)) for letter in letters]
    result = np.stack([np.eye(3)[plus] if plus >= 0 else -np.eye(3)[minus] for plus, minus in signed], axis=1)
    result.flags.writeable = False
    return result


# (3, 3) camera_from_axes: from a camera frame with other axes to x right, y down, z forward.
AXES = {name: ego_from_axes("rdf").T @ ego_from_axes(letters) for name, letters in CAMERA_AXES.items()}
AXES_FROM_OPTICAL = {name: inverse(rigid(rotation=rotation)) for name, rotation in AXES.items()}  # (4, 4)
EGO_FROM_BODY = {letters: rigid(rotation=ego_from_axes(letters)) for letters in ALL_AXES}  # (4, 4)


def is_left_handed(letters: str) -> bool:
    """True for axes of which x times y is not z."""
    return float(np.linalg.det(ego_from_axes(letters))) < 0


# Axes of the vehicle and of the cameras: usual ones, and others, both right-handed or both left-handed.
USUAL_CAMERAS = "optical", "vehicle"
USUAL = tuple(product(USUAL_AXES, USUAL_CAMERAS))
OTHERS = tuple(
    pair
    for pair in product([axes for axes in ALL_AXES if not is_left_handed(axes)] + list(LEFT_HANDED), CAMERA_AXES)
    if pair not in USUAL and is_left_handed(pair[0]) == is_left_handed(CAMERA_AXES[pair[1]])
)
UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
USUAL_UNITS = ("m", "cm", "mm")
HEIGHT = (
    "if the origin is not on the ground, pass `height=1.5` (`--height 1.5`), the mean height of the cameras above it"
)
ADVICE = {"height": HEIGHT, "unit": "pass `rig_unit` (`--rig-unit`), or convert the translations to metres"}


@dataclass(frozen=True)
class StatedPose:
    """A transform between a camera and the vehicle, as a file states it."""

    # (4, 4) by what the numbers of a rotation may be (`rig_angles`); the only one under ""
    matrices: Mapping[str, Array]
    direction: Direction | None = None  # that the name of the transform states; None for none
    axes: str | None = None  # of the camera frame, if they are known: a key of `AXES`
    exact: bool = False  # the direction is certain, and so are the optical axes: nothing is decided
    name: str = ""  # in the file
    # (4, 4) camera_from_this: the pose of a neighbour in a chain, from this camera
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
        return EGO_FROM_BODY[states["rig_axes"]] @ body_from_axes @ AXES_FROM_OPTICAL[states["camera_axes"]] @ then

    @property
    def any_matrix(self) -> Array:
        """(4, 4) of the first reading of its rotation."""
        return next(iter(self.matrices.values()))


def in_metres(matrix: Array, states: Mapping[str, str]) -> Array:
    """A transform (4, 4) whose translation is in the unit that a reading states."""
    scaled = matrix.copy()
    scaled[:3, 3] *= UNITS_M[states["rig_unit"]]
    return scaled


@dataclass(frozen=True)
class StatedCamera:
    """What a file states of a camera."""

    intrinsics: Any = None  # (3, 3) nested lists, pixels; None if they are not stated
    size: tuple[Any, Any] | None = None  # (width, height) in pixels; None if it is not stated
    distortion: Fields | None = None  # as in calibration.json
    pose: StatedPose | None = None  # None if it is not stated
    moves: bool = False  # the file has several poses of the camera, as a reconstruction of a drive has
    from_previous: Array | None = None  # (4, 4) camera_from_previous_camera of a Kalibr chain
    lens_is_open: bool = False  # four coefficients without the name of a lens, which a fisheye has too


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
        RigReading(states, {name: pose.ego_from_camera(states) for name, pose in poses.items()}, rank=rank)
        for states, rank in _states(free, {name: value for name, value in stated.items() if value is not None})
    ]
    reasons = [_impossible(rig, height_stated=height_stated) for rig in rigs]
    possible = _distinct([rig for rig, reason in zip(rigs, reasons, strict=True) if reason is None])
    by_name = next((pose.direction for pose in free if pose.direction), None)
    if stated.get("transform") is None:
        named_ranks = {rig.rank for rig in possible if rig.states["transform"] == by_name}
        possible = [rig for rig in possible if rig.states["transform"] == by_name or rig.rank not in named_ranks]
    if not possible:
        _refuse(f"{where}: {free[0].name}", rigs, reasons)
    return tuple(sorted(possible, key=lambda rig: rig.rank))


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


def _states(free: Sequence[StatedPose], stated: Mapping[str, str]) -> Iterator[tuple[dict[str, str], int]]:
    """What transforms that are not exact may be, each with its rank. stated: what they are."""
    extent = max(float(np.linalg.norm(pose.any_matrix[:3, 3])) for pose in free)
    units = [unit for unit, metres in UNITS_M.items() if EXTENT_M[0] <= extent * metres <= EXTENT_M[1]] or ["m"]
    # A kind of rotation that not all cameras may have is none.
    kinds = [kind for kind in free[0].matrices if all(kind in pose.matrices for pose in free)] or [""]
    choices: dict[str, Sequence[str]] = {"transform": DIRECTIONS, "rig_angles": kinds, "rig_unit": units}
    choices |= {name: [value] for name, value in stated.items() if name in choices}
    known = {"camera_axes": next((pose.axes for pose in free if pose.axes), None), **stated}
    pairs = [
        pair
        for pair in (*USUAL, *OTHERS)
        if known.get("rig_axes", pair[0]) == pair[0] and known["camera_axes"] in (None, pair[1])
    ]
    for axes, values in product(pairs, product(*choices.values())):
        states = dict(zip(choices, values, strict=True))
        if states["rig_angles"] == "unity" and axes != ("ruf", "unity"):
            continue
        is_usual = (
            axes[0] in (*USUAL_AXES, stated.get("rig_axes"))
            and axes[1] in (*USUAL_CAMERAS, known["camera_axes"])
            and (not states["rig_angles"].startswith(("clockwise", "unity")) or "rig_angles" in stated)
            and states["rig_unit"] in (*USUAL_UNITS, stated.get("rig_unit"))
        )
        yield {"transform": states["transform"], **dict(zip(PAIR, axes, strict=True)), **states}, int(not is_usual)


def _distinct(readings: Sequence[RigReading]) -> list[RigReading]:
    """Readings without those that mean the same as an earlier one."""
    kept: list[tuple[RigReading, Array]] = []
    for reading in readings:
        rig = np.stack(list(reading.ego_from_camera.values()))
        if not any(np.abs(rig - other).max() < SAME for _, other in kept):
            kept.append((reading, rig))
    return [reading for reading, _ in kept]


def _impossible(reading: RigReading, *, height_stated: bool) -> tuple[str, str] | None:
    """Why cameras cannot be on a vehicle: a code and a text. None if they can."""
    rig = reading.ego_from_camera
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
    if reading.rank and float(((places - places.mean(0)) * forwards)[:, 1].mean()) < -INWARDS_M:
        return "sides", "the cameras on the left look to the right"
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
