"""The whole model: shapes, invariants, gradients, and that the BEV map is its only state."""

from dataclasses import replace

import pytest
import torch
from small_model import small_inputs, small_model

from bevcli.inference.attention import AttentionProbe
from bevcli.model.bevformer import BEVFormer
from bevcli.model.prepare import prepare_for_inference
from bevcli.model.step import ModelInputs, ModelOutputs


def assert_same(a: ModelOutputs, b: ModelOutputs) -> None:
    for name in ("bev", "class_logits", "box_codes"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("with_history", [False, True])
def test_a_batch_of_two_equals_two_batches_of_one(with_history: bool) -> None:
    model, inputs = small_model(), small_inputs(batch=2)
    history = torch.randn(2, 48, 32) if with_history else None
    together = model(inputs, history)
    for i in range(2):
        alone = model(_row(inputs, i), None if history is None else history[i : i + 1])
        torch.testing.assert_close(together.bev[i], alone.bev[0], atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(together.box_codes[:, i], alone.box_codes[:, 0], atol=1e-4, rtol=1e-4)


def test_the_order_of_the_cameras_does_not_matter() -> None:
    model, inputs = small_model(), small_inputs()
    swap = torch.tensor([1, 0])
    swapped = replace(
        inputs,
        images=inputs.images[:, swap],
        image_from_bev=inputs.image_from_bev[:, swap],
        camera_index=inputs.camera_index[swap],
    )
    assert_same(model(inputs), model(swapped))


def test_a_camera_without_an_image_has_no_effect() -> None:
    model, inputs = small_model(), replace(small_inputs(), has_image=torch.tensor([[True, False]]))
    other_pixels = inputs.images.clone()
    other_pixels[:, 1] = 3
    assert_same(model(inputs), model(replace(inputs, images=other_pixels)))
    assert not hit(model, inputs)[0, 1].any()


def test_outputs_without_any_image_are_finite() -> None:
    inputs = replace(small_inputs(), has_image=torch.zeros(1, 2, dtype=torch.bool))
    assert small_model()(inputs).box_codes.isfinite().all()


@pytest.mark.parametrize("prepared", [False, True])
def test_a_probe_holds_a_layers_samples_and_changes_nothing(prepared: bool) -> None:
    model, inputs, history = small_model(), small_inputs(), torch.randn(1, 48, 32)
    visible = hit(model, inputs)[0]
    if prepared:
        model = prepare_for_inference(model, torch.device("cpu"))
    with torch.inference_mode():
        expected = model(inputs, history)
        with AttentionProbe(model, layer=1, cells=torch.tensor([9, 40])) as probe:
            assert_same(model(inputs, history), expected)
    assert probe.spatial is not None
    assert set(probe.spatial.cell.tolist()) <= {9, 40}
    assert len(probe.spatial.cell) == visible[:, [9, 40]].sum() > 0
    torch.testing.assert_close(
        probe.spatial.weights.sum((-1, -2)), torch.ones(len(probe.spatial.cell), 4), atol=1e-5, rtol=1e-5
    )
    assert probe.history_share is not None
    assert ((probe.history_share > 0) & (probe.history_share < 1)).all()


def hit(model: BEVFormer, inputs: ModelInputs) -> torch.Tensor:
    """(B, N, Y·X) bool: whether a camera sees a cell."""
    return model.pillars.project(inputs.image_from_bev, inputs.image_size, inputs.has_image).hit


def _row(inputs: ModelInputs, i: int) -> ModelInputs:
    """The inputs of one batch element."""
    tensors = {name: x for name, x in vars(inputs).items() if x is not None}
    rows = {name: x[i : i + 1] for name, x in tensors.items()}
    return ModelInputs(**{**rows, "camera_index": inputs.camera_index})
