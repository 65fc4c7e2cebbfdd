"""The map head equals the released UniAD code (float32, CPU).

golden_uniad_map.npz in tests/data holds a part of the original's numbers for one BEV map: the encoder's output at every
592nd cell, every 15th thing query, every fifth mask at every eighth cell, and the merged map. The full numbers are in
the folder golden/ of BEVCLI_SHARED.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import original_reference as original
import pytest
import torch
from uniad_rule import rule_bev, uniad_state

from bevcli.checkpoints import from_official
from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.deformable_attention import DeformableAttention
from bevcli.model.kernels.compiled import CompiledSampling
from bevcli.model.kernels.onednn import use_onednn
from bevcli.workshop.uniad.map_head import MapHead, MapHeadConfig, MapOutputs, merge_map, thing_scores

KEPT = np.load(original.DATA / "golden_uniad_map.npz")
FRAME = 5
GRID, CONFIG = BevGrid(200, 200), MapHeadConfig()
PREFIX = "map_head."


class Step(NamedTuple):
    """What the head computed.

    Attributes:
        outputs: of the head.
        memory: (Y·X, C) of the encoder.
        queries: (T, C) of the location decoder.
        things: (K, C) of the last layer of the things' mask decoder.
        stuff: (S, C) of the last layer of the stuff's mask decoder.
    """

    outputs: MapOutputs
    memory: torch.Tensor
    queries: torch.Tensor
    things: torch.Tensor
    stuff: torch.Tensor


@cache
def step(prepared: bool) -> Step:
    """One step with weights by the rule. prepared: with the kernels of inference on a CPU."""
    head = MapHead(CONFIG, 256, GRID).eval().requires_grad_(False)
    state = from_official(uniad_state("seg_head."))[0]
    head.load_state_dict({key.removeprefix(PREFIX): tensor for key, tensor in state.items()})
    parts = (head.encoder, head.location_decoder.layers[-1], head.thing_masks.layers[-1], head.stuff_masks.layers[-1])
    found: dict[int, torch.Tensor] = {}
    for index, part in enumerate(parts):
        part.register_forward_hook(lambda *call, index=index: found.update({index: call[-1][0].clone()}))
    if prepared:
        use_onednn(head)
        for module in head.modules():
            if isinstance(module, DeformableAttention):
                module.sampling = CompiledSampling()
    with torch.inference_mode():
        outputs = head(rule_bev(FRAME))
    return Step(outputs, found[0], found[1], found[2], found[3])


def close(found: torch.Tensor, expected: np.ndarray, tolerance: float) -> None:
    np.testing.assert_allclose(found.numpy(), expected.reshape(found.shape), atol=tolerance, rtol=0)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("prepared", [False, True])
def test_embeddings_things_and_masks_equal_the_originals(prepared: bool) -> None:
    found = step(prepared)
    close(found.memory[:: 37 * 16], KEPT["memory"], 1e-3)
    close(found.queries[::15], KEPT["queries"], 1e-3)
    close(found.outputs.class_logits[0], KEPT["class_logits"], 1e-3)
    close(found.outputs.locations[-1, 0] * 102.4, KEPT["box"] * 102.4, 1e-2)  # metres
    rows = matching_rows(found.outputs)
    masks = found.outputs.thing_masks[0, rows].unflatten(-1, (200, 200))
    close(found.outputs.scores[0, rows], KEPT["scores"], 1e-4)
    close(found.things[rows][::5, ::4], KEPT["things"], 1e-3)
    close(found.stuff, KEPT["stuff"], 1e-3)
    close(masks[::5, ::8, ::8], KEPT["thing_masks"], 1e-3)
    close(found.outputs.stuff_masks[0, 0].unflatten(-1, (200, 200))[::4, ::4], KEPT["stuff_mask"], 1e-3)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("prepared", [False, True])
def test_the_merged_map_equals_the_originals(prepared: bool) -> None:
    outputs = step(prepared).outputs
    merged = merge_map(outputs, CONFIG, GRID)
    assert_same_cells(merged.things, np.unpackbits(KEPT["lane_bits"]).reshape(3, 200, 200))
    assert_same_cells(merged.stuff[0], np.unpackbits(KEPT["drivable_bits"]).reshape(200, 200))
    assert_same_cells(merged.instances, KEPT["ids"])
    assert_same_cells(np.array([0, *merged.instance_labels])[merged.instances], KEPT["label_map"])
    scores, order = thing_scores(outputs.thing_masks[0], outputs.scores[0], CONFIG.min_mask).sort(descending=True)
    close(scores, KEPT["final_scores"], 2e-4)  # the class score times the square of a mean of masks
    assert np.mean(outputs.labels[0, order].numpy() == KEPT["final_labels"]) > 0.9  # neighbours may be 4e-7 apart
    np.testing.assert_allclose(merged.instance_scores, KEPT["final_scores"][: len(merged.instance_scores)], atol=2e-4)


def matching_rows(outputs: MapOutputs) -> list[int]:
    """For each thing that the original selected, the index of ours with its query and class."""
    found = {
        pair: row for row, pair in enumerate(zip(outputs.queries[0].tolist(), outputs.labels[0].tolist(), strict=True))
    }
    return [found[pair] for pair in zip(KEPT["index"].tolist(), KEPT["labels"].tolist(), strict=True)]


def assert_same_cells(found: np.ndarray, expected: np.ndarray) -> None:
    """Cells are equal, but for those where a mask is so near to its threshold that rounding decides."""
    assert found.shape == expected.shape
    assert np.count_nonzero(found != expected) <= 5
