"""Cuboid: a box that is turned about three axes, as annotation tools draw it into a point cloud."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.workshop.formats.labels.label_format import FrameOfReference, LabelledFrame, Labels, Moment

LARGEST_TILT_DEG = 5.0
IN_EGO = 'the cuboids are taken to be in the "ego" frame: that of the point clouds that were labelled'


@dataclass(frozen=True)
class Cuboid:
    """A cuboid. box: the upright box with its heading. tilt_deg: angle between its vertical and that of the frame."""

    box: Boxes3D
    tilt_deg: float


def cuboid_of(
    where: str, kind: str, track: str, position: Sequence[float], rotation: Sequence[float], size: Sequence[float]
) -> Cuboid:
    """A cuboid of numbers from a file, of unknown velocity. Raises InputError.

    kind: name of the class. track: identity, "" for none. position: (3,) of the middle, metres. rotation: (3,) angles
    about x, y and z, radians: Rx Ry Rz. size: (3,) length, width and height, metres.
    """
    numbers = position, rotation, size
    if [len(each) for each in numbers] != [3, 3, 3] or not np.isfinite(numbers).all():
        raise InputError(f"{where}: expected three numbers each of position, rotation and size")
    (sx, sy, sz), (cx, cy, cz) = np.sin(rotation), np.cos(rotation)
    yaw = np.arctan2(cx * sz + sx * sy * cz, cy * cz)
    box = Boxes3D(
        np.array([position]), np.array([size]), np.array([yaw]), np.full((1, 2), np.nan), np.array([kind]),
        instances=np.array([track]),
    )  # fmt: skip
    return Cuboid(box, float(np.degrees(np.arccos(cx * cy))))


def labels_of_cuboids(
    reference: FrameOfReference, frames: Iterable[tuple[Moment, list[Cuboid]]], *notes: str, lists_empty: bool
) -> Labels:
    """The labels of frames with their cuboids, and a note about tilted ones."""
    listed = list(frames)
    tilted = sum(one.tilt_deg > LARGEST_TILT_DEG for _, cuboids in listed for one in cuboids)
    if tilted:
        notes = (*notes, f"{tilted} cuboids are tilted by more than {LARGEST_TILT_DEG:g}°: their boxes are upright")
    labelled = (LabelledFrame(*moment, Boxes3D.concatenate(one.box for one in cuboids)) for moment, cuboids in listed)
    return Labels(reference, tuple(labelled), lists_empty, notes)
