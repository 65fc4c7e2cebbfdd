"""The loss on the image features: which pixels an object teaches, and what."""

from __future__ import annotations

import math

import pytest
import torch

from bevcli.model.bevformer import BEVFormerInputs
from bevcli.training.detection_loss import DetectionLossConfig
from bevcli.training.detection_targets import DetectionTargets
from bevcli.training.image_loss import ImageHead, ImageLossConfig, _positive_pixels, image_loss

SIZE, SHAPE = (224, 384), (28, 48)  # an image, and its features at stride 8
INTRINSICS = torch.tensor([[200.0, 0, 192, 0], [0, 200, 112, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
CAMERA_FROM_BEV = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 1.5], [0, 1, 0, 0], [0, 0, 0, 1]])  # ahead is +y
IMAGE_FROM_BEV = INTRINSICS @ CAMERA_FROM_BEV


def code(x: float, y: float, width: float = 2.0, length: float = 4.0, height: float = 2.0) -> list[float]:
    return [x, y, math.log(width), math.log(length), 1.5, math.log(height), 0, 1, 0, 0]


def taught(*codes: list[float]):
    return _positive_pixels(IMAGE_FROM_BEV, torch.tensor(codes).reshape(-1, 10), SHAPE, SIZE)


def seen(image_from_bev: torch.Tensor) -> BEVFormerInputs:
    frames, cameras = image_from_bev.shape[:2]
    return BEVFormerInputs(
        images=torch.zeros(frames, cameras, 3, *SIZE),
        image_from_bev=image_from_bev,
        camera_index=torch.arange(cameras),
        has_image=torch.ones(frames, cameras, dtype=torch.bool),
        can_bus=torch.zeros(frames, 18),
        shift=torch.zeros(frames, 2),
        rotation_deg=torch.zeros(frames),
    )


def test_an_object_teaches_the_inner_half_of_its_outline():
    pixels = taught(code(2, 10))
    # 3 m wide and 2 m high at 10 m: 60 x 40 pixels around (232, 112), of which the inner half, in cells of 8.
    assert sorted(set(pixels.columns.tolist())) == [27, 28, 29, 30]
    assert sorted(set(pixels.rows.tolist())) == [13, 14]
    assert torch.allclose(pixels.places[:, 0], torch.tensor(10.0).log())
    to_center = pixels.places[:, 1:] + torch.stack([pixels.columns, pixels.rows], 1) + 0.5
    assert torch.allclose(to_center, torch.tensor([29.0, 14.0]))


def test_a_small_object_still_teaches_a_pixel():
    assert len(taught(code(0, 30, 0.4, 0.4, 1.0)).rows) >= 1


def test_the_nearer_of_two_objects_teaches():
    assert set(taught(code(2, 10), code(4, 20)).objects.tolist()) == {0}
    assert set(taught(code(4, 20), code(2, 10)).objects.tolist()) == {1}


@pytest.mark.parametrize("codes", [(), (code(0, -10),), (code(300, 10),)])
def test_nothing_in_the_image_teaches_nothing(codes: tuple[list[float], ...]):
    assert not len(taught(*codes).rows)


def test_what_is_said_rightly_costs_little_and_every_weight_learns():
    reader = ImageHead(channels=8, classes=2)
    truth = DetectionTargets(torch.tensor([1]), torch.tensor([code(2, 10)]))
    nothing = DetectionTargets(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 10))
    features = torch.randn(4, 8, *SHAPE)  # two frames of two cameras
    inputs = seen(IMAGE_FROM_BEV.expand(2, 2, 4, 4))
    config = ImageLossConfig(weight=1.0)

    def loss():
        return image_loss(reader, features, inputs, (truth, nothing), config, DetectionLossConfig())

    first = loss()
    optimizer = torch.optim.Adam(reader.parameters(), lr=0.05)
    for _ in range(30):
        optimizer.zero_grad()
        now = loss()
        (now.classes + now.places).backward()
        optimizer.step()
    assert all(parameter.grad.abs().sum() > 0 for parameter in reader.parameters())
    assert now.classes < 0.8 * first.classes
    assert now.places < first.places / 2


def test_frames_without_objects_cost_no_place():
    nothing = DetectionTargets(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 10))
    reader = ImageHead(channels=8, classes=2)
    features, inputs = torch.randn(1, 8, *SHAPE), seen(IMAGE_FROM_BEV[None, None])
    result = image_loss(reader, features, inputs, [nothing], ImageLossConfig(1.0), DetectionLossConfig())
    assert result.places == 0
    assert result.classes.isfinite()
