"""Transforms, boxes, cameras, BEV grids, ego motion, and world coordinates against the exact WGS 84 ellipsoid."""

import sys
from dataclasses import replace
from types import ModuleType

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bevcli.errors import BevcliError, InputError
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, Distortion, default_ego_from_bev
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import (
    GeoOrigin,
    Pose,
    apply,
    interpolate,
    inverse,
    quaternion_from_rotation,
    rigid,
    rotation_about_z,
    rotation_from_quaternion,
    wrap_angle,
)
from bevcli.workshop.formats.pose_readings import Poses

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


@pytest.mark.parametrize("step_s", [0.005, 0.02, 0.5])
def test_the_motion_goes_on_50_ms_outside_the_rows(step_s):
    """On the circle, in the file of a drive and in that of another program; farther outside is an error."""
    drive = circle_drive(step_s=step_s)
    for time, seconds in ((drive.first_ns - 50_000_000, -0.05), (drive.last_ns + 50_000_000, 199 * step_s + 0.05)):
        pose, yaw = drive.pose_at(time), 0.4 * seconds
        np.testing.assert_allclose(pose.translation[:2], 20 * np.array([np.sin(yaw), 1 - np.cos(yaw)]), atol=0.05)
        assert pose.yaw == pytest.approx(wrap_angle(yaw), abs=1e-6)
        np.testing.assert_allclose(Poses.of(drive).at(np.array(time))[0], pose.matrix, atol=1e-4)
        with pytest.raises(InputError, match="50 ms"):
            drive.pose_at(time + (1 if seconds > 0 else -1))


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


def some_boxes(count=5):
    random = np.random.default_rng(3)
    return Boxes3D(
        centers=random.normal(size=(count, 3)),
        sizes_lwh=random.uniform(1, 4, (count, 3)),
        yaws=random.uniform(-3, 3, count),
        velocities=random.normal(size=(count, 2)),
        classes=np.array(["car"] * count),
        scores=random.uniform(size=count),
    )


def test_corners_of_a_box_by_hand():
    box = Boxes3D(
        np.array([[10.0, 0, 1]]), np.array([[4.0, 2, 2]]), np.array([np.pi / 2]), np.zeros((1, 2)), np.array(["car"])
    )
    corners = box.corners()[0]
    assert corners[0] == pytest.approx([9, 2, 0])  # front left, bottom: ahead is +y, left is -x
    assert corners[7] == pytest.approx([11, 2, 2])  # front right, top
    assert {tuple(np.round(c, 9)) for c in corners} == {(x, y, z) for x in (9, 11) for y in (-2, 2) for z in (0, 2)}


def test_transforming_moves_corners_like_points_and_inverts():
    a_from_b = rigid((3, -1, 0.5), rotation_about_z(0.7))
    boxes = some_boxes()
    moved = boxes.transformed(a_from_b)
    assert moved.corners() == pytest.approx(boxes.corners() @ a_from_b[:3, :3].T + a_from_b[:3, 3])
    back = moved.transformed(inverse(a_from_b))
    assert back.velocities == pytest.approx(boxes.velocities)
    assert np.cos(back.yaws - boxes.yaws) == pytest.approx(1)


def test_selecting_and_concatenating_keep_columns_aligned():
    boxes = some_boxes()
    joined = Boxes3D.concatenate([boxes[[3, 1]], Boxes3D.empty(), boxes[boxes.scores > 2]])
    assert joined.centers == pytest.approx(boxes.centers[[3, 1]])
    assert joined.scores == pytest.approx(boxes.scores[[3, 1]])
    assert joined.instances is None
    assert len(Boxes3D.concatenate([])) == 0


def test_boxes_as_an_array_and_as_a_table():
    boxes = Boxes3D(
        centers=np.array([[1.0, 2.0, 3.0]]),
        sizes_lwh=np.array([[4.0, 5.0, 6.0]]),
        yaws=np.array([0.5]),
        velocities=np.array([[7.0, 8.0]]),
        classes=np.array(["car"]),
        scores=np.array([0.9]),
    )
    assert boxes.to_numpy().tolist() == [[1, 2, 3, 4, 5, 6, 0.5, 7, 8]]
    assert boxes.to_dict() == {
        "class": ["car"], "score": [0.9], "x": [1], "y": [2], "z": [3], "length": [4], "width": [5], "height": [6],
        "yaw": [0.5], "vx": [7], "vy": [8],
    }  # fmt: skip
    assert Boxes3D.empty().to_numpy().shape == (0, 9)


def test_boxes_are_a_sequence_of_single_boxes():
    boxes = some_boxes()
    first, last = boxes[0], boxes[-1]
    assert (first.class_name, first.score, first.yaw) == ("car", boxes.scores[0], boxes.yaws[0])
    assert np.array_equal(first.center, boxes.centers[0])
    assert np.array_equal(first.size_lwh, boxes.sizes_lwh[0])
    assert np.array_equal(first.velocity, boxes.velocities[0])
    assert first.columns == {}
    assert last.score == boxes.scores[4]
    assert [box.score for box in boxes] == boxes.scores.tolist()
    assert boxes[np.argmax(boxes.scores)].score == max(boxes.scores)
    assert len(boxes[1:3]) == len(boxes[[0, 4]]) == 2
    with pytest.raises(IndexError):
        boxes[5]
    tracked = replace(boxes, scores=None, instances=np.array(list("abcde")), num_points=np.arange(5))
    assert tracked[2].score is None
    assert tracked[2].columns == {"instance": "c", "num_points": 2}


def test_boxes_become_a_table_of_pandas(monkeypatch):
    boxes = some_boxes()
    monkeypatch.setitem(sys.modules, "pandas", None)  # as if it were not installed
    with pytest.raises(BevcliError, match=r"pandas is not installed: run pip install pandas, or use `to_dict\(\)`"):
        boxes.to_pandas()
    pandas = ModuleType("pandas")
    pandas.DataFrame = lambda columns: columns
    monkeypatch.setitem(sys.modules, "pandas", pandas)
    assert boxes.to_pandas() == boxes.to_dict()


def test_boxes_are_described_in_one_line():
    boxes = replace(some_boxes(3), classes=np.array(["car", "bus", "bus"]))
    assert repr(boxes) == "Boxes3D(3 boxes: 2 bus, 1 car)"
    assert repr(Boxes3D.empty()) == "Boxes3D(0 boxes)"
    box = Boxes3D(
        np.array([[1.0, -2, 0.25]]), np.ones((1, 3)), np.array([np.pi / 2]), np.zeros((1, 2)), boxes.classes[:1]
    )
    assert repr(box[0]) == "Box3D(car at 1.0, -2.0, 0.2 m, yaw 90°)"


INTRINSICS = np.array([[500.0, 0, 400], [0, 510, 300], [0, 0, 1]])
LOOKING_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # ego_from_camera rotation
BROWN = (-0.3, 0.1, 0.001, -0.002, 0.01)
FISHEYE = (0.02, -0.01, 0.003, -0.001)


def camera(distortion=None):
    return Camera("CAM", 800, 600, INTRINSICS, rigid((1.5, 0, 1.6), LOOKING_FORWARD), distortion)


def points_in_view(count=200):
    return np.random.default_rng(2).uniform([-2, -1, 3], [2, 1, 9], size=(count, 3))


def test_point_straight_ahead_falls_on_the_principal_point():
    pixels, depth = camera().project_ego([11.5, 0, 1.6])
    assert pixels == pytest.approx([400, 300])
    assert depth == pytest.approx(10)


def test_pinhole_agrees_with_opencv():
    expected = cv2.projectPoints(points_in_view(), np.zeros(3), np.zeros(3), INTRINSICS, None)[0][:, 0]
    assert camera().project(points_in_view())[0] == pytest.approx(expected)


@pytest.mark.parametrize("coefficients", [BROWN[:4], BROWN, (*BROWN, 0.02, 0.01, 0.003)])
def test_brown_conrady_agrees_with_opencv(coefficients):
    lens = Distortion("brown_conrady", coefficients)
    expected = cv2.projectPoints(points_in_view(), np.zeros(3), np.zeros(3), INTRINSICS, np.array(coefficients))[0]
    assert camera(lens).project(points_in_view())[0] == pytest.approx(expected[:, 0], abs=1e-9)


def test_kannala_brandt_agrees_with_opencv():
    points = points_in_view() * [3, 3, 1]
    expected = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), INTRINSICS, np.array(FISHEYE))[0]
    assert camera(Distortion("kannala_brandt", FISHEYE)).project(points)[0] == pytest.approx(expected[0], abs=1e-9)


def test_points_behind_the_camera_have_no_pixel():
    pixels, depth = camera().project([[0.0, 0, -5], [0, 0, 0], [0, 0, 5]])
    assert np.isnan(pixels[:2]).all()
    assert camera().contains(pixels, depth).tolist() == [False, False, True]


def test_distortion_not_monotonic_gives_no_pixel_past_its_limit():
    pixels, _ = camera(Distortion("brown_conrady", (-0.3, 0, 0, 0))).project([[8.0, 0, 4]])
    assert np.isnan(pixels).all()


LENSES = [Distortion("brown_conrady", BROWN), Distortion("kannala_brandt", FISHEYE)]


@pytest.mark.parametrize("lens", LENSES)
def test_undistortion_agrees_with_opencv(lens):
    """Two images, because the camera keeps its maps. Their colours change slowly, so rounding of maps is small."""
    one_camera = camera(lens)
    u, v = np.meshgrid(np.arange(800), np.arange(600))
    for phase in (0, 1):
        waves = [np.sin(u / 40 + phase), np.cos(v / 50 + phase), np.sin((u + v) / 60)]
        image = (127 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)
        coefficients = np.array(lens.coefficients)
        if lens.model == "kannala_brandt":
            expected = cv2.fisheye.undistortImage(image, INTRINSICS, coefficients, Knew=INTRINSICS)
        else:
            expected = cv2.undistort(image, INTRINSICS, coefficients)
        difference = np.abs(one_camera.undistort(image).astype(int) - expected)
        assert np.median(difference) <= 1
        assert np.percentile(difference, 99) <= 2


def test_image_of_a_camera_without_distortion_stays_as_it_is():
    image = np.random.default_rng(4).integers(0, 255, (600, 800, 3), dtype=np.uint8)
    assert camera().undistort(image) is image


@pytest.mark.parametrize("lens", LENSES)
def test_no_points_have_no_rays(lens):
    assert camera(lens).rays(np.zeros((0, 2))).shape == (0, 3)


@pytest.mark.parametrize("lens", LENSES)
def test_distorted_pixels_are_those_of_the_same_ray(lens):
    pinhole, _ = camera().project(points_in_view())
    expected, _ = camera(lens).project(points_in_view())
    assert camera(lens).distorted(pinhole) == pytest.approx(expected, abs=1e-9)


def test_pixels_scale_with_the_image():
    pixels, _ = camera().project(points_in_view())
    half = camera().scaled(0.5)
    assert half.project(points_in_view())[0] == pytest.approx(pixels / 2)
    assert (half.width, half.height) == (400, 300)


@pytest.mark.parametrize("yaw_deg", [0, 55, -110, 180])
def test_yaw_is_the_viewing_direction(yaw_deg):
    mounted = rigid((1.5, 0, 1.6), rotation_about_z(np.radians(yaw_deg)) @ LOOKING_FORWARD)
    assert np.degrees(replace(camera(), ego_from_camera=mounted).yaw) == pytest.approx(yaw_deg)


def test_default_bev_frame_has_y_ahead_and_x_to_the_right():
    assert apply(default_ego_from_bev(), [[0.0, 10, 0], [3, 0, 0]]) == pytest.approx(
        np.array([[10.94, 0, 1.84], [0.94, -3, 1.84]])
    )
