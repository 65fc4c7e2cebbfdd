"""The perspective loss: what it learns, what it ignores, and that it trains the image backbone."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from one_image import targets_of_image
from painted_drives import CONFIG, PaintedDrives, batch_of

from bevcli.config import TRAINING, load_table
from bevcli.errors import ConfigError
from bevcli.model.bevformer import BEVFormer
from bevcli.model.fpn import FPNConfig
from bevcli.model.image_tokens import ImageTokensConfig
from bevcli.model.resnet import ResNetConfig
from bevcli.workshop.training.frame_losses import (
    FrameLosses,
    PerspectiveHead,
    PerspectiveLossConfig,
    feature_locations,
    perspective_loss,
)
from bevcli.workshop.training.job import TrainingConfig
from bevcli.workshop.training.samples import Batch, Clip
from bevcli.workshop.training.targets import DetectionTargets

WEIGHTS = PerspectiveLossConfig(weight=1.0)
NOTHING = DetectionTargets(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 10))
# Two levels, of strides 8 and 16.
TWO_LEVELS = replace(
    CONFIG,
    backbone=ResNetConfig((1, 1, 1, 1), width=8, output_stages=(2, 3)),
    neck=FPNConfig(2),
    image_tokens=ImageTokensConfig(level_embeddings=2),
    heads=("detection",),
)


def batch(frames: int = 2) -> Batch:
    """The second frame of painted drives."""
    clips = [Clip(drive, (1,)) for drive in range(frames)]
    return batch_of(PaintedDrives(frames), clips, TWO_LEVELS)


def make_head(layers: int = 1) -> PerspectiveHead:
    torch.manual_seed(0)
    return PerspectiveHead(TWO_LEVELS.channels, len(TWO_LEVELS.classes), layers)


def loss_of(
    head: PerspectiveHead,
    maps: list[torch.Tensor],
    data: Batch,
    config: PerspectiveLossConfig = WEIGHTS,
    *,
    has_image: torch.Tensor | None = None,
    targets: tuple[DetectionTargets, ...] | None = None,
) -> dict[str, torch.Tensor]:
    inputs = data.inputs[0]
    truth = data.targets[0].perspective if targets is None else targets
    seen = inputs.has_image if has_image is None else has_image
    return perspective_loss(head, maps, inputs.image_from_bev, seen, inputs.image_size, truth, config)


def random_maps(images: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return [torch.randn(images, 32, rows, columns, generator=generator) for rows, columns in ((12, 16), (6, 8))]


@pytest.mark.slow
def test_backbone_and_head_learn_the_depths_of_boxes() -> None:
    data, head = batch(), make_head()
    torch.manual_seed(0)
    model = BEVFormer(TWO_LEVELS)
    inputs = data.inputs[0]
    trained = [*model.backbone.parameters(), *model.neck.parameters(), *head.parameters()]
    optimizer = torch.optim.Adam(trained, lr=3e-3)
    images = inputs.images.flatten(0, 1)
    totals = []
    for _ in range(200):
        maps = model.neck(model.backbone(images))
        loss = loss_of(head, maps, data)
        optimizer.zero_grad()
        sum(loss.values()).backward()
        optimizer.step()
        totals.append(sum(loss.values()).item())
    assert totals[-1] < totals[0] / 10

    logits, boxes = head(maps)
    locations = feature_locations(
        tuple((m.shape[-2], m.shape[-1]) for m in maps), inputs.image_size, torch.device("cpu")
    )
    errors = []
    for image, matrix in enumerate(inputs.image_from_bev.flatten(0, 1)):
        truth = data.targets[0].perspective[image // 2]
        expected = targets_of_image(matrix, truth, locations, inputs.image_size)
        errors.append((boxes[image, expected.locations, 2] - expected.boxes[:, 2]).exp() - 1)
        assert torch.equal(logits[image, expected.locations].argmax(-1), expected.labels)
    relative = torch.cat(errors).abs()
    assert len(relative) > 20
    assert relative.max() < 0.2
    assert relative.mean() < 0.05


def test_the_backbone_receives_a_gradient_that_is_not_zero() -> None:
    """Through the hook that a training uses, with the loss of the BEV path left out."""
    torch.manual_seed(0)
    data, model = batch(), BEVFormer(TWO_LEVELS)
    losses = FrameLosses(model, TrainingConfig(perspective_loss=WEIGHTS))
    with losses.watching(model):
        outputs = model(data.inputs[0])
        named = losses(data.inputs[0], outputs, data.targets[0])
    (named["perspective classes"] + named["perspective boxes"]).backward()
    for module in (model.neck, losses.auxiliary_heads["perspective_head"], model.backbone.conv1, model.backbone.stages):
        gradients = [parameter.grad for parameter in module.parameters()]
        assert any(gradient is not None and gradient.any() for gradient in gradients)
    assert model.backbone.conv1.weight.grad.any()
    assert all(parameter.grad is None for parameter in model.encoder.parameters())


def test_every_parameter_of_the_head_receives_a_gradient() -> None:
    data, head = batch(), make_head(layers=2)
    loss = loss_of(head, random_maps(4), data)
    sum(loss.values()).backward()
    assert all(parameter.grad.any() for parameter in head.parameters())


def test_images_without_boxes_have_no_box_loss() -> None:
    data, head = batch(), make_head()
    loss = loss_of(head, random_maps(4), data, targets=(NOTHING, NOTHING))
    assert loss["perspective boxes"] == 0
    assert loss["perspective classes"] > 0
    loss["perspective boxes"].backward()
    assert not any(parameter.grad is not None and parameter.grad.any() for parameter in head.parameters())


def test_a_camera_without_an_image_contributes_nothing() -> None:
    data, head, maps = batch(), make_head(), random_maps(4)
    first_only = torch.tensor([[True, False], [False, False]])
    loss = loss_of(head, maps, data, has_image=first_only)
    changed = [features.clone() for features in maps]
    for features in changed:
        features[1:] += 7
    assert loss_of(head, changed, data, has_image=first_only) == loss
    assert loss_of(head, changed, data) != loss_of(head, maps, data)
    none = loss_of(head, maps, data, has_image=torch.zeros(2, 2, dtype=torch.bool))
    assert (none["perspective classes"], none["perspective boxes"]) == (0, 0)


def test_ignored_pixels_have_no_class_loss() -> None:
    """A truck beside a camera: its pixels may have any class logits."""
    data, head = batch(1), make_head(layers=0)
    matrix = data.inputs[0].image_from_bev[0, 0]
    truck = DetectionTargets(torch.tensor([0]), torch.tensor([[2.5, -1, 1.1, 2.5, 0, 1.1, 0, -1, 0, 0]]))
    locations = feature_locations(((12, 16), (6, 8)), data.inputs[0].image_size, torch.device("cpu"))
    ignored = targets_of_image(matrix, truck, locations, data.inputs[0].image_size).ignored
    assert 0 < ignored.sum() < len(ignored)
    maps = random_maps(2)
    only_front = torch.tensor([[True, False]])

    def head_with_high_logits(pixels: torch.Tensor) -> torch.Tensor:
        def high(features: list[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
            logits, boxes = head(features)
            return torch.where(pixels[:, None], 9.0, logits), boxes

        return loss_of(high, maps, data, has_image=only_front, targets=(truck,))["perspective classes"]

    nowhere = torch.zeros_like(ignored)
    assert head_with_high_logits(ignored) == head_with_high_logits(nowhere)
    assert head_with_high_logits(~ignored) > head_with_high_logits(nowhere)


def test_a_batch_has_its_frames_mean_loss_by_positive_pixel() -> None:
    both, head, maps = batch(2), make_head(), random_maps(4)
    whole = loss_of(head, maps, both)
    inputs = both.inputs[0]
    locations = feature_locations(((12, 16), (6, 8)), inputs.image_size, torch.device("cpu"))
    total, count = 0.0, 0
    for frame in range(2):
        truth = both.targets[0].perspective[frame]
        part = perspective_loss(
            head, [features[2 * frame : 2 * frame + 2] for features in maps], inputs.image_from_bev[[frame]],
            inputs.has_image[[frame]], inputs.image_size, [truth], WEIGHTS,
        )  # fmt: skip
        positives = sum(
            len(targets_of_image(matrix, truth, locations, inputs.image_size).locations)
            for matrix in inputs.image_from_bev[frame]
        )
        total, count = total + positives * sum(part.values()).item(), count + positives
    assert sum(whole.values()).item() == pytest.approx(total / count, rel=1e-4)


def test_each_weight_scales_its_part() -> None:
    data, head, maps = batch(), make_head(), random_maps(4)
    full = loss_of(head, maps, data, replace(WEIGHTS, weight=3.0))
    once = loss_of(head, maps, data)
    torch.testing.assert_close(full["perspective classes"], 3 * once["perspective classes"])
    torch.testing.assert_close(full["perspective boxes"], 3 * once["perspective boxes"])
    names = ("offset_weight", "depth_weight", "size_weight", "rotation_weight")
    no_boxes = dict.fromkeys(names, 0.0)
    parts = [
        loss_of(head, maps, data, replace(WEIGHTS, **no_boxes | {n: getattr(WEIGHTS, n)}))["perspective boxes"]
        for n in names
    ]
    assert all(part > 0 for part in parts)
    torch.testing.assert_close(sum(parts), once["perspective boxes"])


def test_boxes_outside_the_grid_are_detected_too() -> None:
    """The grid ends at 16 m; the camera sees further."""
    config = replace(TWO_LEVELS, bev_grid=replace(TWO_LEVELS.bev_grid, y_range_m=(-6, 6)))
    data = batch_of(PaintedDrives(1), [Clip(0, (1,))], config)
    targets = data.targets[0]
    assert len(targets.detection[0].labels) < len(targets.perspective[0].labels) == 5


def test_a_negative_weight_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_text("[training.perspective_loss]\ndepth_weight = -1.0\n")
    with pytest.raises(ConfigError, match=r'perspective_loss.depth_weight" must be a number of 0 or more, but is -1.0'):
        load_table(tmp_path / "wrong.toml", TRAINING, TrainingConfig)
