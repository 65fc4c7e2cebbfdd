"""Transforms, BEV grids, ego motion, and world coordinates on Earth against the exact WGS 84 ellipsoid."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bevcli.errors import InputError
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import (
    GeoOrigin,
    Pose,
    apply,
    interpolate,
    inverse,
    quaternion_from_rotation,
    rigid,
    rotation_from_quaternion,
)

RANDOM = np.random.default_rng(1)


def random_quaternions(count):
    quaternions = RANDOM.normal(size=(count, 4))
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


@pytest.mark.parametrize("quaternion", random_quaternions(20))
def test_rotation_agrees_with_scipy_both_ways(quaternion):
    expected = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    assert rotation_from_quaternion(quaternion) == pytest.approx(expected, abs=1e-12)
    back = quaternion_from_rotation(expected)
    assert back[0] >= 0
    assert np.abs(back @ quaternion) == pytest.approx(1)


def test_inverse_undoes_a_transform():
    a_from_b = rigid((1, -2, 3), rotation_from_quaternion(random_quaternions(1)[0]))
    points = RANDOM.normal(size=(7, 3))
    assert apply(inverse(a_from_b), apply(a_from_b, points)) == pytest.approx(points)
    assert inverse(np.stack([a_from_b, np.eye(4)]))[0] @ a_from_b == pytest.approx(np.eye(4))


def test_interpolation_takes_the_shorter_arc_and_the_first_sign():
    start = Pose(np.zeros(3), np.array([-np.cos(0.1), 0, 0, -np.sin(0.1)]))  # yaw 0.2, stored with w < 0
    end = Pose(np.array([2.0, 0, 0]), np.array([np.cos(0.3), 0, 0, np.sin(0.3)]))  # yaw 0.6
    middle = interpolate(start, end, 0.5)
    assert middle.translation == pytest.approx([1, 0, 0])
    assert middle.yaw == pytest.approx(0.4)
    assert middle.quaternion[0] < 0


def test_cells_of_a_small_grid_by_hand():
    grid = BevGrid(rows=2, columns=4, x_range_m=(-4, 4), y_range_m=(-1, 1))
    assert grid.cell_size_m == (2, 1)
    assert grid.cell_centers()[0, 0] == pytest.approx([-3, -0.5])
    assert grid.cell_centers()[1, 3] == pytest.approx([3, 0.5])


def test_cell_of_a_centre_is_its_cell_outside_points_have_none():
    grid = BevGrid(rows=5, columns=7)
    rows, columns = np.indices((5, 7))
    assert (grid.cell_of(grid.cell_centers()) == np.stack([rows, columns], axis=-1)).all()
    assert grid.cell_of([[-51.3, 0], [0, 51.3]]).tolist() == [[-1, -1], [-1, -1]]


def test_pillars_stand_on_the_centres_at_the_published_heights():
    pillars = BevGrid(rows=50, columns=50).pillars()
    assert pillars.shape == (50, 50, 4, 3)
    assert pillars[0, 0, :, 2] == pytest.approx([-4.5, -4.5 + 7 / 3, -4.5 + 14 / 3, 2.5])
    assert pillars[49, 0, 0, :2] == pytest.approx([-50.176, 50.176])


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


def circle_drive(radius=20.0, speed=8.0, count=200, step_s=0.02):
    """A drive on a circle: constant speed, turning left."""
    seconds = np.arange(count) * step_s
    yaws = seconds * speed / radius
    translations = np.stack([radius * np.sin(yaws), radius * (1 - np.cos(yaws)), 0 * yaws], axis=-1)
    quaternions = np.stack([np.cos(yaws / 2), 0 * yaws, 0 * yaws, np.sin(yaws / 2)], axis=-1)
    times = (seconds * 1e9).astype(np.int64) + 1_533_151_603_000_000_001
    return EgoMotion(times, translations, quaternions, *derive_kinematics(times, translations, quaternions))


def test_derived_kinematics_of_a_circle():
    drive = circle_drive()
    at = drive.kinematics_at(int(drive.timestamps_ns[100]))
    assert at.velocity == pytest.approx([8, 0, 0], abs=0.01)
    assert at.angular_rate == pytest.approx([0, 0, 0.4], abs=0.001)
    assert at.acceleration == pytest.approx([0, 3.2, 9.81], abs=0.01)  # v²/r to the left, and gravity


def test_time_of_a_row_gives_exactly_that_row():
    drive = circle_drive()
    pose = drive.pose_at(int(drive.timestamps_ns[7]))
    assert (pose.translation == drive.translations[7]).all()
    assert (pose.quaternion == drive.quaternions[7]).all()


def test_between_rows_the_pose_lies_between():
    drive = circle_drive(step_s=0.5, count=4)
    middle = (int(drive.timestamps_ns[0]) + int(drive.timestamps_ns[1])) // 2
    assert drive.pose_at(middle).yaw == pytest.approx(0.1)


def test_time_more_than_50_ms_outside_is_an_error():
    drive = circle_drive()
    last = int(drive.timestamps_ns[-1])
    assert (drive.pose_at(last + 50_000_000).translation == drive.translations[-1]).all()
    with pytest.raises(InputError, match="50 ms"):
        drive.pose_at(last + 50_000_001)


def upright(pitches, slope_deg=4.0, step_s=0.02):
    """A straight drive at 10 m/s down a slope, whose body pitches over it. pitches: (T,) degrees."""
    half = np.radians(slope_deg + pitches) / 2
    quaternions = np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half], axis=-1)
    seconds = step_s * np.arange(len(pitches))
    times, slope = (seconds * 1e9).astype(np.int64), np.radians(slope_deg)
    translations = 10 * seconds[:, None] * (np.cos(slope), 0, -np.sin(slope))
    return EgoMotion(times, translations, quaternions, *derive_kinematics(times, translations, quaternions))


def test_the_road_is_as_the_vehicle_stands_on_the_mean():
    """On a slope too, where gravity tells another direction."""
    seconds = np.arange(0, 20, 0.02)
    drive = upright(np.sin(2 * np.pi * seconds / 2))
    for row in (300, 425, 575, 700):
        pitch = np.radians(np.sin(np.pi * seconds[row]))
        normal = drive.road_normal_at(int(drive.timestamps_ns[row]))
        assert normal == pytest.approx([-np.sin(pitch), 0, np.cos(pitch)], abs=5e-4)  # nose down: up is aft


def test_a_body_that_never_moves_stands_on_its_road():
    drive = upright(np.zeros(50))
    assert drive.road_normal_at(int(drive.timestamps_ns[20])) == pytest.approx([0, 0, 1])
    one = drive.of_rows(np.array([3]))
    assert one.road_normal_at(one.first_ns) == pytest.approx([0, 0, 1])
