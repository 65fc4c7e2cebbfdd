"""Residuals, levels and paths against points projected by hand; cameras that see the same at once; features."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bevcli.geometry.cameras import Camera, CameraRig, Distortion, default_ego_from_bev
from bevcli.geometry.transforms import inverse, rigid, rotation_about_z
from bevcli.workshop.calibration import CalibrateOptions
from bevcli.workshop.calibration.estimates import DELAYS_S, HEIGHT, OF_CAMERA, Unknowns
from bevcli.workshop.calibration.road import followed, level_corrections, sees_road
from bevcli.workshop.calibration.views import PointMatches, View, Views, depths_of, unknowns_of
from bevcli.workshop.correspondence.images import (
    FEWEST_AT_ONCE,
    Features,
    GreyImage,
    features,
    matched,
    points_of_road,
    texture,
)
from bevcli.workshop.correspondence.residuals import (
    EpipolarResiduals,
    RoadResiduals,
    derivatives,
    solve,
    spread,
    values,
)

AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
BLANK = np.zeros((2, 2), dtype=np.uint8)
SPEED, TURN = 6.0, 0.3  # m/s and rad/s


def pose_after(seconds: float) -> np.ndarray:
    """World_from_ego of a vehicle that drives along x, and turns faster and faster."""
    return rigid((SPEED * seconds, 0, 0), rotation_about_z(TURN * seconds**2))


def view(seconds: float) -> View:
    return View(BLANK, BLANK, np.stack([pose_after(seconds + delay) for delay in DELAYS_S]))


@pytest.fixture(scope="module")
def drive():
    """Two cameras, one pair of frames, and points that both cameras see in both."""
    cameras = tuple(
        Camera(name, 1000, 600, np.array([[600.0, 0, 500], [0, 600, 300], [0, 0, 1]]), rigid(place, turn @ AHEAD))
        for name, place, turn in (("A", (1, 0.5, 1.5), np.eye(3)), ("B", (1, -0.5, 1.6), rotation_about_z(-0.4)))
    )
    rig = CameraRig(cameras, default_ego_from_bev())
    views = Views(rig, rig, ((0, 1),), {(place, camera): view(place / 2) for place in (0, 1) for camera in (0, 1)})
    return views, unknowns_of(views, CalibrateOptions())


def rays_in(views: Views, group: tuple[int, int, int], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions of points of the world in both images of a group."""
    rays = []
    for place, index in ((0, group[1]), (1, group[2])):
        camera = inverse(pose_after(place / 2) @ views.rig.cameras[index].ego_from_camera)
        seen = points @ camera[:3, :3].T + camera[:3, 3]
        rays.append(seen / np.linalg.norm(seen, axis=-1, keepdims=True))
    return rays[0], rays[1]


def points_of(views: Views, points: np.ndarray) -> EpipolarResiduals:
    """The same points in every group."""
    rays = [rays_in(views, group, points) for group in views.groups()]
    group = np.repeat(np.arange(len(rays)), len(points))
    return EpipolarResiduals(
        group, *(np.concatenate([each[side] for each in rays]) for side in (0, 1)), np.full(len(group), 600.0)
    )


SCENE = np.random.default_rng(0).uniform((12, -8, 0), (30, 3, 8), (60, 3))
ROAD = np.random.default_rng(1).uniform((8, -3, 0), (20, 3, 0), (40, 3))


def test_points_of_a_rigid_world_leave_no_residual(drive):
    views, unknowns = drive
    assert np.abs(values(unknowns, points_of(views, SCENE), np.zeros(len(unknowns.deviations)))).max() < 1e-6


def test_a_turned_camera_leaves_residuals_of_pixels(drive):
    views, unknowns = drive
    x = np.zeros(len(unknowns.deviations))
    x[0] = np.radians(1.0)  # camera A, pitch: 600 px times 1° is 10 px
    residuals = points_of(views, SCENE)
    within_a = residuals.group == views.groups().index((0, 0, 0))
    assert 0.2 < np.abs(values(unknowns, residuals, x)[within_a]).mean() < 11


def test_derivatives_are_those_of_finite_differences(drive):
    views, unknowns = drive
    residuals, x = points_of(views, SCENE[:5]), np.linspace(-0.01, 0.01, len(unknowns.deviations))
    _, slopes = derivatives(unknowns, residuals, x)
    for place in range(0, len(x), 3):
        step = np.zeros(len(x))
        step[place] = 1e-5
        expected = (values(unknowns, residuals, x + step) - values(unknowns, residuals, x - step)) / 2e-5
        mine = (slopes[:, 0] * (unknowns.columns[residuals.group] == place)).sum(-1)
        assert np.allclose(mine, expected[:, 0], atol=1e-2 * max(np.abs(expected).max(), 1))


def road_of(views: Views, group: int, points: np.ndarray, beside_m: float) -> RoadResiduals:
    """Points of the road in one group, with unit weights of 600 pixels."""
    rays_a, rays_b = rays_in(views, views.groups()[group], points)
    weights, count = np.tile(600 * np.eye(3)[:2], (len(points), 1, 1)), len(points)
    return RoadResiduals(np.full(count, group), rays_a, rays_b, weights, np.full(count, beside_m))


def shared_points(views: Views, unknowns: Unknowns) -> EpipolarResiduals:
    """The points that camera A sees in one frame and camera B in the other."""
    residuals = points_of(views, SCENE)
    groups = unknowns.groups[residuals.group]
    return residuals.where(groups[:, 1] != groups[:, 2])


def lowered(unknowns: Unknowns, height_m: float) -> np.ndarray:
    """Values with camera B lower by a kerb, as if it saw a pavement."""
    x = np.zeros(len(unknowns.deviations))
    x[OF_CAMERA + HEIGHT] = -height_m
    return x


def test_a_camera_on_the_level_of_a_pavement_is_put_right(drive):
    views, unknowns = drive
    road = road_of(views, 0, np.repeat(ROAD, 2, axis=0), beside_m=0.5)  # A sees it right where the vehicle drives
    found = level_corrections(unknowns, road, shared_points(views, unknowns), lowered(unknowns, 0.14))
    assert found[HEIGHT] == 0
    assert found[OF_CAMERA + HEIGHT] == pytest.approx(0.14, abs=0.02)


def test_a_camera_level_with_a_pavement_does_not_see_the_road(drive):
    views, unknowns = drive
    road, shared = road_of(views, 0, np.repeat(ROAD, 2, axis=0), beside_m=0.5), shared_points(views, unknowns)
    assert sees_road(unknowns, road, shared, lowered(unknowns, 0)).tolist() == [True, True]
    assert sees_road(unknowns, road, shared, lowered(unknowns, 0.14)).tolist() == [True, False]


def test_the_road_beside_the_way_may_be_a_pavement(drive):
    views, unknowns = drive
    road, shared = road_of(views, 0, np.repeat(ROAD, 2, axis=0), beside_m=5.0), shared_points(views, unknowns)
    assert not sees_road(unknowns, road, shared, lowered(unknowns, 0)).any()


@pytest.mark.filterwarnings("error")
def test_a_drive_that_shows_no_road_keeps_what_is_stated(drive):
    views, unknowns = drive
    nothing = road_of(views, 0, ROAD[:0], beside_m=0.5)
    x, cameras = lowered(unknowns, 0), unknowns.groups[nothing.group, 1]
    solution = solve(unknowns, [(nothing, spread(unknowns, nothing, x, cameras))], x)
    assert not solution.x.any()
    assert not solution.information.any()


@pytest.mark.parametrize(
    "distortion",
    [
        None,
        Distortion("brown_conrady", (-0.3, 0.1, 0.001, -0.002, 0.01)),
        Distortion("kannala_brandt", (0.05, -0.01, 0.002, 0.0)),
    ],
)
def test_rays_are_the_inverse_of_the_projection(distortion):
    camera = Camera("A", 1000, 600, np.array([[700.0, 0, 480], [0, 690, 310], [0, 0, 1]]), np.eye(4), distortion)
    points = Rotation.random(200, rng=0).apply([0, 0, 5.0])
    points = points[points[:, 2] > 3.5]
    pixels, _ = camera.project(points)
    assert np.allclose(camera.rays(pixels), points / 5, atol=1e-5)


PAIRS, POINTS = 6, 80
WRONG_DEG = np.array([0.1, 0.8, 1.0])  # pitch, yaw and roll of the right camera
INTRINSICS = np.array([[577.0, 0, 500], [0, 577, 150], [0, 0, 1]])


def vehicle(frame: int) -> np.ndarray:
    """World_from_ego on a street that is nearly straight."""
    return rigid((1.2 * frame, 0.01 * frame**2, 0), Rotation.from_euler("z", 0.6 * frame, degrees=True).as_matrix())


def stereo() -> CameraRig:
    """Two cameras of one rotation, half a metre apart."""
    cameras = [
        Camera(name, 1000, 300, INTRINSICS, rigid((1.1, y, 1.6), AHEAD)) for name, y in (("L", 0.0), ("R", -0.5))
    ]
    return CameraRig(tuple(cameras), default_ego_from_bev())


def views_of(stated: CameraRig) -> Views:
    tables = [np.stack([vehicle(frame)] * len(DELAYS_S)) for frame in range(PAIRS + 1)]
    of = {(frame, camera): View(BLANK, BLANK, tables[frame]) for frame in range(PAIRS + 1) for camera in (0, 1)}
    return Views(stated, stated, tuple((frame, frame + 1) for frame in range(PAIRS)), of)


def matches_of(right: CameraRig, views: Views, noise_px: float) -> PointMatches:
    """Points of a scene in all groups; a point has the same ray in all groups that begin with an image."""
    generator, rays, groups = np.random.default_rng(0), [], []
    for index, ((pair, first, second), moves) in enumerate(views.all_groups()):
        start = pair * 1.2 + 1.1
        spread = np.random.default_rng(pair).uniform((start + 6, -9, 0), (start + 60, 9, 5), (POINTS, 3))
        sides = []
        for frame, camera in ((pair, first), (pair + moves, second)):
            pose = inverse(vehicle(frame) @ right.cameras[camera].ego_from_camera)
            pixels, _ = right.cameras[camera].project(spread @ pose[:3, :3].T + pose[:3, 3])
            same = np.random.default_rng((frame, camera)) if frame == pair and camera == first else generator
            sides.append(right.cameras[camera].rays(pixels + same.normal(0, noise_px, pixels.shape)))
        rays.append(sides)
        groups.append(np.full(len(spread), index))
    a, b = (np.concatenate([each[side] for each in rays]) for side in (0, 1))
    group = np.concatenate(groups)
    kinds = np.array([(g[1] == g[2], moves) for g, moves in views.all_groups()])[group]
    return PointMatches(group, a, b, np.full(len(a), 577.0), kinds[:, 0], kinds[:, 1])


@pytest.fixture(scope="module")
def planted():
    """Views of a rig that states a wrong rotation of its right camera, and matches with noise of the right one."""
    right = stereo()
    pose = right.cameras[1].ego_from_camera @ rigid(rotation=Rotation.from_rotvec(WRONG_DEG, degrees=True).as_matrix())
    views = views_of(replace(right, cameras=(right.cameras[0], replace(right.cameras[1], ego_from_camera=pose))))
    return views, unknowns_of(views, CalibrateOptions()), matches_of(right, views, 0.1)


@pytest.mark.slow
def test_neighbours_tell_their_rotation_against_each_other(planted):
    _, unknowns, matches = planted
    within, at_once, depths = matches.where(matches.same), matches.where(~matches.moves), depths_of(unknowns, matches)
    x = np.zeros(len(unknowns.deviations))
    for scale in (20.0, 5.0, 0.5):
        x = solve(unknowns, [(within, scale), (at_once, scale), (depths, scale)], x).x
    changes = np.degrees(unknowns.of_camera(x)[:, :3])
    assert np.abs(changes[1] - changes[0] + WRONG_DEG).max() < 0.05


def test_depths_of_two_cameras_fit_the_motion(planted):
    right = views_of(stereo())
    unknowns, exact = unknowns_of(right, CalibrateOptions()), matches_of(stereo(), right, 0.0)
    depths, x = depths_of(unknowns, exact), np.zeros(len(unknowns.deviations))
    assert len(depths.group) == PAIRS * POINTS
    assert np.abs(values(unknowns, depths, x)).max() < 1e-3
    x[OF_CAMERA + 1] = np.radians(0.1)  # the right camera, yaw: 1 px of disparity
    assert 0.05 < np.median(np.linalg.norm(values(unknowns, depths, x), axis=-1)) < 1


def test_few_matches_of_two_cameras_are_not_used():
    left, right = stereo().cameras
    points = np.random.default_rng(0).uniform((8, -6, -1), (30, 6, 4), (6 * FEWEST_AT_ONCE, 3))
    descriptors = np.random.default_rng(1).integers(0, 100, (len(points), 128)).astype(np.float32)
    seen = [Features(camera.project_ego(points)[0], descriptors) for camera in (left, right)]
    assert len(matched(*seen, left, right, at_once=True)[0]) > FEWEST_AT_ONCE
    few = [Features(each.pixels[: FEWEST_AT_ONCE - 5], each.descriptors[: FEWEST_AT_ONCE - 5]) for each in seen]
    assert len(matched(*few, left, right, at_once=True)[0]) == 0


def road_views(ground: np.ndarray, noise: float) -> Views:
    """A camera that looks at a road in two frames. ground: grey, cells of 2 cm, a row along y; noise: of the images."""
    camera = replace(stereo().cameras[0], height=500)
    pixels = np.stack(np.meshgrid(np.arange(1000), np.arange(500)), axis=-1).reshape(-1, 2)
    of = {}
    for frame in (0, 1):
        pose = vehicle(frame) @ camera.ego_from_camera
        points = np.nan_to_num(points_of_road(pose, camera.rays(pixels)), nan=-99.0)
        x, y = ((points[:, axis] + start) / 0.02 for axis, start in ((0, 0.0), (1, 12.0)))
        grey = cv2.remap(ground, y.astype(np.float32).reshape(500, 1000), x.astype(np.float32).reshape(500, 1000), 1)
        grey = grey + np.random.default_rng(frame).normal(0, noise, grey.shape)
        table = np.stack([vehicle(frame)] * len(DELAYS_S))
        of[frame, 0] = View(BLANK, texture(np.clip(grey, 0, 255).astype(np.uint8)), table)
    rig = CameraRig((camera,), default_ego_from_bev())
    return Views(rig, rig, ((0, 1),), of)


@pytest.mark.slow
@pytest.mark.parametrize(("striped", "least", "most"), [(False, 0.9, 1.1), (True, 0.0, 0.6)])
def test_a_road_of_stripes_does_not_show_a_wrong_roll(striped, least, most):
    size = (1 if striped else 200, 160)
    ground = np.random.default_rng(0).uniform(-1, 1, size).astype(np.float32).repeat(200 // size[0], axis=0)
    grey = 128 + 70 * cv2.resize(ground, (1200, 1500), interpolation=cv2.INTER_CUBIC)
    views = road_views(grey, noise=4.0)
    unknowns = unknowns_of(views, CalibrateOptions())
    [share] = followed(views, unknowns, np.zeros(len(unknowns.deviations)), 12.0, np.zeros(1))
    assert least < share < most


PIXELS = np.random.default_rng(0).integers(0, 256, (30, 40)).repeat(6, axis=0).repeat(6, axis=1).astype(np.uint8)
LEFT = np.arange(240) < 120


@pytest.mark.parametrize("brightness", [0, 90])
def test_texture_is_that_of_what_is_seen(brightness):
    """And not of the brightness beside it, which is what an image has where no camera looks."""
    seen = np.broadcast_to(LEFT, PIXELS.shape)
    found = texture(np.where(seen, PIXELS, brightness).astype(np.uint8), seen)
    assert (found[:, 120:] == 128).all()
    assert np.abs(found[:, :98].astype(int) - texture(PIXELS)[:, :98]).max() <= 1  # the rest is near the edge


def test_texture_does_not_depend_on_light():
    assert np.abs(texture(PIXELS // 2 + 60).astype(int) - texture(PIXELS)).max() < 8


def test_features_are_those_of_what_is_seen():
    image = GreyImage(PIXELS, texture(PIXELS))
    found = features(image, np.broadcast_to(LEFT, PIXELS.shape))
    everywhere = features(image)
    assert 50 < len(found.pixels) < len(everywhere.pixels)
    assert found.pixels[:, 0].max() < 121
