"""Cuboid: a box that is turned about three axes, as annotation tools draw it into a point cloud."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.sequences.labels.label_format import LabelledFrame, Labels

LARGEST_TILT_DEG = 5.0
_IN_EGO = 'the cuboids are taken to be in the "ego" frame: that of the point clouds that were labelled'


@dataclass(frozen=True)
class Cuboid:
    """A cuboid.

    Attributes:
        kind: name of the class.
        track: identity, "" for none.
        position: (3,) of the middle, metres.
        rotation: (3,) angles about x, y and z, radians: Rx Ry Rz.
        size: (3,) length, width and height, metres.
    """

    kind: str
    track: str
    position: Sequence[float]
    rotation: Sequence[float]
    size: Sequence[float]

    @staticmethod
    def checked(
        where: str, kind: str, track: str, position: Sequence[float], rotation: Sequence[float], size: Sequence[float]
    ) -> "Cuboid":
        """A cuboid of numbers from a file. Raises InputError."""
        numbers = position, rotation, size
        if [len(each) for each in numbers] != [3, 3, 3] or not (np.isfinite(numbers).all() and min(size) > 0):
            raise InputError(f"{where}: expected three numbers each of position, rotation and size, sizes above 0")
        return Cuboid(kind, track, *numbers)

    @property
    def tilt_deg(self) -> float:
        """Angle between the cuboid's vertical and that of the frame, degrees."""
        return float(np.degrees(np.arccos(np.prod(np.cos(self.rotation[:2])))))

    def box(self) -> Boxes3D:
        """The upright box with the cuboid's heading, of unknown velocity."""
        (sx, sy, sz), (cx, cy, cz) = np.sin(self.rotation), np.cos(self.rotation)
        yaw = np.arctan2(cx * sz + sx * sy * cz, cy * cz)
        return Boxes3D(
            np.array([self.position]), np.array([self.size]), np.array([yaw]), np.full((1, 2), np.nan),
            np.array([self.kind]), instances=np.array([self.track]),
        )  # fmt: skip


def labels_of_cuboids(frames: Sequence[tuple[int, list[Cuboid]]], *notes: str, lists_empty: bool) -> Labels:
    """The labels of frames with their index and their cuboids, which are taken to be in the ego frame."""
    boxes = ((index, Boxes3D.concatenate(one.box() for one in cuboids)) for index, cuboids in frames)
    listed = tuple(LabelledFrame(index, None, of_frame) for index, of_frame in boxes)
    tilts = (one.tilt_deg for _, cuboids in frames for one in cuboids)
    return Labels("ego", listed, lists_empty, (_IN_EGO, *notes, *tilt_note(tilts)))


def tilt_note(tilts_deg: Iterable[float]) -> tuple[str, ...]:
    """A note about cuboids that are not upright, if there are any."""
    tilted = sum(tilt > LARGEST_TILT_DEG for tilt in tilts_deg)
    return (f"{tilted} cuboids are tilted by more than {LARGEST_TILT_DEG:g}°: their boxes are upright",) * bool(tilted)
