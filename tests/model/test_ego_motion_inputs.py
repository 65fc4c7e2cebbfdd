"""The ego-motion inputs (can-bus numbers, shift, rotation) and the embedding of viewing rays by hand."""

import copy
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from memory_drive import make_camera, make_rig
from small_model import HEIGHT, WIDTH, small_config, small_inputs, small_model

from bevcli.checkpoints import compare
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.cameras import default_ego_from_bev
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Pose, apply, inverse
from bevcli.model.bevformer import BEVFormer
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.ego_motion import EgoMotionConfig, EgoMotionInputs, ego_motion_inputs, rotate_history
from bevcli.model.image_tokens import CalibrationEmbedding, ImageTokensConfig, ray_features
from bevcli.model.kernels.choose import KeptCalibrationEmbedding, change_classes
from bevcli.workshop.training.warm_start import warm_start

GRID = BevGrid(50, 40, x_range_m=(-40, 40), y_range_m=(-50, 50))


def pose(x: float, y: float, yaw_deg: float, sign: float = 1.0) -> Pose:
    half = np.radians(yaw_deg) / 2
    return Pose(np.array([x, y, 0.5]), sign * np.array([np.cos(half), 0, 0, np.sin(half)]))


def inputs_for(now: Pose, before: Pose | None, **settings: object) -> EgoMotionInputs:
    config = EgoMotionConfig(**settings)  # type: ignore[arg-type]
    return ego_motion_inputs(now, before, Kinematics((1, 2, 9.8), (0.1, 0.2, 0.3), (7, 0, 0)), GRID, config)


def test_the_first_frame_of_a_scene_has_no_motion() -> None:
    inputs = inputs_for(pose(411, 1180, 351.5), None)
    assert inputs.rotation_deg == 0
    np.testing.assert_array_equal(inputs.shift, 0)
    np.testing.assert_array_equal(inputs.can_bus[:3], 0)
    assert inputs.can_bus[17] == 0
    assert inputs.can_bus[16] == pytest.approx(np.radians(351.5))


def test_the_change_of_heading_is_not_wrapped() -> None:
    assert inputs_for(pose(0, 0, 4), pose(0, 0, 358)).rotation_deg == pytest.approx(-354)


def test_the_whole_quaternion_is_an_option() -> None:
    now = pose(0, 0, 50)
    np.testing.assert_allclose(inputs_for(now, None, can_bus_quaternion="wxyz").can_bus[3:7], now.quaternion, rtol=1e-6)


def test_shift_and_rotation_can_be_turned_off() -> None:
    inputs = inputs_for(pose(5, 5, 20), pose(0, 0, 0), shift=False, rotation=False)
    np.testing.assert_array_equal(inputs.shift, 0)
    assert inputs.rotation_deg == 0


SQUARE = BevGrid(6, 6)


def turn(history: np.ndarray, degrees: float, center: object = "center", grid: BevGrid = SQUARE) -> np.ndarray:
    """history: (Y, X, C) -> (Y, X, C)."""
    flat = torch.from_numpy(history).flatten(0, 1)[None]
    return rotate_history(flat, torch.tensor([degrees]), grid, center)[0].numpy().reshape(history.shape)  # type: ignore[arg-type]


def random_map(rows: int, columns: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(rows, columns, 3))


@pytest.mark.parametrize("quarters", [0, 1, 2, 3, -1])
def test_quarter_turns_are_those_of_numpy(quarters: int) -> None:
    history = random_map(6, 6)
    # Row indices grow ahead of the vehicle, so that its left turn is a rotation in numpy's direction.
    np.testing.assert_array_equal(turn(history, 90.0 * quarters), np.rot90(history, quarters))


def test_a_cell_ahead_is_on_the_right_after_a_left_turn() -> None:
    grid = BevGrid(51, 51)
    history = np.zeros((51, 51, 1))
    history[45, 25] = 1  # twenty cells ahead
    row, column = np.argwhere(turn(history, 30.0, grid=grid)[..., 0])[0]
    assert (row - 25, column - 25) == (round(20 * np.cos(np.pi / 6)), round(20 * np.sin(np.pi / 6)))


def test_the_original_centre_is_cell_100_at_every_grid_size() -> None:
    history = np.random.default_rng(1).normal(size=(50, 50, 1))
    small = BevGrid(50, 50)
    np.testing.assert_array_equal(turn(history, 5.0, "original", small), turn(history, 5.0, (100.0, 100.0), small))
    assert not np.array_equal(turn(history, 5.0, "original", small), turn(history, 5.0, "center", small))
    large = BevGrid(200, 200)
    history = np.random.default_rng(1).normal(size=(200, 200, 1))
    np.testing.assert_array_equal(turn(history, 5.0, "original", large), turn(history, 5.0, "center", large))


WITH_RAYS = ImageTokensConfig(level_embeddings=3, calibration_embedding=True)


def test_rays_lie_on_the_lines_through_camera_and_pixels():
    camera = make_camera("CAM", yaw_deg=30.0, width=WIDTH, height=HEIGHT)
    bev_from_camera = inverse(default_ego_from_bev()) @ camera.ego_from_camera
    image_from_bev = camera.image_from_camera @ inverse(bev_from_camera)
    features = ray_features(torch.tensor(image_from_bev, dtype=torch.float32)[None], ((4, 6),), (HEIGHT, WIDTH), 1.84)
    assert features.shape == (1, 24, 9)
    row, column = 3, 1  # a cell below the horizon
    found = features[0, row * 6 + column].numpy()
    pixel = np.array([(column + 0.5) * WIDTH / 6, (row + 0.5) * HEIGHT / 4])
    direction, position = found[:3], found[3:6] * 2.0
    point = position + 7.0 * direction  # some point on the ray
    seen, _ = camera.project(apply(inverse(bev_from_camera), point))
    assert seen == pytest.approx(pixel, abs=0.05)
    assert position == pytest.approx(bev_from_camera[:3, 3], abs=1e-4)
    # The depth of the ground: a point on the ray that far in front of the camera has the height of the ground.
    depth = 1 / found[7]
    in_camera = depth * np.linalg.inv(camera.intrinsics) @ [*pixel, 1]
    assert apply(camera.ego_from_camera, in_camera)[2] == pytest.approx(0.0, abs=1e-3)
    assert np.exp(found[6]) * 32 == pytest.approx(camera.intrinsics[0, 0] * 6 / WIDTH, rel=1e-4)


def test_an_untrained_embedding_changes_nothing():
    plain = small_model()
    with_rays = BEVFormer(small_config(image_tokens=WITH_RAYS)).eval()
    missing = with_rays.load_state_dict(plain.state_dict(), strict=False).missing_keys
    assert missing
    assert all(key.startswith("calibration_embedding.") for key in missing)
    inputs = small_inputs()
    with torch.no_grad():
        assert torch.equal(with_rays(inputs).bev, plain(inputs).bev)


def test_weights_without_the_embedding_start_a_training_only(tmp_path: Path):
    path = tmp_path / "weights.safetensors"
    safetensors.torch.save_file(small_model().state_dict(), path)
    model = BEVFormer(small_config(image_tokens=WITH_RAYS))
    missing = compare(small_model().state_dict(), model.state_dict())["missing"]
    assert len(missing) == 6
    warm_start(path, model, "small", make_rig)
    assert not model.calibration_embedding.layers[-1].weight.any()


def test_each_sequence_of_a_batch_may_have_its_own_embeddings():
    model, inputs = small_model(), small_inputs(batch=2)
    one, other = torch.tensor([0, 1]), torch.tensor([1, 0])
    with torch.no_grad():
        both = model.image_features(inputs.images, torch.stack([one, other])).tokens
        first = model.image_features(inputs.images[:1], one).tokens
        second = model.image_features(inputs.images[1:], other).tokens
    torch.testing.assert_close(both, torch.cat([first, second]))


def test_a_prepared_embedding_follows_rig_and_image_size():
    torch.manual_seed(0)
    embedding = CalibrationEmbedding(8, 1.84).requires_grad_(False)
    torch.nn.init.normal_(embedding.layers[-1].weight, std=0.1)
    prepared = copy.deepcopy(embedding)
    change_classes(prepared, {CalibrationEmbedding: KeptCalibrationEmbedding})
    rig = small_inputs().image_from_bev
    moved = rig.clone()
    moved[:, 0, 0, 3] += 5.0
    for image_from_bev, size in (
        (rig, (64, 96)),
        (rig, (64, 96)),
        (moved, (64, 96)),
        (moved, (96, 64)),
        (rig, (64, 96)),
    ):
        rows, columns = size[0] // 16, size[1] // 16
        tokens = torch.randn(rig.shape[1], rows * columns, 8)
        features = FeatureMaps(tokens, ((rows, columns),))
        rays = image_from_bev, features.level_shapes, size
        assert torch.equal(features.scaled(*prepared(*rays)).tokens, features.scaled(*embedding(*rays)).tokens)
