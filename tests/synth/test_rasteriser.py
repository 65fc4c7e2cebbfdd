"""The rasteriser against ray casting and OpenCV, and each corruption of images against numbers or another library."""

import colorsys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import inverse, rigid, rotation_about_z
from bevcli.workshop.robustness.conditions import Draws
from bevcli.workshop.synth.corruptions import (
    FOG,
    LOW_LIGHT,
    blur_kernel,
    brightness,
    color_quantisation,
    defocus_blur,
    fog,
    fractal,
    impulse_noise,
    jpeg,
    low_contrast,
    low_light,
    motion_blur,
    saturation,
    snow,
)
from bevcli.workshop.synth.mesh import Mesh, TriangleSoup
from bevcli.workshop.synth.renderer import rasterise
from bevcli.workshop.synth.rig import nuscenes_like_rig

CAMERA = nuscenes_like_rig(160, 90)["CAM_FRONT_LEFT"]
WORLD_FROM_CAMERA = rigid((3.0, -2.0, 0.1), rotation_about_z(0.4)) @ CAMERA.ego_from_camera


def draw(corners, camera: Camera = CAMERA, objects=None):
    """Rasterise triangles, each as a mesh of its own."""
    corners = np.asarray(corners, np.float32)
    white, plain = np.ones((1, 3), np.float32), np.zeros(1, np.uint8)
    meshes = [TriangleSoup.from_mesh(Mesh(corner[None], white, plain)) for corner in corners]
    soup = TriangleSoup.gather(meshes, objects if objects is not None else range(len(meshes)))
    return rasterise(soup, camera, inverse(WORLD_FROM_CAMERA), int(soup.mesh_objects.max()) + 1)


def random_triangles(count: int, seed: int = 0):
    """(count, 3, 3) triangles in front of, around and behind the camera, world frame."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform((-9, -6, -2), (9, 6, 14), (count, 1, 3))
    local = centers + rng.normal(0, 2.0, (count, 3, 3))
    return local @ WORLD_FROM_CAMERA[:3, :3].T + WORLD_FROM_CAMERA[:3, 3]


def cast(corners, camera: Camera):
    """The first triangle on the ray of each pixel, -1 for none, and its depth: ray casting, one triangle at a time."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3) @ np.linalg.inv(camera.intrinsics).T
    best, index = np.full(len(rays), np.inf), np.full(len(rays), -1)
    local = (corners - WORLD_FROM_CAMERA[:3, 3]) @ WORLD_FROM_CAMERA[:3, :3]
    for k, (a, b, c) in enumerate(local):
        normal = np.cross(b - a, c - a)
        if normal @ a >= 0:
            continue
        depth = (normal @ a) / (rays @ normal)
        points = rays * depth[:, None]
        inside = np.ones(len(rays), bool)
        for p, q in ((a, b), (b, c), (c, a)):
            inside &= np.einsum("ij,j->i", np.cross(q - p, points - p), normal) >= 0
        nearer = inside & (depth > 0.1) & (depth < best)
        best[nearer], index[nearer] = depth[nearer], k
    return index.reshape(camera.height, camera.width), best.reshape(camera.height, camera.width)


@pytest.mark.parametrize("skew", [0.0, 4.0])
def test_each_pixel_sees_the_first_triangle_on_its_ray(skew):
    intrinsics = CAMERA.intrinsics.copy()
    intrinsics[0, 1] = skew
    camera = replace(CAMERA, intrinsics=intrinsics)
    corners = random_triangles(60).astype(np.float32)
    buffer = draw(corners, camera)
    index, depth = cast(corners.astype(np.float64), camera)
    agree = buffer.triangles == index
    assert agree.mean() > 0.998  # a pixel whose centre is on an edge may belong to either side
    seen = agree & (index >= 0)
    assert seen.sum() > 2000
    np.testing.assert_allclose(1 / buffer.inverse_depth[seen], depth[seen], rtol=2e-3)


def test_corners_are_drawn_where_opencv_projects_them():
    """The pixels of a small triangle are within the projections of its corners by cv2.projectPoints."""
    camera = CAMERA.scaled(8)
    rng = np.random.default_rng(5)
    camera_from_world = inverse(WORLD_FROM_CAMERA)
    rotation, _ = cv2.Rodrigues(camera_from_world[:3, :3])
    for _ in range(20):
        local = np.array([*(rng.uniform(-0.5, 0.5, 2) * (1.0, 0.5)), 1.0]) * rng.uniform(4, 30)
        size = 0.012 * local[2]
        triangle = local + size * np.array([(0, -1, 0), (-1, 1, 0), (1, 1, 0)])
        triangle = triangle @ WORLD_FROM_CAMERA[:3, :3].T + WORLD_FROM_CAMERA[:3, 3]
        expected, _ = cv2.projectPoints(triangle, rotation, camera_from_world[:3, 3], camera.intrinsics, None)
        rows, columns = np.nonzero(draw([triangle], camera).triangles >= 0)
        assert len(rows)
        low, high = expected[:, 0].min(0), expected[:, 0].max(0)
        np.testing.assert_allclose([columns.min(), rows.min()], low, atol=2.6)  # the tip is narrower than a pixel
        np.testing.assert_allclose([columns.max(), rows.max()], high, atol=2.6)
        assert (columns >= low[0] - 1e-3).all()
        assert (columns <= high[0] + 1e-3).all()


def test_unoccluded_pixels_are_those_of_the_object_alone():
    """For every object that is not hidden completely."""
    corners = random_triangles(40, seed=2)
    together = draw(corners, objects=np.arange(40) // 4)
    checked = 0
    for owner in range(10):
        alone = draw(corners[4 * owner : 4 * owner + 4], objects=[0] * 4)
        if np.isin(together.triangles, np.arange(4 * owner, 4 * owner + 4)).any():
            assert together.unoccluded[owner] == (alone.triangles >= 0).sum()
            checked += 1
    assert checked >= 4


def test_triangles_behind_the_camera_are_not_drawn():
    """A pair of opposite triangles 3 m in front of the camera is drawn, the same pair 3 m behind it is not."""
    one = [(-1, -1, 3), (-1, 1, 3), (1, 1, 3)]
    local = np.array([one, one[::-1]], np.float64)
    for sign, drawn in ((1, True), (-1, False)):
        world = local * (1, 1, sign) @ WORLD_FROM_CAMERA[:3, :3].T + WORLD_FROM_CAMERA[:3, 3]
        assert (draw(world).triangles >= 0).any() == drawn


OF_FIVE = (brightness, motion_blur, fog, defocus_blur, low_contrast, impulse_noise, jpeg, saturation)
LEVELS = {**dict.fromkeys(OF_FIVE, 5), low_light: 4, color_quantisation: 3, snow: 3}


def noise_image(height: int = 90, width: int = 160) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (height, width, 3), dtype=np.uint8)


def random(*keys: str | int, seed: int = 0) -> np.random.Generator:
    return Draws(seed, "test").generator(*keys)


@pytest.mark.parametrize("corrupt", LEVELS, ids=lambda corrupt: corrupt.__name__)
def test_a_corruption_keeps_shape_and_type_and_repeats_exactly(corrupt):
    image = noise_image()
    before = image.copy()
    first, second = (corrupt(image, LEVELS[corrupt], random("a", 3, "CAM_FRONT")) for _ in range(2))
    assert first.shape == image.shape
    assert first.dtype == np.uint8
    assert first.tobytes() == second.tobytes()
    assert not np.array_equal(first, image)
    assert np.array_equal(image, before)


@pytest.mark.parametrize("corrupt", [low_light, motion_blur, fog, snow], ids=lambda corrupt: corrupt.__name__)
def test_random_corruptions_differ_by_camera_frame_and_seed(corrupt):
    image = noise_image()
    keys = [random("a", 3, "CAM_FRONT"), random("a", 3, "CAM_BACK"), random("a", 4, "CAM_FRONT")]
    keys.append(random("a", 3, "CAM_FRONT", seed=1))
    assert len({corrupt(image, LEVELS[corrupt], key).tobytes() for key in keys}) == 4


@pytest.mark.parametrize(("level", "bits"), [(1, 4), (2, 3), (3, 2)])
def test_color_quantisation_is_the_posterisation_of_pillow(level, bits):
    image = noise_image()
    posterised = np.asarray(ImageOps.posterize(Image.fromarray(image), bits))
    assert np.array_equal(color_quantisation(image, level, random()), posterised)


def test_brightness_raises_value_and_keeps_hue_and_saturation():
    image = noise_image(4, 5)
    brighter = brightness(image, 2, random())
    for before, after in zip(image.reshape(-1, 3), brighter.reshape(-1, 3), strict=True):
        hue, saturation, value = colorsys.rgb_to_hsv(*(before[::-1] / 255))
        expected = np.array(colorsys.hsv_to_rgb(hue, saturation, min(value + 0.2, 1)))[::-1] * 255
        assert np.abs(after - expected).max() <= 1


def test_low_light_dims_and_adds_noise_of_the_stated_variance():
    image = np.zeros((200, 300, 3), dtype=np.uint8)
    image[:100] = 51  # the darkest and the brightest value are 51 and 204, so 127.5 would be half of the range
    image[:100, :150] = 204
    image[100:] = 102  # a third of the range
    brightest, photons, read_noise = LOW_LIGHT[3]
    dark = low_light(image, 3, random()) / 255
    assert dark[:100, :150].mean() == pytest.approx(brightest, abs=0.003)
    third = dark[100:]
    assert third.mean() == pytest.approx(brightest / 9, abs=0.005)  # clipping at 0 raises the mean a little
    assert dark[:100, :150].var() == pytest.approx(brightest / photons + read_noise**2, rel=0.05)


def test_motion_blur_spreads_a_point_and_leaves_even_areas():
    image = np.zeros((181, 1600, 3), dtype=np.uint8)
    image[90, 800] = 255
    rows, columns = np.nonzero(motion_blur(image, 2, random())[..., 0])
    assert len(columns) > 5
    # Within 45° of the horizontal, up to the rounding to pixels.
    assert abs(rows[-1] - rows[0]) <= abs(columns.max() - columns.min()) + 2
    assert (motion_blur(np.full_like(image, 77), 5, random()) == 77).all()


def test_a_blur_has_the_same_relative_length_at_every_width():
    def length(scale: float) -> float:
        kernel = blur_kernel(15, 12.0, 30.0, scale)
        y, x = np.indices(kernel.shape) - (len(kernel) - 1) / 2
        return float(np.hypot((kernel * x).sum(), (kernel * y).sum()))  # the centroid moves with the line

    steps = np.arange(31)
    weights = np.exp(-(steps**2) / (2 * 12.0**2))
    by_hand = (steps * weights).sum() / weights.sum()
    assert length(1.0) == pytest.approx(by_hand, rel=1e-5)
    assert length(0.32) == pytest.approx(0.32 * by_hand, rel=1e-5)


def test_fog_reduces_contrast_by_the_stated_factor():
    dark, bright = np.full((60, 80, 3), 40, dtype=np.uint8), np.full((60, 80, 3), 40, dtype=np.uint8)
    bright[30] = 90
    dark[0, 0] = bright[0, 0] = 255  # both images have the same brightest value
    difference = fog(bright, 4, random())[30].astype(float) - fog(dark, 4, random())[30]
    assert difference == pytest.approx(50 / (1 + FOG[4][0]), abs=1.01)


def test_the_fog_covers_0_to_1_and_is_finer_with_a_smaller_decay():
    coarse, fine = (fractal(128, decay, random()) for decay in (2.0, 1.4))
    for grid in (coarse, fine):
        assert grid.shape == (128, 128)
        assert (grid.min(), grid.max()) == (0, 1)
        # Neighbours are much more alike than distant cells, also across the edge: the map is periodic.
        assert np.abs(grid - np.roll(grid, 1, axis=1)).mean() < 0.3 * np.abs(grid - np.roll(grid, 64, axis=1)).mean()
    assert np.abs(np.diff(fine)).mean() > 2 * np.abs(np.diff(coarse)).mean()


def test_snow_whitens_the_image_and_adds_grey_flakes():
    snowy = snow(np.zeros((288, 512, 3), dtype=np.uint8), 1, random())
    assert snowy.min() == pytest.approx(0.2 * 0.5 * 255, abs=1)  # between flakes: (1 - 0.8) of 1.5 grey + 0.5
    assert 0.02 < (snowy > 60).mean() < 0.6
    assert (snowy[..., 0] == snowy[..., 1]).all()


def test_as_much_snow_falls_in_small_images_as_in_large_ones():
    small, large = (snow(np.zeros((h, w, 3), np.uint8), 2, random()).mean() for h, w in ((288, 512), (900, 1600)))
    assert small == pytest.approx(large, rel=0.03)


def test_contrast_impulse_noise_and_saturation_by_hand():
    image = np.stack([np.full((8, 8), 40), np.full((8, 8), 120)], axis=1).reshape(8, 16, 1).repeat(3, 2)
    assert set(np.unique(low_contrast(image.astype(np.uint8), 4, random()))) == {76, 84}  # 80 -/+ 0.1 * 40
    noisy = impulse_noise(np.full((200, 200, 3), 100, dtype=np.uint8), 5, random())
    assert np.mean(noisy == 0) == pytest.approx(0.135, abs=0.005)
    assert np.mean(noisy == 255) == pytest.approx(0.135, abs=0.005)
    image = np.full((4, 4, 3), (50, 100, 200), dtype=np.uint8)
    assert np.ptp(saturation(image, 2, random())[0, 0]) == pytest.approx(15, abs=1)  # a tenth of 150
    assert saturation(image, 5, random())[0, 0].min() == 0


def test_defocus_spreads_a_point_over_a_disk():
    image = np.zeros((201, 1600, 3), dtype=np.uint8)
    image[100, 800] = 255
    blurred = defocus_blur(image, 2, random())[..., 0] > 0  # radius 4
    assert np.array_equal(np.argwhere(blurred.any(axis=0)).ravel(), np.arange(796, 805))
    assert 45 <= blurred.sum() <= 61  # pi * 4² is 50
