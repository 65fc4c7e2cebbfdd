"""A prepared model equals the model itself."""

import copy
from dataclasses import replace

import pytest
import torch
from small_model import small_inputs, small_model
from torch import nn

from bevcli.model import prepare
from bevcli.model.bevformer import BEVFormer
from bevcli.model.image_tokens import ImageTokens, ImageTokensConfig
from bevcli.model.kernels.choose import change_classes, fold_batch_norms
from bevcli.model.prepare import TokensInBlocks, prepare_for_inference
from bevcli.model.step import ModelOutputs
from bevcli.workshop.benchmark.versions import textbook_version

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


@pytest.mark.parametrize("precision", ["bf16", "fp16"])
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
