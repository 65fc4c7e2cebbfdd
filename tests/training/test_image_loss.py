"""The loss on the image features: which pixels are positives of an object, and their targets."""

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


def positives(*codes: list[float]):
    return _positive_pixels(IMAGE_FROM_BEV, torch.tensor(codes).reshape(-1, 10), SHAPE, SIZE)


def network_inputs(image_from_bev: torch.Tensor) -> BEVFormerInputs:
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


def test_the_inner_half_of_an_outline_is_positive():
    pixels = positives(code(2, 10))
    # 3 m wide and 2 m high at 10 m: 60 x 40 pixels around (232, 112), its inner half, in feature pixels of 8.
    assert sorted(set(pixels.columns.tolist())) == [27, 28, 29, 30]
    assert sorted(set(pixels.rows.tolist())) == [13, 14]
    assert torch.allclose(pixels.places[:, 0], torch.tensor(10.0).log())
    to_center = pixels.places[:, 1:] + torch.stack([pixels.columns, pixels.rows], 1) + 0.5
    assert torch.allclose(to_center, torch.tensor([29.0, 14.0]))


def test_a_small_object_still_has_a_positive_pixel():
    assert len(positives(code(0, 30, 0.4, 0.4, 1.0)).rows) >= 1


def test_overlapping_pixels_belong_to_the_nearer_object():
    assert set(positives(code(2, 10), code(4, 20)).objects.tolist()) == {0}
    assert set(positives(code(4, 20), code(2, 10)).objects.tolist()) == {1}


@pytest.mark.parametrize("codes", [(), (code(0, -10),), (code(300, 10),)])
def test_objects_outside_the_image_have_no_positives(codes: tuple[list[float], ...]):
    assert not len(positives(*codes).rows)


def test_the_head_can_be_trained_and_each_weight_has_a_gradient():
    head = ImageHead(channels=8, classes=2)
    truth = DetectionTargets(torch.tensor([1]), torch.tensor([code(2, 10)]))
    nothing = DetectionTargets(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 10))
    features = torch.randn(4, 8, *SHAPE)  # two frames of two cameras
    inputs = network_inputs(IMAGE_FROM_BEV.expand(2, 2, 4, 4))
    config = ImageLossConfig(weight=1.0)

    def loss():
        return image_loss(head, features, inputs, (truth, nothing), config, DetectionLossConfig())

    first = loss()
    optimizer = torch.optim.Adam(head.parameters(), lr=0.05)
    for _ in range(30):
        optimizer.zero_grad()
        now = loss()
        (now.classes + now.places).backward()
        optimizer.step()
    assert all(parameter.grad.abs().sum() > 0 for parameter in head.parameters())
    assert now.classes < 0.8 * first.classes
    assert now.places < first.places / 2


def test_frames_without_objects_have_no_place_loss():
    nothing = DetectionTargets(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 10))
    head = ImageHead(channels=8, classes=2)
    features, inputs = torch.randn(1, 8, *SHAPE), network_inputs(IMAGE_FROM_BEV[None, None])
    result = image_loss(head, features, inputs, [nothing], ImageLossConfig(1.0), DetectionLossConfig())
    assert result.places == 0
    assert result.classes.isfinite()
