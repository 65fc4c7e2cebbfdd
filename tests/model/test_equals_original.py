"""The tiny model equals the released code, compared with the numbers in tests/data (float32, CPU)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import original_reference as original
import pytest
import torch

from bevcli.geometry.transforms import wrap_angle
from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.model.step import ModelOutputs

Outputs = Callable[[str], ModelOutputs]
KEPT = np.load(original.DATA / "golden_tiny.npz")


@pytest.fixture(scope="module")
def model() -> BEVFormer:
    return original.rule_model("tiny", "history")


@pytest.fixture(scope="module")
def outputs_of(model: BEVFormer) -> Outputs:
    """A function: frame 0 or 1 with history_shift "history", or frame 1 with "both" -> its outputs."""

    @cache
    def compute(step: str) -> ModelOutputs:
        with torch.inference_mode():
            if step == "history_0":
                return model(original.inputs(0, model.config))
            network = original.with_history_shift(model, "both") if step == "both_1" else model
            return network(original.inputs(1, model.config), compute("history_0").bev)

    return compute


STEPS = ["history_0", pytest.param("history_1", marks=pytest.mark.slow), pytest.param("both_1", marks=pytest.mark.slow)]


@pytest.mark.parametrize("step", STEPS)
def test_bev_map_and_head_outputs_equal_the_originals(outputs_of: Outputs, step: str) -> None:
    outputs = outputs_of(step)
    np.testing.assert_allclose(outputs.bev[0, ::23], KEPT[f"{step}_bev"], atol=1e-3)
    np.testing.assert_allclose(outputs.class_logits[:, 0, ::9], KEPT[f"{step}_class_logits"], atol=1e-3)
    np.testing.assert_allclose(outputs.box_codes[:, 0, ::9], KEPT[f"{step}_box_codes"], atol=1e-2)


@pytest.mark.parametrize("step", STEPS)
def test_decoded_boxes_equal_the_originals(model: BEVFormer, outputs_of: Outputs, step: str) -> None:
    boxes = outputs_of(step).boxes(model.config)
    expected, scores, labels = (KEPT[f"{step}_{name}"] for name in ("boxes", "scores", "labels"))
    np.testing.assert_allclose(boxes.scores, scores, atol=1e-4)
    row = original.match_boxes(boxes, expected, labels, model.config.classes)
    np.testing.assert_allclose(boxes.centers[row], expected[:, :3], atol=1e-2)
    np.testing.assert_allclose(boxes.sizes_lwh[row], expected[:, [4, 3, 5]], rtol=1e-3)
    # The original's yaw is measured clockwise from -y.
    np.testing.assert_allclose(wrap_angle(boxes.yaws[row] + expected[:, 6] + np.pi / 2), 0, atol=1e-3)
    np.testing.assert_allclose(boxes.velocities[row], expected[:, 7:], atol=1e-3)


@pytest.mark.slow
def test_the_two_history_shifts_differ(outputs_of: Outputs) -> None:
    assert (outputs_of("history_1").bev - outputs_of("both_1").bev).abs().mean() > 0.1


def test_projected_pillars_equal_the_originals(model: BEVFormer) -> None:
    inputs = original.inputs(0, model.config)
    projection = model.pillars.project(inputs.image_from_bev, inputs.image_size, inputs.has_image)
    visible = projection.visible[0].numpy()
    bits = np.unpackbits(KEPT["visible_bits"])[: visible.size].reshape(visible.shape).astype(bool)
    assert np.array_equal(visible, bits)
    seen = visible[:, ::23]
    points = projection.reference_points[0, :, ::23].numpy()
    np.testing.assert_allclose(points[seen], KEPT["reference_points"][seen], atol=1e-5)


@pytest.mark.parametrize("frame", [0, 1, 2, 3])
def test_ego_motion_inputs_equal_the_originals(model: BEVFormer, frame: int) -> None:
    inputs = original.motion(frame, model.config)
    np.testing.assert_allclose(inputs.can_bus, KEPT[f"history_{frame}_can_bus"], rtol=1e-6, atol=2e-5)
    np.testing.assert_allclose(inputs.shift, KEPT[f"history_{frame}_shift"], atol=1e-7)
