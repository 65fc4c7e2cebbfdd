"""Hybrid queries: boxes in the images that become object queries beside the learned ones."""

from dataclasses import replace

import pytest
import torch
from small_model import HEIGHT, WIDTH, small_config, small_inputs

from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.model.hybrid_queries import GROUPS, HybridQueriesConfig
from bevcli.model.image_boxes import IMAGE_CLASSES, ImageBoxes
from bevcli.model.lift import NO_BOX
from bevcli.model.nanodet import NanoDetConfig

COUNT = 20


@pytest.fixture(scope="module")
def model():
    config, backbone = small_config(), NanoDetConfig(max_boxes=16)
    hybrid = HybridQueriesConfig(COUNT, layers=1)
    torch.manual_seed(1)  # some boxes are inside the grid
    return BEVFormer(
        replace(config, backbone=backbone, neck=replace(config.neck, levels=2), hybrid_queries=hybrid)
    ).eval()


def lifted(model, inputs):
    """Class logits and codes of all boxes in the images, without the model's own layers; slopes."""
    boxes = model.backbone.image_boxes(model.image_maps(inputs.images), inputs.has_image, inputs.image_sizes)
    return model.hybrid_queries.lift(boxes, inputs.image_from_bev, inputs.image_sizes)


@torch.no_grad()
def test_without_training_they_are_the_lifted_boxes(model):
    inputs = small_inputs()
    outputs = model(inputs)
    queries = model.config.decoder.queries
    assert outputs.class_logits.shape[2] == outputs.box_codes.shape[2] == queries + COUNT
    logits, codes, _ = lifted(model, inputs)
    queries_of = {
        tuple(code.tolist()): logit for code, logit in zip(codes[0], logits[0], strict=True) if logit.max() > NO_BOX
    }
    seen = outputs.class_logits[-1, 0, queries:].amax(-1) > NO_BOX
    hybrid = outputs.box_codes[-1, 0, queries:][seen], outputs.class_logits[-1, 0, queries:][seen]
    assert len(hybrid[0]) > 3
    for code, logit in zip(*hybrid, strict=True):
        assert torch.equal(queries_of[tuple(code.tolist())], logit)


@torch.no_grad()
def test_a_learned_query_loses_where_the_detector_looked_and_saw_nothing(model):
    """Two cars that one camera sees, one of them in a box of a car; a cone, and a car that no camera sees."""
    hybrid, classes = model.hybrid_queries, len(model.config.classes)
    logits, codes = torch.zeros(1, 1, 3, classes), torch.zeros(1, 1, 3, 10)
    codes[0, 0, :, :2] = torch.tensor([[0.0, 10.0], [5.0, 10.0], [20.0, 1.0]])
    camera = torch.tensor([[WIDTH / 2, WIDTH / 2, 0, 0], [0, HEIGHT / 2, -HEIGHT, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
    middle = torch.tensor([WIDTH / 2, HEIGHT / 2] * 2)
    box = middle + torch.tensor([-4.0, -4, 4, 4])
    numbers = [box.view(1, 1, 1, 4), torch.full((1, 1, 1), 0.9), torch.full((1, 1, 1), IMAGE_CLASSES.index("car"))]
    boxes = ImageBoxes(*numbers, *[torch.zeros(1, 1, 1, size) for size in (7, 128, 3)])
    changed = hybrid.weighed(logits, codes, boxes, camera.view(1, 1, 4, 4), torch.tensor([[[WIDTH, HEIGHT]]]))[0, 0]
    car = model.config.classes.index("car")
    assert changed[:, car].tolist() == pytest.approx([0.0, -1.1, 0.0])
    assert all(changed[:, i].abs().max() == 0 for i, name in enumerate(model.config.classes) if name not in GROUPS)


@torch.no_grad()
def test_nothing_comes_of_cameras_without_images_and_of_places_outside_the_grid(model):
    inputs, queries = small_inputs(), model.config.decoder.queries
    blind = replace(inputs, has_image=torch.zeros_like(inputs.has_image))
    assert (model(blind).class_logits[:, :, queries:] == NO_BOX).all()
    logits, codes, _ = lifted(model, inputs)
    (x0, x1), (y0, y1) = model.config.bev_grid.x_range_m, model.config.bev_grid.y_range_m
    x, y = codes[0, :, 0], codes[0, :, 1]
    inside = ((x > x0) & (x < x1) & (y > y0) & (y < y1) & (logits[0].amax(-1) > NO_BOX)).sum()
    found = model(inputs).class_logits[-1, 0, queries:].amax(-1) > NO_BOX
    assert found.sum() == min(inside, COUNT)


@torch.no_grad()
@pytest.mark.parametrize("layers", [0, 1])
def test_few_cameras_give_as_many_queries_some_of_them_empty(layers):
    backbone, hybrid = NanoDetConfig(max_boxes=4), HybridQueriesConfig(COUNT, layers)
    config = small_config()
    neck = replace(config.neck, levels=2)
    model = BEVFormer(replace(config, backbone=backbone, neck=neck, hybrid_queries=hybrid)).eval()
    outputs = model(small_inputs())
    logits, codes = (x[-1, 0, config.decoder.queries :] for x in (outputs.class_logits, outputs.box_codes))
    assert len(logits) == len(codes) == COUNT
    assert (logits[8:] == NO_BOX).all()
    assert not codes[8:].any()


def test_corrections_learn_from_the_bev_map(model):
    """The lift stays as it is; all else of the hybrid queries has a gradient once the last layers are not zero."""
    hybrid = model.hybrid_queries
    torch.nn.init.normal_(hybrid.box_correction.weight)
    torch.nn.init.normal_(hybrid.class_correction.weight)
    outputs = model(small_inputs())
    (outputs.box_codes[-1, :, -COUNT:].sum() + outputs.class_logits[-1, :, -COUNT:].sum()).backward()
    without = {name.split(".")[0] for name, weight in hybrid.named_parameters() if weight.grad is None}
    assert without == {"lift"}
    torch.nn.init.zeros_(hybrid.box_correction.weight)
    torch.nn.init.zeros_(hybrid.class_correction.weight)


def test_they_need_a_detector():
    with pytest.raises(ValueError, match="hybrid_queries needs a backbone that is a detector"):
        replace(small_config(), hybrid_queries=HybridQueriesConfig(8))
