"""A BEVFormer on the backbone of docs/extend.md, which no other file knows: prepared, it computes the same."""

from __future__ import annotations

import re
import sys
import types
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from small_model import small_config, small_inputs
from torch import nn

from bevcli.model import parts
from bevcli.model.kernels.onednn import PackedConvolution, has_onednn
from bevcli.model.network import Network
from bevcli.model.prepare import prepare_for_inference

PAGE = (Path(__file__).parents[2] / "docs/extend.md").read_text()


@pytest.fixture(scope="module")
def page() -> types.ModuleType:
    [code] = re.findall(r"^`bevcli_ground/backbone.py`:\n\n```python\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)
    module = sys.modules["page"] = types.ModuleType("page")
    exec(code, vars(module))
    return module


@pytest.fixture(scope="module")
def model(page) -> Network:
    torch.manual_seed(0)
    settings = {field.name: getattr(small_config(), field.name) for field in fields(small_config())}
    config = page.OwnBackboneBEVFormerConfig(**settings | {"backbone": page.OwnBackboneConfig()})
    model = page.OwnBackboneBEVFormer(config).eval()
    with torch.no_grad():
        for module in model.modules():
            if isinstance(module, nn.BatchNorm2d):
                for tensor in (module.weight, module.bias, module.running_mean):
                    nn.init.normal_(tensor)
                nn.init.uniform_(module.running_var, 0.5, 2)
    return model


@pytest.mark.parametrize(("precision", "tolerance"), [("fp32", 1e-5), ("bf16", 0.03)])
def test_a_prepared_model_equals_the_plain_one(model, precision, tolerance):
    inputs, prepared = small_inputs(), prepare_for_inference(model, torch.device("cpu"), precision)
    with torch.inference_mode():
        history = model(inputs).bev
        for found, expected in zip(prepared.backbone(inputs.images[0]), model.backbone(inputs.images[0]), strict=True):
            assert (found.float() - expected).norm() < tolerance * expected.norm()
        found, expected = prepared(inputs, history), model(inputs, history)
    assert (found.bev - expected.bev).norm() < tolerance * expected.bev.norm()
    torch.testing.assert_close(found.box_codes, expected.box_codes, atol=10 * tolerance, rtol=10 * tolerance)


def test_only_what_is_certain_is_folded_and_packed(model):
    backbone = prepare_for_inference(model, torch.device("cpu")).backbone
    stage = backbone.stages[1]
    assert [type(part) for part in (backbone.norm, stage[2].norm)] == [type(model.backbone.norm), nn.BatchNorm2d]
    assert isinstance(stage[1], nn.Identity)
    assert type(stage[2].conv0) is nn.Conv2d  # padding by name, which oneDNN does not take
    assert isinstance(stage[2].expand, PackedConvolution) == has_onednn(torch.float32)


def test_its_stages_can_be_frozen_and_have_names(page, model, monkeypatch):
    backbone = page.OwnBackboneConfig().build()
    backbone.freeze(1)
    learned = {name.split(".")[0] for name, parameter in backbone.named_parameters() if parameter.requires_grad}
    assert learned == {"stages"}
    assert not backbone.train().norm.training
    monkeypatch.setattr(parts, "build_model", lambda config: page.OwnBackboneBEVFormer(config))
    names = [part.name for part in parts.model_parts(model.config)]
    assert names[:4] == ["backbone: stem", *(f"backbone: stage {stage}, stage {stage}" for stage in (1, 2, 3))]
