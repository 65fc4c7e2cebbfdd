"""The slopes of the road by what the images show around the horizon."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.model.small_model import small_inputs, small_model

import bevcli
from bevcli.inference.preprocess import Preprocessor
from bevcli.model.horizon import COLUMNS, FOLD, ROWS, STEP_DEG, Horizon
from bevcli.model.road_slopes import RoadSlopes, levelled

SIZE = 120, 200  # height and width


def looking(yaw_deg: float, pitch_deg: float = 0.0) -> np.ndarray:
    """(4, 4) image_from_bev of a camera of 90 degrees; x forward, y left, z up."""
    axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # of a camera that looks along x
    turn = axes @ Rotation.from_euler("zy", [yaw_deg, pitch_deg], degrees=True).as_matrix().T
    matrix, (height, width) = np.eye(4), SIZE
    matrix[:3, :3] = np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]]) @ turn
    return matrix


def test_the_ring_shows_each_direction_where_a_camera_looks():
    """Three cameras, one of them pitched, whose images show the height of each pixel's ray; none looks back."""
    cameras = [looking(0), looking(90, 8), looking(-90)]
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    pixels = np.stack([columns, rows, np.ones(SIZE)], -1).astype(float)
    images = []
    for camera in cameras:
        rays = pixels @ np.linalg.inv(camera[:3, :3]).T
        heights = np.degrees(np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1])))
        images.append(np.broadcast_to(heights + 100, (3, *SIZE)))
    rig = torch.from_numpy(np.stack(cameras)).float()[None]
    ring, seen = Horizon().view(torch.from_numpy(np.stack(images)).float()[None], rig)
    expected = 100 + STEP_DEG * ((ROWS - 1) / 2 - torch.arange(ROWS))
    np.testing.assert_allclose(
        ring.where(seen > 0, expected[:, None])[0], expected[:, None].expand_as(ring[0]), atol=0.1
    )
    quarter = COLUMNS // 4
    assert seen[0, :, : quarter // 2 - 8].sum() == 0
    assert seen[0, ROWS // 2, quarter // 2 + 8 : -quarter // 2 - 8].mean() > 0.97  # but for the edges of images


def test_the_slopes_fit_what_all_directions_tell():
    horizon, slopes = Horizon(), torch.tensor([[0.02, -0.01], [0.0, 0.015]])
    rises = (slopes[:, None, None] * horizon.told).sum(-1)
    told = horizon.slopes(rises, torch.full_like(rises, -4.0))
    np.testing.assert_allclose(told.mean, slopes, atol=2e-4)
    unseen = horizon.slopes(rises, torch.full_like(rises, torch.inf))
    np.testing.assert_allclose(unseen.mean, 0, atol=1e-7)
    assert told.covariance[0, 0, 0] < 0.01 * unseen.covariance[0, 0, 0]
    assert rises.shape[-1] == COLUMNS // FOLD


def test_a_level_rig_sees_the_road_level():
    """A point of the road lies at the same pixel, by the rig as it is and, level, by the one that is levelled."""
    rig, slopes = torch.from_numpy(looking(30))[None, None], torch.tensor([[0.03, -0.02]], dtype=torch.float64)
    told = RoadSlopes(slopes.float(), 1e-9 * torch.eye(2)[None])
    level = levelled(rig.float(), told, 1.5).double()
    unsure = RoadSlopes(told.mean, torch.eye(2)[None])
    np.testing.assert_array_equal(levelled(rig.float(), unsure, 1.5), rig.float())
    (x, y), (along_x, along_y) = (10.0, 4.0), slopes[0].tolist()
    pixel = rig[0, 0] @ torch.tensor([x, y, along_x * x + along_y * y - 1.5, 1.0], dtype=torch.float64)
    point = torch.linalg.solve(level[0, 0], torch.cat([pixel[:3], torch.ones(1)]))
    assert point[2].item() == pytest.approx(-1.5, abs=1e-3)
    assert point[:2].tolist() == pytest.approx([x, y], abs=0.02)


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(0.0, 0.0), (1.5, -1.0), (-1.0, 0.8)])
def test_demo_sees_by_how_much_its_vehicle_is_tilted(pitch_deg, roll_deg):
    """The rig states cameras as if the vehicle stood level; in one that is turned the other way they see the same."""
    model, drive = bevcli.load_model("demo"), bevcli.open_sequence("samples/street")
    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_euler("yx", [pitch_deg, roll_deg], degrees=True).as_matrix()
    errors = []
    for index in (2, 9):
        frame = drive.load(index)
        cameras = [replace(x, ego_from_camera=tilt @ x.ego_from_camera) for x in frame.rig.cameras]
        prepared = Preprocessor(model.config, threads=1)(replace(frame, rig=replace(frame.rig, cameras=tuple(cameras))))
        found = model.network.find_slopes(prepared.images, prepared.image_from_bev.float()).mean[0].numpy()
        normal = prepared.frame.rig.ego_from_bev[:3, :3].T @ tilt[:3, :3] @ [0.0, 0.0, 1.0]
        errors.append(np.degrees(found + normal[:2] / normal[2]))
    assert np.abs(errors).mean() < 0.3


def test_a_model_is_levelled_in_batches_as_alone():
    """And a training leaves the horizon as it is."""
    model, inputs = small_model(horizon=True), small_inputs(batch=2)
    model.horizon.network[-1].bias.data[:] = torch.tensor([0.5, -2.0, 0.0, -2.0])
    looked = model.look(inputs.images, inputs.has_image, inputs.image_from_bev, inputs.image_sizes)
    boxes, level, slopes, expected = looked
    assert boxes is None
    assert slopes is None
    assert expected is None
    assert not torch.allclose(level, inputs.image_from_bev, atol=1e-3)
    for index in range(2):
        parts = (x[index : index + 1] for x in (inputs.images, inputs.has_image, inputs.image_from_bev))
        np.testing.assert_allclose(model.look(*parts, inputs.image_sizes[:1])[1][0], level[index], atol=1e-4)
    assert not any(parameter.requires_grad for parameter in model.horizon.parameters())
