"""The segmentation head: shapes, its parts, and the rules by which masks become a map."""

import math

import pytest
import torch
from small_model import small_config, small_inputs, small_model

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.segmentation import (
    MaskDecoderLayer,
    SegmentationConfig,
    SegmentationHead,
    SegmentationOutputs,
    decode_map,
    map_layers,
)

BOTH = ("detection", "segmentation")
SEGMENTATION = SegmentationConfig(5, location_layers=2, mask_layers=3, attention_heads=4, feed_forward_width=48)


def test_one_forward_pass_computes_both_heads() -> None:
    outputs = small_model(heads=BOTH, segmentation=SEGMENTATION)(small_inputs(batch=2))
    assert outputs.class_logits.shape == (2, 2, 12, 3)
    assert outputs.segmentation is not None
    assert outputs.segmentation.mask_logits.shape == (3, 2, 3 + 5, 48)
    assert outputs.segmentation.class_logits.shape == (3, 2, 3 + 5)
    assert outputs.segmentation.locations.shape == (2, 2, 5, 4)


def test_without_the_head_there_are_no_outputs_and_weights() -> None:
    model = small_model()
    assert model(small_inputs()).segmentation is None
    assert not [key for key in model.state_dict() if "segmentation" in key]


def test_locations_lie_on_the_map() -> None:
    locations = SegmentationHead(SEGMENTATION, 32, (6, 8))(torch.randn(2, 48, 32), torch.randn(48, 32)).locations
    assert ((locations >= 0) & (locations <= 1)).all()


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


def test_a_cell_may_have_several_classes() -> None:
    masks = torch.tensor([[9.0, 9.0], [9.0, -9.0], [-9.0, -9.0], [9.0, -9.0], [-9.0, 9.0]])[None, None]
    outputs = SegmentationOutputs(masks, torch.full((1, 1, 5), 9.0), torch.zeros(1, 1, 2, 4))
    one = decode_map(outputs, SegmentationConfig(map_scale=1), BevGrid(1, 2))
    assert one.cells.tolist() == [[1 + 2 + 8, 1 + 8]]


def test_heads_without_detection_are_an_error() -> None:
    with pytest.raises(ValueError, match="heads must name"):
        small_config(heads=("segmentation",))
