"""A program for Triton's interpreter (TRITON_INTERPRET=1): the kernels compared with the plain versions on the CPU.

It prints one line for each case. The results and the gradients of the two versions have to be equal.
"""

import contextlib
import copy
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from simulated_device import sample_hits_plainly
from torch import Tensor, nn

from bevcli.config import known_models, load_config
from bevcli.model.config import ModelConfig
from bevcli.model.deformable_attention import DeformableAttention, GridSampling
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution, predicted_deformable_convolution
from bevcli.model.encoder import SpatialCrossAttention
from bevcli.model.kernels.compiled import Hits
from bevcli.model.network import build_network
from bevcli.model.resnet import ResNet, ResNetConfig

LEVEL_SHAPES = ((5, 7), (3, 4), (2, 2), (1, 1))
FAR = 1e6  # where positions have no gradients
OUTPUTS = 8  # of a convolution, which the kernels do not see


class AttentionShape(NamedTuple):
    """Of a deformable attention. depth: channels of a head. maps: that a query samples, each with its own points.

    pillar_points: reference points of a hit.
    """

    heads: int
    depth: int
    levels: int
    points: int
    maps: int = 1
    pillar_points: int = 1


def attention_shapes(config: ModelConfig) -> set[AttentionShape]:
    """The shapes of a model's attentions."""
    with torch.device("meta"):
        parts = list(build_network(config).modules())
    pillars = {id(part.attention) for part in parts if isinstance(part, SpatialCrossAttention)}
    found = set()
    for part in parts:
        if isinstance(part, DeformableAttention):
            heads, maps, levels, points = part.shape
            depth = part.value_projection.out_features // heads
            of_hit = config.bev_grid.pillar_points if id(part) in pillars else 1
            found.add(AttentionShape(heads, depth, levels, points, maps, of_hit))
    return found


def convolution_shapes(config: ModelConfig) -> set[tuple[int, int]]:
    """(input channels, stride) of a model's deformable convolutions."""
    with torch.device("meta"):
        modules = list(ResNet(config.backbone).modules())
    found = [module for module in modules if isinstance(module, ModulatedDeformableConvolution)]
    return {(each.weight.shape[1], each.stride) for each in found}


def attention_case(heads: int, depth: int, levels: int, points: int, counts: Sequence[int]) -> list[Tensor]:
    """Values, locations inside a map, on its rim and far outside, and weights."""
    random = torch.Generator().manual_seed(heads)
    cells, queries = sum(height * width for height, width in LEVEL_SHAPES[:levels]), sum(counts)
    locations = torch.rand(queries, heads, levels, points, 2, generator=random) * 1.6 - 0.3
    for xy, query in zip((6.7e6, -6.7e6, 0.0, 1.0), range(queries), strict=False):
        locations[query] = xy
    values = torch.randn(len(counts), cells, heads, depth, generator=random)
    return [values, locations, torch.rand(queries, heads, levels, points, generator=random)]


def convolution_case(
    channels: int, outputs: int, stride: int, size: tuple[int, int] = (4, 5), batch: int = 2
) -> list[Tensor]:
    """Values, offsets and masks, weight and bias; some offsets lead far outside."""
    random = torch.Generator().manual_seed(channels)
    height, width = ((length - 1) // stride + 1 for length in size)
    predicted = 2 * torch.randn(batch, 27, height, width, generator=random)
    predicted[:, :4, :1], predicted[:, 4:8, :1] = 6.7e6, -6.7e6
    weight = torch.randn(outputs, channels, 3, 3, generator=random)
    return [
        torch.randn(batch, channels, *size, generator=random),
        predicted,
        weight,
        torch.randn(outputs, generator=random),
    ]


def compare(name: str, inputs: list[Tensor], plain: Callable[..., Tensor], kernel: Callable[..., Tensor]) -> None:
    """Compare the results and the gradients for all inputs, after the results of one direction."""
    found = []
    for function in (plain, kernel):
        learned = [each.clone().requires_grad_() for each in inputs]
        result = function(*learned)
        direction = torch.randn(result.shape, generator=torch.Generator().manual_seed(1))
        found.append([result, *torch.autograd.grad((result * direction).sum(), learned)])
    half = inputs[0].dtype != torch.float32
    for expected, equal in zip(*found, strict=True):
        assert equal.dtype == expected.dtype
        near = expected.abs() < FAR
        if half:  # the plain version rounds more often
            assert (equal[near] - expected[near]).float().norm() <= 5e-3 * expected[near].float().norm()
        else:
            torch.testing.assert_close(equal[near], expected[near], rtol=1e-4, atol=1e-4)
    print(name, flush=True)


def main() -> None:
    """Run all cases."""
    import bevcli.model.kernels.triton_convolution as convolution
    from bevcli.model.kernels.triton_attention import TritonSampling

    torch.cuda.device = lambda which: contextlib.nullcontext()  # type: ignore[assignment,misc]
    configs = [load_config(name) for name in known_models()]

    def sampling(module: nn.Module, levels: int, counts: Sequence[int]) -> Callable[..., Tensor]:
        return lambda values, locations, weights: module(values, LEVEL_SHAPES[:levels], locations, weights, counts)

    attentions = sorted(set().union(*map(attention_shapes, configs)))
    samplings = sorted({(*shape[:4], (0, 5, 0, 2)) for shape in attentions})
    for heads, depth, levels, points, counts in [*samplings, (2, 6, 1, 4, (1,)), (2, 6, 1, 4, (0, 0))]:
        inputs = attention_case(heads, depth, levels, points, counts)
        both = [sampling(module, levels, counts) for module in (GridSampling(), TritonSampling())]
        compare(f"attention {heads, depth, levels, points, counts}", inputs, *both)
    inputs = attention_case(2, 8, 1, 4, (3,))
    inputs[0] = inputs[0].half()
    compare(
        "attention in half precision", inputs, *(sampling(each(), 1, (3,)) for each in (GridSampling, TritonSampling))
    )

    for shape in (*attentions, AttentionShape(1, 6, 3, 5)):
        compare_hits(shape, (0, 40, 0, 3))
    for counts in ((1,), (0,), (0, 0, 1)):
        compare_hits(AttentionShape(2, 6, 1, 4, 2), counts)

    def convolutions(stride: int) -> list[Callable[..., Tensor]]:
        versions = (predicted_deformable_convolution, convolution.deformable_convolution)
        return [lambda *inputs, each=each: each(*inputs, stride) for each in versions]

    shapes = sorted({(c, OUTPUTS, s) for each in configs for c, s in convolution_shapes(each)})
    cases = [*shapes, (6, 5, 1), (20, 17, 2), (3, 4, 1, (1, 1)), (3, 4, 2, (4, 4), 0)]
    for case in cases:
        compare(f"convolution {case}", convolution_case(*case), *convolutions(case[2]))
    halves = [each.half() for each in convolution_case(16, 16, 1)]
    compare("convolution in half precision", halves, *convolutions(1))
    compare_stems()


def compare_hits(shape: AttentionShape, counts: Sequence[int]) -> None:
    """Compare the sums of hits with those by tables; some hits lie far outside. counts: of the hits of each map."""
    from bevcli.model.kernels.triton_attention import sample_hits

    (heads, depth, levels, points, predictions, pillar_points), queries = shape, 9
    values, locations, _ = attention_case(heads, depth, levels, points, counts)
    reference_points = locations[:, 0, 0, :pillar_points].contiguous()
    random = torch.Generator().manual_seed(levels)
    offsets = 3 * torch.randn(queries, heads, predictions, levels, points, 2, generator=random)
    logits = 4 * torch.randn(queries, heads, predictions, levels, points, generator=random)
    query = torch.randint(queries, (sum(counts),), generator=random)
    prediction = torch.randint(predictions, (sum(counts),), generator=random)
    shapes = LEVEL_SHAPES[:levels]
    found = sample_hits(values, shapes, Hits(query, reference_points, counts, prediction), offsets, logits)
    read = (values, reference_points, offsets, logits, query, prediction)
    torch.testing.assert_close(found, sample_hits_plainly(*read, shapes, counts), rtol=1e-4, atol=1e-4)
    print(f"hits {tuple(shape), counts}", flush=True)


def compare_stems() -> None:
    """Compare the stems of a ResNet, for even, odd and no images; the numbers are NaN in the same places."""
    from bevcli.model.kernels.choose import change_classes, fold_batch_norms
    from bevcli.model.kernels.triton_convolution import FusedStem

    torch.manual_seed(0)
    backbone = ResNetConfig((1, 1, 1, 1), output_stages=(1,), width=12).build().eval().requires_grad_(False)
    backbone.bn1.bias.normal_()
    change_classes(fused := copy.deepcopy(backbone), {ResNet: FusedStem})
    fold_batch_norms(fused, torch.device("meta"))
    for batch, height, width in ((2, 32, 64), (1, 33, 47), (1, 2, 2), (0, 32, 32)):
        images = torch.randn(batch, 3, height, width)
        images[:, 0, 0, 0] = torch.nan
        torch.testing.assert_close(fused.stem(images), backbone.stem(images), equal_nan=True)
        print(f"stem {batch, height, width}", flush=True)


if __name__ == "__main__":
    main()
