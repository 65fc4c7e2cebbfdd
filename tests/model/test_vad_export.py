"""The exported form of a VAD: ONNX Runtime computes what the model computes, over frames with history."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from memory_drive import MemorySequence

from bevcli.benchmark.exported import FrameDifference, check_exported, difference_lines
from bevcli.engines.export_onnx import export_onnx
from bevcli.engines.exported import load_exported
from bevcli.inference.load import Model
from bevcli.inference.run import run
from bevcli.model.config import ModelConfig
from bevcli.model.vad.config import VADConfig
from bevcli.model.vad.line_decoder import LineDecoderConfig
from bevcli.model.vad.motion_head import MotionConfig
from bevcli.model.vad.vad import VAD

pytest.importorskip("onnxruntime")


@pytest.fixture(scope="module")
def model(mini_config: ModelConfig) -> VAD:
    """Random weights with which some lines score above the threshold, so that objects attend to them."""
    settings = {field.name: getattr(mini_config, field.name) for field in fields(mini_config)}
    lines = LineDecoderConfig(lines=8, line_points=5, layers=1, attention_heads=4, feed_forward_width=32, max_lines=6)
    motion = MotionConfig(modes=2, steps=3, attention_heads=4, feed_forward_width=32, max_line_distance=0.4)
    torch.manual_seed(0)
    model = VAD(VADConfig(**settings | {"name": "mini-vad"}, line_decoder=lines, motion=motion)).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
        model.line_decoder.class_branches[-1][-1].bias.zero_()
    return model


@pytest.mark.slow
def test_an_exported_vad_equals_the_model(model: VAD, tmp_path: Path) -> None:
    file = tmp_path / "vad.onnx"
    export_onnx(model, file)
    exported = load_exported(file, "onnxruntime")
    drive = MemorySequence(3)
    *_, last = check_exported(file, Model(model), drive)
    assert last.further.keys() == {
        "line_class_logits", "line_points", "future_offsets", "mode_logits", "plan_offsets"
    }  # fmt: skip
    assert max(last.further.values()) < 1e-3
    for (_, ours), (_, theirs) in zip(
        run(Model(model), drive), run(Model(exported, engine="onnxruntime"), drive), strict=True
    ):
        np.testing.assert_allclose(theirs.boxes.scores, ours.boxes.scores, atol=1e-4)
        np.testing.assert_allclose(theirs.boxes.futures, ours.boxes.futures, atol=1e-2)
        (lines, plan), (our_lines, our_plan) = theirs.results, ours.results
        np.testing.assert_allclose(np.stack(lines.points), np.stack(our_lines.points), atol=1e-2)
        assert (lines.classes == our_lines.classes).all()
        np.testing.assert_allclose(plan.paths, our_plan.paths, atol=1e-2)


def test_differences_of_further_outputs_have_columns() -> None:
    frames = [
        FrameDifference(frame, 0, 0, 0, 1, 0, 0, {"plan_offsets": value}) for frame, value in ((3, 0.5), (4, 0.1))
    ]
    heads, *rows = (line.split() for line in difference_lines(frames))
    assert heads[-1] == "plan_offsets"
    assert [(row[0], row[-1]) for row in rows] == [("3", "5.0e-01"), ("4", "1.0e-01"), ("largest", "5.0e-01")]
