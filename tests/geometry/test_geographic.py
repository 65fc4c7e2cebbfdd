"""World coordinates on Earth, against the exact geometry of the WGS 84 ellipsoid."""

import numpy as np
import pytest

from bevcli.geometry.transforms import GeoOrigin

A, B = 6378137.0, 6356752.314245  # half axes of the ellipsoid, metres


def ecef(latitude_deg: float, longitude_deg: float) -> np.ndarray:
    """Earth-centred coordinates of a point on the ellipsoid."""
    latitude, longitude = np.radians([latitude_deg, longitude_deg])
    normal = A**2 / np.hypot(A * np.cos(latitude), B * np.sin(latitude))
    flat = normal * np.cos(latitude)
    return np.array([flat * np.cos(longitude), flat * np.sin(longitude), (B / A) ** 2 * normal * np.sin(latitude)])


@pytest.mark.parametrize("latitude", [-33.9, 1.29, 48.14])
@pytest.mark.parametrize(("east", "north"), [(800.0, 0.0), (0.0, 800.0), (-500.0, 600.0)])
def test_distances_and_directions_are_those_on_the_ellipsoid(latitude, east, north):
    origin = GeoOrigin(latitude, 11.5)
    moved = ecef(*origin.latitude_longitude([east, north, 0])) - ecef(latitude, 11.5)
    b, c = np.radians([latitude, 11.5])
    to_east = np.array([-np.sin(c), np.cos(c), 0])
    to_north = np.array([-np.sin(b) * np.cos(c), -np.sin(b) * np.sin(c), np.cos(b)])
    np.testing.assert_allclose([moved @ to_east, moved @ to_north], [east, north], atol=0.2)


@pytest.mark.parametrize(("heading", "x_leads_to"), [(0, (1, 0)), (90, (0, 1)), (180, (-1, 0)), (270, (0, -1))])
def test_the_heading_is_the_compass_direction_of_x(heading, x_leads_to):
    steps = GeoOrigin(10.0, 20.0, heading).latitude_longitude([100.0, 0.0]) - (10.0, 20.0)
    np.testing.assert_allclose(steps / np.abs(steps).max(), x_leads_to, atol=1e-9)


def test_y_is_left_of_x():
    latitude, longitude = GeoOrigin(10.0, 20.0, 90).latitude_longitude([0.0, 100.0])
    assert latitude > 10.0
    assert longitude == pytest.approx(20.0)


def test_points_is_the_inverse():
    origin = GeoOrigin(48.14, 11.5, 35)
    points = np.array([[300.0, -40.0], [0.0, 0.0], [-1.5, 900.0]])
    np.testing.assert_allclose(origin.points(origin.latitude_longitude(points)), points, atol=1e-6)
