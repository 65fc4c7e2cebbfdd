"""The rasteriser, compared with ray casting and cv2.projectPoints, which share no code with it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import inverse, rigid, rotation_about_z
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
