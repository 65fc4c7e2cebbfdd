"""The differences between a rig and the rigs that weights know, in words; and a rig with one of them taken back.

The rigs that weights know are those of [training_rigs] of the model's file, or nuScenes' for published weights.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera, CameraRig, distort
from bevcli.geometry.transforms import Array, rigid, rotation_about_z
from bevcli.inference.preprocess import image_for_rig, network_scale
from bevcli.model.config import ModelConfig
from bevcli.printing import counted
from bevcli.rig.coverage import coverage_of, measures_of
from bevcli.rig.rig_checks import Mounting, mounting_of, seen_fov_deg, side_of, turn_deg
from bevcli.workshop.synth.rig import EGO_AXES_FROM_CAMERA, nuscenes_like_rig

Kind = Literal["pitch", "roll", "height", "field of view", "blind sector", "count", "overlap", "size", "rate", "light"]
OBJECT_M = 0.8  # height of the middle of a car above the ground
STEP_DEG = 5  # between the directions that are looked at
NEAR_M = 5.0  # a direction in which nothing farther is seen is blind
SMALLEST_SECTOR_DEG = 10
SIZES = (0.75, 1.33)  # of objects in the network's images, as a share; beyond these a rule names them
Range = tuple[float, float]


@dataclass(frozen=True)
class KnownRigs:
    """The rigs that weights know.

    Attributes:
        whose: one of their cameras, in words, such as "any training camera".
        ranges: smallest and largest value of a camera, by kind; metres and degrees.
        cameras: smallest and largest number of cameras.
        overlap: smallest and largest share of BEV cells that two cameras see, percent, which is similar to theirs.
    """

    whose: str
    ranges: dict[Kind, Range]
    cameras: tuple[int, int]
    overlap: Range = (0.0, 100.0)


@dataclass(frozen=True)
class RigDifference:
    """One difference between a rig, or a drive with it, and the rigs that weights know.

    Attributes:
        kind: the property.
        cameras: the cameras that differ; none for the whole rig.
        text: what differs, and what follows from it.
        amount: of a drive: frames of the model's rate from one to the next ("rate"), or mean grey ("light").
    """

    kind: Kind
    cameras: tuple[str, ...]
    text: str
    amount: float = 0.0


@dataclass(frozen=True)
class _Property:
    """A property of a camera: its value, how far outside a range is no difference, its unit and its words."""

    kind: Kind
    value: Callable[[Camera, Mounting], float]
    tolerance: float
    unit: str
    verbs: tuple[str, str]  # of one camera, and of several
    words: tuple[str, str]  # below and above the range; {} is by how much


_PROPERTIES = (
    _Property("pitch", lambda _, m: m.pitch_deg, 1.5, "°", ("looks", "look"), ("{} further down", "{} further up")),
    _Property("roll", lambda _, m: m.roll_deg, 1.5, "°", ("leans", "lean"), ("{} to its left", "{} to its right")),
    _Property("height", lambda _, m: m.height, 0.3, " m", ("is", "are"), ("{} lower", "{} higher")),
    _Property(
        "field of view", lambda camera, _: seen_fov_deg(camera)[0], 8.0, "°", ("has a view", "have a view"),
        ("{} narrower", "{} wider"),
    ),
)  # fmt: skip


def known_rigs(config: ModelConfig) -> KnownRigs:
    """The rigs that a model's file states, or nuScenes'."""
    trained = config.training_rigs
    if trained.known:
        tilt: Range = (-trained.tilt_deg, trained.tilt_deg)
        of_camera: dict[Kind, Range] = {"pitch": tilt, "roll": tilt, "height": trained.height_m}
        return KnownRigs("any training camera", {**of_camera, "field of view": trained.fov_deg}, trained.cameras)
    rig = nuscenes_like_rig()
    measures = {measure.code: measure for measure in measures_of(rig.cameras, coverage_of(rig))}
    codes: dict[Kind, str] = {
        "pitch": "pitch-far", "roll": "roll-far", "height": "height-far", "field of view": "fov-far",
    }  # fmt: skip
    ranges = {kind: measures[code].nuscenes for kind, code in codes.items()}
    return KnownRigs("any camera of nuScenes", ranges, (6, 6), measures["overlap-far"].near)


def rig_differences(rig: CameraRig, known: KnownRigs, range_m: float) -> tuple[RigDifference, ...]:
    """The differences of a rig. range_m: distance up to which objects matter, metres."""
    return (*_of_cameras(rig, known, range_m), *_blind_sectors(rig, range_m), *_of_rig(rig, known))


def size_differences(rig: CameraRig, config: ModelConfig) -> Iterator[RigDifference]:
    """Cameras that show objects larger or smaller than nuScenes' camera of their direction, to the network."""
    known, sizes = nuscenes_like_rig(), {}
    for camera in rig.cameras:
        like = min(known.cameras, key=lambda one, yaw=camera.yaw: turn_deg(*np.degrees([one.yaw, yaw])))  # type: ignore[misc]
        sizes[camera.name] = _network_focal(camera, rig, config) / _network_focal(like, known, config)
    off = {name: size for name, size in sizes.items() if not SIZES[0] <= size <= SIZES[1]}
    if off:
        low, high = min(off.values()), max(off.values())
        size = f"{low:.2f}" if round(low, 2) == round(high, 2) else f"{low:.2f} to {high:.2f}"
        where = _named(tuple(off), rig)
        text = f"{where}: objects are {size} times as large in the network's images as with nuScenes' cameras"
        yield RigDifference("size", tuple(off), text)


def _network_focal(camera: Camera, rig: CameraRig, config: ModelConfig) -> float:
    """Focal length along x in the image that the network gets, pixels."""
    return float(camera.intrinsics[0, 0]) * network_scale(camera, image_for_rig(rig, config.image))


def reach_m(rig: CameraRig, range_m: float) -> NDArray[np.float64]:
    """(360 / STEP_DEG,) distance up to which a camera sees the middle of a car, by direction from 0°, metres."""
    yaws, distances = np.radians(np.arange(0, 360, STEP_DEG)), np.arange(1.0, range_m + 0.5, 0.5)
    across = np.stack([np.cos(yaws), np.sin(yaws)], -1)[:, None] * distances[:, None]  # (A, D, 2)
    points = np.concatenate([across, np.full((*across.shape[:2], 1), OBJECT_M)], axis=-1)
    seen = np.any([camera.sees(points) for camera in rig.cameras], axis=0)
    return np.asarray((seen * distances).max(axis=1))


def _of_cameras(rig: CameraRig, known: KnownRigs, range_m: float) -> Iterator[RigDifference]:
    reach = reach_m(rig, range_m)
    mountings = {camera.name: mounting_of(camera.ego_from_camera) for camera in rig.cameras}
    for part in _PROPERTIES:
        low, high = known.ranges[part.kind]
        values = {camera.name: part.value(camera, mountings[camera.name]) for camera in rig.cameras}
        for side, beyond in enumerate(
            ({n: low - v for n, v in values.items()}, {n: v - high for n, v in values.items()})
        ):
            off = tuple(name for name, by in beyond.items() if by > part.tolerance)
            if not off:
                continue
            worst = max(off, key=lambda name: beyond[name])
            digits = 0 if part.unit == "°" else 1
            by = part.words[side].format(f"{'up to ' * (len(off) > 1)}{beyond[worst]:.{digits}f}{part.unit}")
            theirs = f"{values[worst]:.{digits}f}{part.unit}, theirs {low:.{digits}f} to {high:.{digits}f}{part.unit}"
            text = f"{_named(off, rig)} {part.verbs[len(off) > 1]} {by} than {known.whose} ({theirs})"
            seen = reach[round(mountings[worst].yaw_deg / STEP_DEG) % len(reach)]
            if seen < range_m - 2:
                text += f": beyond {seen:.0f} m {_side(mountings[worst].yaw_deg)} no camera sees the middle of a car"
            yield RigDifference(part.kind, off, text)


def _named(names: tuple[str, ...], rig: CameraRig) -> str:
    if 1 < len(names) == len(rig.cameras):
        return f"all {len(names)} cameras"
    return ", ".join(names) if len(names) <= 3 else f"{', '.join(names[:2])} and {len(names) - 2} more"


def _side(yaw_deg: float) -> str:
    side = side_of(yaw_deg)
    return side if side == "ahead" else "at the back" if side == "back" else f"on the {side}"


def blind_sectors_deg(rig: CameraRig, range_m: float) -> list[Range]:
    """Where no camera looks: the first direction and the last, counter-clockwise, degrees; the last is the larger."""
    blind = reach_m(rig, range_m) < NEAR_M
    if blind.all():
        return [(0.0, 360.0)]
    start = int(np.argmin(blind))  # a direction that is seen, so that no sector is cut
    runs = np.flatnonzero(np.diff(np.roll(blind, -start).astype(int), append=0))
    edges = [((start + 1 + run) * STEP_DEG) for run in runs]
    sectors = zip(edges[::2], edges[1::2], strict=True)
    return [(a % 360.0, a % 360.0 + b - a) for a, b in sectors if b - a >= SMALLEST_SECTOR_DEG]


def _blind_sectors(rig: CameraRig, range_m: float) -> Iterator[RigDifference]:
    for first, end in blind_sectors_deg(rig, range_m):
        text = f"no camera sees {end - first:.0f}° {_side((first + end) / 2)}: most objects there are missed"
        yield RigDifference("blind sector", (), text)


def _of_rig(rig: CameraRig, known: KnownRigs) -> Iterator[RigDifference]:
    (fewest, most), overlap = known.cameras, 100 * coverage_of(rig).overlap
    if not fewest <= len(rig.cameras) <= most:
        theirs = f"{fewest}" if fewest == most else f"{fewest} to {most}"
        yield RigDifference("count", (), f"{counted(len(rig.cameras), 'cameras')} (theirs {theirs})")
    if not known.overlap[0] <= overlap <= known.overlap[1]:
        text = "two cameras see {:.0f}% of the BEV cells (similar rigs: {:g} to {:g}%)".format(overlap, *known.overlap)
        yield RigDifference("overlap", (), text)


def taken_back(rig: CameraRig, kind: Kind, known: KnownRigs, range_m: float) -> CameraRig | None:
    """The rig with all differences of a kind taken back; None for a kind that a rig cannot show.

    Angles, heights and focal lengths go to the nearest end of what the weights know; a blind sector gets the cameras of
    nuScenes' rig that look there.
    """
    if kind == "blind sector":
        sectors = blind_sectors_deg(rig, range_m)
        new = [
            camera
            for camera in nuscenes_like_rig().cameras
            if any(turn_deg(float(np.degrees(camera.yaw)), (a + b) / 2) < (b - a) / 2 + 25 for a, b in sectors)
        ]
        names = (replace(camera, name=f"ADDED_{camera.name}") for camera in new)
        return replace(rig, cameras=(*rig.cameras, *names))
    if kind not in known.ranges:
        return None
    return replace(rig, cameras=tuple(_nearest(camera, kind, known.ranges[kind]) for camera in rig.cameras))


def _nearest(camera: Camera, kind: Kind, ends: Range) -> Camera:
    mounting, position = mounting_of(camera.ego_from_camera), camera.ego_from_camera[:3, 3].copy()
    if kind == "field of view":
        fov, intrinsics = seen_fov_deg(camera)[0], camera.intrinsics.copy()
        aim = float(np.clip(fov, *ends))
        edge = np.array([np.tan(np.radians(aim) / 2), 0.0])  # of the image, in normalised coordinates
        if camera.distortion is not None:
            edge = distort(edge, camera.distortion)
        if fov != aim:
            intrinsics[[0, 1], [0, 1]] *= camera.width / 2 / edge[0] / intrinsics[0, 0]
        return replace(camera, intrinsics=intrinsics)
    if kind == "height":
        position[2] = np.clip(position[2], *ends)
        return replace(camera, ego_from_camera=rigid(position, camera.ego_from_camera[:3, :3]))
    pitch, roll = (
        float(np.clip(value, *ends)) if kind == name else value
        for name, value in (("pitch", mounting.pitch_deg), ("roll", mounting.roll_deg))
    )
    return replace(camera, ego_from_camera=rigid(position, looking(mounting.yaw_deg, pitch, roll)))


def looking(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Array:
    """(3, 3) ego_from_camera of the angles of `Mounting`."""
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    up, leaning = (np.asarray(cv2.Rodrigues(np.array(axis))[0]) for axis in ((0, -pitch, 0.0), (roll, 0, 0.0)))
    return np.asarray(rotation_about_z(float(yaw)) @ up @ leaning @ EGO_AXES_FROM_CAMERA)
