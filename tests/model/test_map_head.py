"""The heads of maps: attention as the released code's kernel reads it, their parts, and the rules of their maps."""

import math

import numpy as np
import pytest
import torch

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.segmentation import MaskDecoderLayer, SegmentationConfig, SegmentationOutputs, decode_map, map_layers
from bevcli.workshop.uniad.map_head import MapHead, MapHeadConfig, MapOutputs, merge_map

SMALL = MapHeadConfig(
    thing_queries=7,
    max_things=9,
    encoder_layers=2,
    location_layers=2,
    thing_mask_layers=1,
    stuff_mask_layers=1,
    attention_heads=4,
    feed_forward_width=24,
    mask_feed_forward_width=24,
)
GRID = BevGrid(5, 6, x_range_m=(-6, 6), y_range_m=(-5, 5))


def small_head() -> MapHead:
    """Random weights, of which none are zero."""
    torch.manual_seed(0)
    head = MapHead(SMALL, 16, GRID).eval()
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return head


def test_a_batch_of_two_equals_two_batches_of_one() -> None:
    head, bev = small_head(), torch.randn(2, 30, 16)
    together, alone = head(bev), head(bev[1:])
    torch.testing.assert_close(together.thing_masks[1:], alone.thing_masks)
    torch.testing.assert_close(together.stuff_masks[1:], alone.stuff_masks)


def test_a_query_is_selected_for_each_of_its_best_classes() -> None:
    outputs = small_head()(torch.randn(1, 30, 16))
    scores = outputs.class_logits[0].sigmoid()
    of_pairs = scores[outputs.queries[0], outputs.labels[0]]
    torch.testing.assert_close(of_pairs, scores.flatten().sort(descending=True).values[:9])
    torch.testing.assert_close(of_pairs, outputs.scores[0])


def outputs_of(*things: tuple[int, float, list[float]], stuff: list[float] | None = None) -> MapOutputs:
    """Outputs on a grid of one row. things: class, class score and mask, by falling score."""
    labels, scores, masks = (torch.tensor([list(part)]) for part in zip(*things, strict=True))
    road = torch.zeros(1, 1, masks.shape[-1]) if stuff is None else torch.tensor([[stuff]])
    return MapOutputs(torch.zeros(1), torch.zeros(1), labels, labels, scores, masks, road)


def layers(outputs: MapOutputs, cells: int) -> list[list[list[int]]]:
    """(classes, 1, cells) of the things in the merged map."""
    merged = merge_map(outputs, SMALL, BevGrid(1, cells))
    return merged.things.astype(int).tolist()


DIVIDER, CROSSING, CONTOUR = 0, 1, 2
ON, OFF = 1.2, 0.4  # a cell belongs to a mask above 0.5


def test_things_get_the_cells_that_better_things_leave() -> None:
    outputs = outputs_of((CONTOUR, 0.9, [ON, ON, ON, OFF, OFF]), (CROSSING, 0.8, [OFF, OFF, ON, ON, ON]))
    assert layers(outputs, 5) == [[[0, 0, 0, 0, 0]], [[0, 0, 0, 1, 1]], [[1, 1, 1, 0, 0]]]


def test_a_thing_that_is_covered_too_much_is_left_out() -> None:
    outputs = outputs_of((CONTOUR, 0.9, [ON, ON, ON, OFF]), (CROSSING, 0.8, [OFF, ON, ON, ON]))
    assert layers(outputs, 4) == [[[0, 0, 0, 0]], [[0, 0, 0, 0]], [[1, 1, 1, 0]]]


def test_dividers_take_no_cells_from_others() -> None:
    outputs = outputs_of((DIVIDER, 0.9, [ON, ON, ON, OFF]), (CROSSING, 0.8, [OFF, ON, ON, ON]))
    merged = merge_map(outputs, SMALL, BevGrid(1, 4))
    assert merged.things.astype(int).tolist() == [[[1, 1, 1, 0]], [[0, 1, 1, 1]], [[0, 0, 0, 0]]]
    assert merged.instances.tolist() == [[1, 2, 2, 2]]
    assert merged.instance_labels == (DIVIDER, CROSSING)


def test_improbable_things_are_left_out() -> None:
    outputs = outputs_of((CONTOUR, 0.3, [ON, ON, OFF]), (CROSSING, 0.1, [OFF, OFF, ON]))
    assert layers(outputs, 3)[CROSSING] == [[0, 0, 0]]  # 0.1 · (1.2 / 2)² < 0.1
    assert layers(outputs, 3)[CONTOUR] == [[1, 1, 0]]  # 0.3 · (2.4 / 3)² > 0.1


def test_a_map_has_stuff_below_things_and_its_first_row_ahead() -> None:
    grid = BevGrid(3, 2, x_range_m=(-1, 1), y_range_m=(-1.5, 1.5))
    crossing = [OFF, OFF, OFF, OFF, ON, OFF]  # the first cell of the row that is furthest ahead
    outputs = outputs_of((CROSSING, 0.9, crossing), stuff=[ON, ON, OFF, OFF, ON, ON])
    bev_map = merge_map(outputs, SMALL, grid).bev_map(grid, SMALL)
    assert bev_map.classes == {"drivable_area": 1, "divider": 2, "pedestrian_crossing": 4, "contour": 8}
    # By 0.94 m further back: the next row.
    assert bev_map.layer("pedestrian_crossing").tolist() == [[False, False], [True, False], [False, False]]
    assert bev_map.layer("drivable_area").tolist() == [[True, True], [False, False], [True, True]]
    assert (bev_map.x_range_m, bev_map.y_range_m) == ((-1, 1), (-1.5, 1.5))


@pytest.mark.parametrize(("offset", "column"), [((0.0, 0.0), 2), ((1.2, 0.0), 3), ((-2.0, 0.0), 0), ((9.0, 0.0), None)])
def test_things_are_moved_by_whole_cells(offset: tuple[float, float], column: int | None) -> None:
    grid = BevGrid(1, 4, x_range_m=(-2, 2), y_range_m=(-0.5, 0.5))
    config = MapHeadConfig(thing_offset_m=offset)
    merged = merge_map(outputs_of((CONTOUR, 0.9, [OFF, OFF, ON, OFF])), config, grid)
    found = np.flatnonzero(merged.bev_map(grid, config).layer("contour")).tolist()
    assert found == ([] if column is None else [column])


@pytest.mark.parametrize(
    "wrong",
    [
        {"things": ()},
        {"stuff": ("road", "road")},
        {"things": tuple("abcdefgh")},
        {"max_things": 1000},
    ],
)
def test_a_wrong_configuration_is_an_error(wrong: dict) -> None:
    with pytest.raises(ValueError, match=r"must|need"):
        MapHeadConfig(**wrong)


def test_a_mask_is_the_weighted_sum_of_attention_maps() -> None:
    layer = MaskDecoderLayer(channels=8, heads=2, feed_forward_width=8, dropout=0.0)
    with torch.no_grad():
        for projection in (layer.query_projection, layer.key_projection):
            projection.weight.copy_(torch.eye(8))
            projection.bias.zero_()
        layer.mask_projection.weight.copy_(torch.tensor([[1.0, 2.0]]))
        layer.mask_projection.bias.zero_()
    query, bev = torch.zeros(1, 1, 8), torch.zeros(1, 3, 8)
    query[0, 0] = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0])
    bev[0, 1, 0] = 6.0  # attended by the first head, with weight 1
    bev[0, 2, 4] = 6.0  # attended by the second head, with weight 2
    _, masks, _ = layer(query, torch.zeros(3, 8), bev)
    assert masks[0, 0].tolist() == pytest.approx([0, 6 / math.sqrt(4), 2 * 6 / math.sqrt(4)])


def things_in_a_row(*rows: list[float], minimum: float, scale: int) -> list[bool]:
    """Where there are vehicles in a map of one row, from the probabilities of thing queries."""
    logits = torch.cat([torch.full((3, len(rows[0])), -9.0), torch.tensor(rows).logit()])
    config = SegmentationConfig(min_thing=minimum, map_scale=scale)
    layers = map_layers(logits, torch.full((len(logits),), torch.inf), config, BevGrid(1, len(rows[0])))
    assert not layers[:3].any()
    return layers[3, 0].tolist()


def test_a_cell_has_a_vehicle_where_any_query_is_probable() -> None:
    rows = [0.9, 0.5, 0.1, 0.1], [0.0, 0.4, 0.6, 0.1]
    assert things_in_a_row(*rows, minimum=0.2, scale=1) == [True, True, True, False]


def test_a_finer_map_interpolates_between_the_cells() -> None:
    row = [1.0, 0.0]  # over four half cells: 1, 0.75, 0.25, 0
    assert things_in_a_row(row, minimum=0.5, scale=2) == [True, True, False, False]
    assert things_in_a_row(row, minimum=0.2, scale=2) == [True, True, True, False]


def test_a_probability_is_class_times_mask() -> None:
    masks, classes = torch.full((1, 1, 4, 1), 0.5).logit(), torch.tensor([0.9, 0.7, 0.7, 0.3]).logit()[None, None]
    outputs = SegmentationOutputs(masks, classes, torch.zeros(1, 1, 1, 4))
    one = decode_map(outputs, SegmentationConfig(map_scale=1, min_stuff=0.4, min_thing=0.2), BevGrid(1, 1))
    assert one.cells.tolist() == [[1]]  # the road alone: neither another class nor a vehicle
    layers = map_layers(masks[0, 0], classes[0, 0], SegmentationConfig(map_scale=1, min_stuff=0.4), BevGrid(1, 1))
    assert layers.flatten().tolist() == [True, False, False, False]


def test_a_bev_map_has_a_bit_a_class_and_its_first_row_ahead() -> None:
    grid = BevGrid(2, 3, x_range_m=(-3, 3), y_range_m=(-2, 2))
    logits = torch.full((1, 1, 5, 6), -9.0)
    logits[0, 0, 0, :3] = 9.0  # the road: the row behind the vehicle
    logits[0, 0, 2, 1] = 9.0  # a crossing on it
    logits[0, 0, 4, [1, 4]] = 9.0  # a vehicle on both rows
    outputs = SegmentationOutputs(logits, torch.full((1, 1, 5), 9.0), torch.zeros(1, 1, 2, 4))
    bev_map = decode_map(outputs, SegmentationConfig(map_scale=1), grid)
    assert bev_map.cells.tolist() == [[0, 8, 0], [1, 1 + 4 + 8, 1]]
    assert (bev_map.x_range_m, bev_map.y_range_m) == ((-3, 3), (-2, 2))
