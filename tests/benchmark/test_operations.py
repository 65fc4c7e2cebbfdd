"""The number of operations, compared with published figures."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest

from bevcli.config import load_config
from bevcli.workshop.benchmark.measure import count_operations

HITS = (400,) * 6
RESNET50_OPERATIONS = 2 * 4.09e9  # for one image of 224 x 224, as published with the weights


@cache
def operations_of_tiny() -> float:
    return count_operations(load_config("tiny"), HITS)


def test_tiny_needs_slightly_more_operations_than_six_resnet50():
    backbone = 6 * RESNET50_OPERATIONS * (480 * 800) / 224**2
    assert 1.02 * backbone < operations_of_tiny() < 1.12 * backbone


@pytest.mark.slow
def test_one_more_hit_adds_its_samples_in_every_layer():
    config = load_config("tiny")
    more = count_operations(config, (401, *HITS[1:])) - operations_of_tiny()
    # 3 layers, 8 heads, 8 points, 32 channels; a product and a sum for four neighbours and for the weight.
    assert more == 3 * 8 * 8 * 32 * (4 * 2 + 2)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["small", "base"])
def test_larger_models_need_more_operations(name):
    assert count_operations(load_config(name), HITS) > 4 * operations_of_tiny()


@pytest.mark.slow
def test_uniads_tracks_and_map_take_a_fifth_of_bases_operations():
    base = count_operations(load_config("base"), HITS)
    assert base < count_operations(load_config("uniad-track-map"), HITS) < 1.2 * base


@pytest.mark.slow
def test_vads_lines_futures_and_paths_are_counted():
    """Smaller images than tiny's, and fewer than half as many operations in its own heads as in the backbone."""
    config, motion = load_config("vad-tiny"), load_config("vad-tiny").motion
    found = count_operations(config, HITS)
    tokens, channels = config.decoder.queries * motion.modes, config.channels
    own_attention = 2 * 2 * tokens * tokens * channels  # products of queries and keys, and of weights and values
    backbone = 6 * RESNET50_OPERATIONS * (384 * 640) / 224**2
    assert backbone + own_attention < found < 1.5 * backbone


def test_the_segmentation_head_is_counted():
    """Its products with every BEV cell: five projections, and two layers of attention and of masks."""
    config = load_config("demo")
    cells, channels, head = config.bev_grid.rows * config.bev_grid.columns, config.channels, config.segmentation
    queries = head.thing_queries + 3
    projections = (2 * head.mask_layers + head.location_layers) * 2 * cells * channels**2
    masks = head.mask_layers * 3 * 2 * queries * cells * channels
    without = count_operations(replace(config, heads=("detection",)), HITS)
    added = count_operations(config, HITS) - without
    assert projections + masks < added < 1.1 * (projections + masks)
