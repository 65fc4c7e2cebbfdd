"""Pillars in the cameras, compared with OpenCV's projection; and the list of hits."""

from __future__ import annotations

import cv2
import numpy as np
import original_reference as original
import torch

from bevcli.config import load_config
from bevcli.model.pillar_projection import PillarProjection, find_hits, project_pillars

SIZE = (480, 800)


def project(image_from_bev: np.ndarray, points: np.ndarray, image: bool = True) -> PillarProjection:
    """One camera, one sequence; points (cells, Z, 3)."""
    matrix = torch.from_numpy(image_from_bev).float()[None, None]
    return project_pillars(matrix, torch.from_numpy(points).float(), SIZE, torch.tensor([[image]]))


def test_pillars_of_a_real_rig_are_projected_as_by_opencv() -> None:
    config = load_config("tiny")
    pillars = config.bev_grid.pillars().reshape(-1, 4, 3)
    ours = project_pillars(
        torch.from_numpy(original.image_from_bev(0, config)).float()[None],
        torch.from_numpy(pillars).float(),
        SIZE,
        torch.ones(1, 6, dtype=torch.bool),
    )
    for i, name in enumerate(config.cameras):
        camera = original.frames()[0]["cams"][name]
        camera_from_bev = np.array(camera["sensor2lidar_rotation"]).T
        translation = -camera_from_bev @ np.array(camera["sensor2lidar_translation"])
        intrinsics = np.diag([0.5, 0.5, 1]) @ np.array(camera["cam_intrinsic"])
        pixels, _ = cv2.projectPoints(
            pillars.reshape(-1, 3), cv2.Rodrigues(camera_from_bev)[0], translation, intrinsics, None
        )
        depth = (pillars @ camera_from_bev.T + translation)[..., 2]
        pixels = pixels.reshape(-1, 4, 2)
        in_image = ((pixels > 0) & (pixels < (800, 480))).all(-1) & (depth > 0)
        visible = ours.visible[0, i].numpy()
        assert (visible != in_image).sum() <= 2  # points on the edge of an image
        both = visible & in_image
        np.testing.assert_allclose(ours.reference_points[0, i].numpy()[both] * (800, 480), pixels[both], atol=0.01)


def test_a_point_behind_the_camera_is_not_visible() -> None:
    image_from_bev = np.array([[400, 0, 400, 0], [0, 400, 240, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    points = np.array([[[0, 0, 5.0]], [[0, 0, -5.0]], [[0, 0, 0.0]]])
    assert project(image_from_bev, points).visible.flatten().tolist() == [True, False, False]


def test_a_point_on_the_edge_of_the_image_is_not_visible() -> None:
    image_from_bev = np.array([[400, 0, 0, 0], [0, 240, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    points = np.array([[[0, 1, 1.0]], [[2, 1, 1.0]], [[1, 2, 1.0]], [[1.999, 1.999, 1.0]]])
    assert project(image_from_bev, points).visible.flatten().tolist() == [False, False, False, True]


def test_a_cell_is_hit_when_any_point_of_its_pillar_is_visible() -> None:
    image_from_bev = np.array([[400, 0, 400, 0], [0, 400, 240, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    points = np.array([[[0, 0, 5.0], [90, 0, 5.0]], [[90, 0, 5.0], [0, 0, -5.0]]])
    assert project(image_from_bev, points).hit.flatten().tolist() == [True, False]
    assert not project(image_from_bev, points, image=False).hit.any()


def test_hits_list_every_visible_pair_of_camera_and_cell_once() -> None:
    visible = torch.zeros(2, 3, 4, 2, dtype=torch.bool)
    for batch, camera, cell in ((0, 0, 1), (0, 2, 1), (0, 2, 3), (1, 1, 0)):
        visible[batch, camera, cell, 1] = True
    reference_points = torch.rand(2, 3, 4, 2, 2)
    hits = find_hits(PillarProjection(reference_points, visible))
    assert hits.cell.tolist() == [1, 1, 3, 4]
    assert hits.hits_per_camera == (1, 0, 2, 0, 1, 0)
    assert hits.cameras_per_cell.tolist() == [0, 2, 0, 1, 1, 0, 0, 0]
    assert torch.equal(hits.reference_points[2], reference_points[0, 2, 3])
