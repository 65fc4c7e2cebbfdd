"""The meshes: enough variants, plausible sizes, closed surfaces, and boxes that fit."""

import cv2
import numpy as np
import pytest

from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.workshop.synth.catalog import Assets, draw_body
from bevcli.workshop.synth.mesh import linear

VEHICLES = ("car", "truck", "construction_vehicle", "bus", "trailer", "motorcycle", "bicycle")
# Smallest and largest plausible length, width and height of each class, metres.
PLAUSIBLE = {
    "car": ((3.5, 1.5, 1.2), (5.8, 2.2, 2.4)), "truck": ((4.5, 1.8, 1.6), (12, 2.7, 4.2)),
    "construction_vehicle": ((3.5, 1.8, 2.2), (10, 3.5, 4.5)), "bus": ((6, 2.2, 2.5), (18.5, 3.1, 4.5)),
    "trailer": ((3, 1.7, 1.2), (15, 3, 4.5)), "barrier": ((0.2, 1.5, 0.7), (0.9, 3.5, 1.4)),
    "motorcycle": ((1.5, 0.5, 0.9), (2.6, 1.1, 2.0)), "bicycle": ((1.4, 0.4, 0.8), (2.2, 0.9, 2.1)),
    "pedestrian": ((0.2, 0.3, 0.9), (1.2, 1.0, 2.1)), "traffic_cone": ((0.2, 0.2, 0.4), (0.8, 0.8, 1.3)),
}  # fmt: skip


@pytest.mark.parametrize("name", NUSCENES_CLASSES)
def test_there_are_enough_variants(assets: Assets, name: str):
    looks = {v.name.removesuffix("_standing") for v in assets.by_class[name]}
    assert len(looks) >= (6 if name in VEHICLES else 4)


@pytest.mark.parametrize("name", NUSCENES_CLASSES)
def test_sizes_are_plausible(assets: Assets, name: str):
    low, high = np.array(PLAUSIBLE[name])
    for variant in assets.by_class[name]:
        assert (variant.size_lwh > low).all(), variant.name
        assert (variant.size_lwh < high).all(), variant.name


@pytest.mark.parametrize("name", NUSCENES_CLASSES)
def test_mesh_fills_its_box_exactly(assets: Assets, name: str):
    rng = np.random.default_rng(3)
    for variant in assets.by_class[name]:
        body = draw_body(variant, rng, "one")
        for pose in variant.poses:
            points = pose.fitted(body.size_lwh).faces.reshape(-1, 3)
            low = np.array([-body.size_lwh[0] / 2, -body.size_lwh[1] / 2, 0])
            np.testing.assert_allclose(points.min(0), low, atol=1e-5)
            np.testing.assert_allclose(points.max(0), low + body.size_lwh, atol=1e-5)


@pytest.mark.parametrize("name", NUSCENES_CLASSES)
def test_meshes_have_no_holes_and_no_inverted_faces(assets: Assets, name: str):
    """From every side, the faces that point to the viewer cover the same area as all faces."""
    for variant in assets.by_class[name]:
        for pose in variant.poses:
            faces = pose.fitted(variant.size_lwh / variant.size_lwh.max()).faces
            for view in ((1, 0.3, 0.4), (-0.7, 1, 0.2), (0.2, -1, 1), (-1, -0.4, -0.6)):
                every, towards = _silhouettes(faces, np.array(view))
                assert (every & ~towards).mean() < 2e-4, (variant.name, view)


def _silhouettes(faces, view, size=400):
    """(size, size) bool images seen from direction `view`: of all faces, and of those that point to the viewer."""
    view = view / np.linalg.norm(view)
    right = np.cross((0, 0, 1), view) / np.linalg.norm(np.cross((0, 0, 1), view))
    axes = np.stack([right, np.cross(view, right)], -1)
    flat = faces @ axes
    x, y = flat[..., 0], flat[..., 1]
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
    pixels = np.round((flat - flat.min((0, 1))) * size * 0.55 * 16).astype(np.int32)
    images = [np.zeros((size, size), np.uint8) for _ in range(2)]
    for corners, turned in zip(pixels, area, strict=True):
        for image in images if turned > 0 else images[:1]:
            cv2.fillConvexPoly(image, corners, 1, cv2.LINE_8, 4)
    return images[0] > 0, cv2.dilate(images[1], np.ones((3, 3), np.uint8)) > 0


def test_linear_rgb_of_white_black_and_grey():
    np.testing.assert_allclose(linear((255, 255, 255)), 1.0)
    np.testing.assert_allclose(linear((0, 0, 0)), 0.0)
    assert 0.20 < linear((128, 128, 128))[0] < 0.23
