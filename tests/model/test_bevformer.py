"""The whole model: shapes, invariants, gradients, its only state; a prepared model equals it, also tiny on frames."""

import copy
from dataclasses import replace

import numpy as np
import original_reference as original
import pytest
import torch
from small_model import small_inputs, small_model
from torch import nn

from bevcli.geometry.boxes import Boxes3D
from bevcli.inference.attention import AttentionProbe
from bevcli.model import prepare
from bevcli.model.bevformer import BEVFormer
from bevcli.model.image_tokens import ImageTokens, ImageTokensConfig
from bevcli.model.kernels.choose import change_classes, fold_batch_norms
from bevcli.model.kernels.onednn import has_matrix_unit
from bevcli.model.prepare import TokensInBlocks, prepare_for_inference
from bevcli.model.step import ModelInputs, ModelOutputs
from bevcli.workshop.benchmark.versions import textbook_version


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


CPU = torch.device("cpu")


def two_steps(model: BEVFormer) -> ModelOutputs:
    """The outputs of the second of two steps, which has history."""
    with torch.inference_mode():
        return model(small_inputs(1), model(small_inputs(0)).bev)


@pytest.fixture(scope="module")
def model() -> BEVFormer:
    model = small_model()
    random = torch.Generator().manual_seed(1)
    for name, buffer in model.named_buffers():  # as after training
        if name.endswith(("running_mean", "running_var")):
            buffer.copy_(0.5 + torch.rand(buffer.shape, generator=random))
    return model


@pytest.mark.parametrize("version", [prepare_for_inference, textbook_version])
def test_outputs_are_the_models(model, version):
    expected, found = two_steps(model), two_steps(version(model, CPU))
    torch.testing.assert_close(found.bev, expected.bev, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(found.class_logits, expected.class_logits, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(found.box_codes, expected.box_codes, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("camera_index", [torch.tensor([1, 0]), torch.tensor([[0, 1], [1, 1]])])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_image_tokens_in_blocks_are_the_same(dtype, camera_index, monkeypatch):
    monkeypatch.setattr(prepare, "TOKENS_OF_A_BLOCK", 7)
    plain = ImageTokens(cameras=2, channels=8, config=ImageTokensConfig(level_embeddings=3))
    change_classes(blocks := copy.deepcopy(plain), {ImageTokens: TokensInBlocks})
    random = torch.Generator().manual_seed(0)
    maps = [torch.randn(camera_index.numel(), 8, *size, generator=random).to(dtype) for size in ((5, 4), (2, 3))]
    with torch.inference_mode():
        found, expected = blocks(maps, camera_index), plain(maps, camera_index)
    assert found.level_shapes == expected.level_shapes
    assert torch.equal(found.tokens, expected.tokens)


def test_a_changed_calibration_changes_the_cached_hits(model):
    prepared = prepare_for_inference(model, CPU)
    with torch.inference_mode():
        for seed in (0, 1, 0):
            inputs = small_inputs(seed)
            torch.testing.assert_close(prepared(inputs).bev, model(inputs).bev, atol=1e-4, rtol=1e-4)
        blind = replace(inputs, has_image=torch.tensor([[True, False]]))
        torch.testing.assert_close(prepared(blind).bev, model(blind).bev, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_folding_batch_norms_changes_no_feature_map(model, device):
    """The device decides only which module takes the place of deformable convolutions; all of them run on a CPU."""
    folded, images = copy.deepcopy(model.backbone).requires_grad_(False), small_inputs(0).images[0]
    fold_batch_norms(folded, torch.device(device))
    assert not any(isinstance(module, nn.BatchNorm2d) for module in folded.modules())
    for found, expected in zip(folded(images), model.backbone(images), strict=True):
        torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("precision", [pytest.param("bf16", marks=pytest.mark.slow), "fp16"])  # compiles for 4 s
def test_half_precision_stays_near(model, precision):
    expected, found = two_steps(model), two_steps(prepare_for_inference(model, CPU, precision))
    error = (found.bev - expected.bev).norm() / expected.bev.norm()
    assert 1e-6 < error < 0.05
    assert found.box_codes.dtype == found.class_logits.dtype == torch.float32


def test_preparing_leaves_the_model_unchanged(model):
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    prepare_for_inference(model, CPU, "bf16")
    after = model.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert all(parameter.requires_grad for parameter in model.parameters())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU")
@pytest.mark.parametrize(("precision", "tolerance"), [("fp32", 1e-3), ("bf16", 0.05), ("fp16", 0.02)])
def test_a_gpu_equals_the_cpu(model, precision, tolerance):
    gpu = torch.device("cuda")
    prepared = prepare_for_inference(model, gpu, precision)
    with torch.inference_mode():
        found = prepared(small_inputs(1).to(gpu), prepared(small_inputs(0).to(gpu)).bev).bev.cpu()
    expected = two_steps(model).bev
    assert (found - expected).norm() < tolerance * expected.norm()


@pytest.fixture(scope="module")
def rule_tiny() -> BEVFormer:
    return original.rule_model("tiny", "both")


@pytest.fixture(scope="module")
def prepared_fp32(rule_tiny: BEVFormer) -> list[ModelOutputs]:
    return four_frames(prepare_for_inference(rule_tiny, CPU))


def four_frames(model: BEVFormer) -> list[ModelOutputs]:
    """The outputs of all frames; 0 to 2 are one scene, 3 is another."""
    outputs: list[ModelOutputs] = []
    with torch.inference_mode():
        for frame in range(4):
            history = outputs[-1].bev if frame in (1, 2) else None
            outputs.append(model(original.inputs(frame, model.config), history))
    return outputs


def nearest(boxes: Boxes3D, others: Boxes3D) -> np.ndarray:
    """For each box the distance to the nearest other box of its class, metres."""
    distance = np.linalg.norm(boxes.centers[:, None] - others.centers[None], axis=-1)
    return np.where(boxes.classes[:, None] == others.classes[None], distance, np.inf).min(axis=1)


@pytest.mark.slow
def test_float32_equals_the_model(rule_tiny, prepared_fp32):
    for expected, found in zip(four_frames(rule_tiny), prepared_fp32, strict=True):
        distance = (found.box_codes - expected.box_codes)[-1, 0][:, [0, 1, 4]].norm(dim=-1)
        assert distance.max() < 1e-2
        assert (found.class_logits.sigmoid() - expected.class_logits.sigmoid()).abs().max() < 1e-4


@pytest.mark.slow
def test_most_boxes_in_bfloat16_are_within_a_tenth_metre(rule_tiny, prepared_fp32, monkeypatch):
    monkeypatch.setattr(prepare, "has_matrix_unit", lambda: False)
    assert share_within_a_tenth_metre(rule_tiny, prepared_fp32) >= 0.95


@pytest.mark.slow
@pytest.mark.skipif(not has_matrix_unit(), reason="this CPU has no unit for products of bfloat16")
def test_rounded_products_move_a_quarter_of_the_boxes(rule_tiny, prepared_fp32):
    assert share_within_a_tenth_metre(rule_tiny, prepared_fp32) >= 0.7  # docs/speed.md states it


def share_within_a_tenth_metre(model: BEVFormer, prepared_fp32: list[ModelOutputs]) -> float:
    half = four_frames(prepare_for_inference(model, CPU, "bf16"))
    pairs = zip(prepared_fp32, half, strict=True)
    distances = [nearest(one.boxes(model.config), other.boxes(model.config)) for one, other in pairs]
    return float((np.concatenate(distances) < 0.1).mean())
