"""The images and matches behind a calibration, for its sheet and recording."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bevcli.calibration.matches import PointMatches
from bevcli.calibration.measure import Measurement
from bevcli.calibration.unknowns import geometry_at
from bevcli.calibration.views import Views
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.rig.overlay import visible_runs

MOST_SHOWN = 60  # matches of a camera
DEPTHS_M = np.geomspace(0.7, 300, 400)  # along the ray of a point
PIECE_PX = 30.0  # length of the shown piece of an epipolar line to each side


@dataclass(frozen=True)
class ShownMatches:
    """Some matches of one camera in one pair of images.

    Attributes:
        rays_a: (m, 3) unit directions in the first image.
        pixels_b: (m, 2) in the reduced second image.
        camera_b_from_camera_a: (4, 4).
    """

    rays_a: Array
    pixels_b: Array
    camera_b_from_camera_a: Array


@dataclass(frozen=True)
class Evidence:
    """What a calibration was measured from. Each camera is shown by the pair of images with most matches."""

    views: Views
    points: PointMatches
    measurement: Measurement

    def image(self, index: int) -> NDArray[np.uint8] | None:
        """(h, w) grey, the second image of the shown pair of a camera; None where it has no matches."""
        group = self._shown.get(index)
        return None if group is None else self.views.sides(self.views.groups()[group])[1].pixels

    def camera(self, index: int, *, measured: bool) -> Camera:
        """A camera of the reduced images with its stated or its measured pose."""
        camera = self.views.rig.cameras[index]
        return replace(camera, ego_from_camera=self.measurement.unknowns.ego_from_camera(self._x(measured))[index])

    def matches(self, index: int, *, measured: bool) -> ShownMatches:
        """Matches of the shown pair of a camera, with the motion between its images by either calibration."""
        group = self._shown.get(index)
        if group is None:
            return ShownMatches(np.zeros((0, 3)), np.zeros((0, 2)), np.eye(4))
        mine = np.flatnonzero(self.points.group == group)
        mine = mine[:: 1 + len(mine) // MOST_SHOWN]
        found = geometry_at(self.measurement.unknowns, self._x(measured))
        return ShownMatches(self.points.rays_a[mine], self.points.pixels_b[mine], found.camera_b_from_camera_a[group])

    def _x(self, measured: bool) -> Array:
        return self.measurement.solution.x * (1.0 if measured else 0.0)

    @cached_property
    def _shown(self) -> dict[int, int]:
        """Camera -> the group of its shown pair."""
        counts = np.bincount(self.points.group[self.points.same], minlength=len(self.views.groups()))
        groups = self.measurement.unknowns.groups
        best: dict[int, int] = {}
        for group in np.argsort(counts):
            if counts[group]:
                best[int(groups[group, 1])] = int(group)
        return best


def epipolar_piece(camera: Camera, camera_b_from_camera_a: Array, ray: Array, point: Array) -> list[Array]:
    """The part of a ray's image that is nearest to a point, as lines (P, 2) in pixels."""
    points = DEPTHS_M[:, None] * ray @ camera_b_from_camera_a[:3, :3].T + camera_b_from_camera_a[:3, 3]
    pixels = camera.project(points)[0]
    distance = np.linalg.norm(pixels - point, axis=-1)
    if not np.isfinite(distance).any():
        return []
    nearest = pixels[np.nanargmin(distance)]
    near = np.linalg.norm(pixels - nearest, axis=-1) < PIECE_PX
    return visible_runs(np.where(near[:, None], pixels, np.nan))
