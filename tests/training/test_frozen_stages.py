"""Frozen stages of a backbone in a training."""

from __future__ import annotations

import pytest
import torch

from bevcli.model.resnet import ResNet, ResNetConfig
from bevcli.workshop.training.clip_steps import FrozenStages
from bevcli.workshop.training.job import ProcessGroup


def made_backbone() -> ResNet:
    torch.manual_seed(3)
    backbone = ResNet(ResNetConfig(blocks=(1, 2, 1, 1), output_stages=(2, 3), width=8))
    for name, values in backbone.named_buffers():
        if "running" in name:
            values.uniform_(0.5, 1.5)
    for parameter in backbone.parameters():
        if parameter.ndim == 1:
            torch.nn.init.uniform_(parameter, 0.5, 1.5)
    return backbone.eval()


def test_frozen_stages_give_the_same_maps_and_gradients() -> None:
    backbone, images = made_backbone(), torch.randn(3, 3, 64, 96)
    backbone.freeze(2)
    frozen = FrozenStages(backbone, 2, torch.float32)
    results = []
    for context in (frozen.used_by(backbone), torch.enable_grad()):
        with context:
            maps = backbone(images)
        backbone.zero_grad()
        maps[-1].square().mean().backward()
        gradients = [parameter.grad for parameter in backbone.parameters() if parameter.grad is not None]
        results.append([*maps, *gradients])
    assert len(results[0]) > 8
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)
    assert backbone.frozen_maps is None


def test_more_frozen_stages_than_the_backbone_has_are_all_of_it() -> None:
    backbone, images = made_backbone(), torch.randn(1, 3, 64, 96)
    with FrozenStages(backbone, 4, torch.float32).used_by(backbone):
        found = backbone(images)
    for one, expected in zip(found, backbone(images), strict=True):
        torch.testing.assert_close(one, expected, rtol=1e-3, atol=1e-4)
        assert not one.requires_grad


def test_several_processes_leave_frozen_parts_without_gradient(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a gradient of zero, weight decay would change them."""
    monkeypatch.setattr("torch.distributed.all_reduce", lambda sums: sums.mul_(2))
    layers = torch.nn.ModuleList(torch.nn.Linear(2, 2) for _ in range(3))
    layers[0].requires_grad_(False)
    layers[1].weight.grad = torch.ones(2, 2)
    ProcessGroup(0, 2).average_gradients(layers)
    assert [parameter.grad for parameter in layers[0].parameters()] == [None, None]
    assert layers[1].weight.grad.equal(torch.ones(2, 2))
    assert not layers[2].weight.grad.any()
