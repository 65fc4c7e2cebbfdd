"""The place of a drive on Earth: world coordinates in metres as latitude and longitude."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bevcli.geometry.transforms import Array

# The ellipsoid of WGS 84.
EQUATOR_RADIUS_M = 6378137.0
ECCENTRICITY_SQUARED = 6.69437999014e-3
EAST_DEG = 90.0


@dataclass(frozen=True)
class GeoOrigin:
    """Place of a drive's world frame on Earth (WGS 84). Its z axis points up.

    Attributes:
        latitude_deg: latitude of the world frame's origin, degrees, north is positive.
        longitude_deg: longitude of the origin, degrees, east is positive.
        heading_deg: compass direction of the world's x axis, degrees clockwise from north. 90: x is east, y north.
    """

    latitude_deg: float
    longitude_deg: float
    heading_deg: float = EAST_DEG

    def latitude_longitude(self, points_world: ArrayLike) -> Array:
        """Points (..., 2 or 3) of the world frame, metres -> latitude and longitude (..., 2), degrees.

        The Earth's surface counts as flat around the origin: within 10 km the error is below 20 m, within 1 km below
        20 cm.
        """
        points = np.asarray(points_world, dtype=np.float64)
        heading = np.radians(self.heading_deg)
        x, y = points[..., 0], points[..., 1]
        east = x * np.sin(heading) - y * np.cos(heading)
        north = x * np.cos(heading) + y * np.sin(heading)
        latitude = np.radians(self.latitude_deg)
        bend = 1 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
        along_meridian = EQUATOR_RADIUS_M * (1 - ECCENTRICITY_SQUARED) / bend**1.5
        along_parallel = EQUATOR_RADIUS_M / np.sqrt(bend) * np.cos(latitude)
        steps = np.stack([north / along_meridian, east / along_parallel], axis=-1)
        return np.array([self.latitude_deg, self.longitude_deg]) + np.degrees(steps)
