"""The figures of attention of a model that plans, and the weights that they show."""

from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch
from memory_drive import MemorySequence

from bevcli.errors import InputError
from bevcli.workshop.explain import figure_files as figures
from bevcli.workshop.explain.attention_figures import FIGURES
from bevcli.workshop.explain.figure_files import figures_of, write_figures
from bevcli.workshop.explain.overview import FIGURES as OF_BEVFORMER
from bevcli.workshop.explain.trace import Trace, trace
from bevcli.workshop.vad.vad import VAD

CPU = torch.device("cpu")


def traced(model: VAD, command: str | None = None) -> Trace:
    return trace(model, CPU, MemorySequence(1), 0, (5.0, 10.0), command)


@pytest.fixture(scope="module")
def of_vad(mini_vad: VAD) -> Trace:
    return traced(mini_vad, "left")


def test_weights_of_objects_and_of_lines_sum_to_1(of_vad: Trace):
    for part in ("plan", "motion"):
        attention = of_vad.attentions[part]
        assert attention.object_weights.sum() == pytest.approx(1, abs=1e-5)
        assert attention.line_weights.sum() + attention.no_line == pytest.approx(1, abs=1e-5)
        assert len(attention.objects) == len(attention.object_weights) == 30
        assert len(attention.lines) == len(attention.line_weights) == 8


def test_an_object_attends_to_no_line_that_is_unsure(of_vad: Trace):
    attention = of_vad.attentions["motion"]
    is_sure = attention.lines.scores > 0.5
    assert is_sure.any()
    assert (attention.line_weights[~is_sure] == 0).all()


def test_the_plan_attends_to_the_line_that_weights_force(mini_vad: VAD):
    """All keys are a hundred times the x of a line's position, and all queries are 1: the softmax picks the largest."""
    model = deepcopy(mini_vad)
    layer, position = model.planner.line_attention.attention, model.planner.line_position
    channels = layer.embed_dim
    with torch.no_grad():
        layer.in_proj_weight[: 2 * channels] = 0
        layer.in_proj_weight[channels : 2 * channels, 0] = 1
        layer.in_proj_bias[:channels] = 1
        position.weight[0] = torch.tensor([1e4, 0.0])
    found = traced(model)
    points = found.outputs.lines.points[-1, 0].numpy()  # (N, P, 2)
    nearest_corner = np.hypot(points[..., 0], points[..., 1]).argmin(-1)
    planted = points[np.arange(len(points)), nearest_corner, 0].argmax()
    assert found.attentions["plan"].line_weights[planted] == pytest.approx(1)


def test_the_figures_of_attention_are_written(of_vad: Trace, tmp_path, monkeypatch):
    assert figures_of(of_vad.config) == OF_BEVFORMER | FIGURES
    monkeypatch.setattr(figures, "figures_of", lambda _: FIGURES)
    assert all(isinstance(file, Path) for _, file in write_figures(of_vad, tmp_path, "jpg"))
    assert {path.name for path in tmp_path.iterdir()} == {"vad-plan-attention.jpg", "vad-motion-attention.jpg"}


def test_a_model_without_paths_takes_no_command(mini_model):
    with pytest.raises(InputError, match="plans no path"):
        trace(mini_model, CPU, MemorySequence(1), 0, None, "left")
