"""Boxes in the images: the decoding of a detector's maps, the removal of doubles, the lift, and hybrid queries."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from small_model import HEIGHT, WIDTH, small_config, small_inputs
from torch import Tensor

from bevcli.config import load_config
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.model.bevformer import BEVFormer
from bevcli.model.hybrid_queries import HybridQueriesConfig, rectangles_of
from bevcli.model.image_boxes import IMAGE_CLASSES, ImageBoxes, best_image_boxes, without_doubles
from bevcli.model.lift import NO_BOX, Lift, LiftConfig
from bevcli.model.nanodet import NanoDetConfig
from bevcli.model.road_slopes import RoadSlopes

STRIDES, SIZES = (8, 16, 32), ((8, 12), (4, 6), (2, 3))  # of maps of an image of 96 x 64 pixels
YES = torch.ones(1, 1, dtype=torch.bool)


def maps_and_predictions(images: int = 1) -> tuple[list[Tensor], list[Tensor]]:
    """Maps with two channels, and predictions without any box."""
    maps = [torch.randn(images, 2, *size) for size in SIZES]
    predictions = [torch.zeros(images, 7 + 44, *size) for size in SIZES]
    for x in predictions:
        x[:, :7] = -20
    return maps, predictions


def put(
    predictions: list[Tensor], level: int, row: int, column: int, kind: str, logit: float, sides: list[int]
) -> None:
    """A box at a cell of the first image, its sides at whole numbers of strides."""
    cell = predictions[level][0, :, row, column]
    cell[IMAGE_CLASSES.index(kind)] = logit
    for side, distance in enumerate(sides):
        cell[7 + 11 * side + distance] = 50


def tensors(boxes: ImageBoxes) -> list[Tensor]:
    return [getattr(boxes, field.name) for field in fields(boxes)]


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    width, height = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    shared = max(width, 0) * max(height, 0)
    return shared / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - shared)


def greedy(boxes: np.ndarray, labels: np.ndarray, most: float) -> list[bool]:
    """Which boxes stay, by falling score."""
    stay: list[bool] = []
    for box, label in zip(boxes, labels, strict=True):
        better = [other for other, kept, kind in zip(boxes, stay, labels, strict=False) if kept and kind == label]
        stay.append(all(overlap(box, other) <= most for other in better))
    return stay


def test_a_box_lies_where_its_cell_and_its_sides_say() -> None:
    maps, predictions = maps_and_predictions()
    put(predictions, 1, 2, 1, "car", 2.0, [1, 2, 3, 1])  # its cell has its centre 24 and 40 pixels from the corner
    put(predictions, 0, 1, 9, "person", 1.0, [0, 2, 1, 3])
    found = best_image_boxes(maps, predictions, STRIDES, YES, most=5)
    boxes, scores, labels, logits, features, cells = (x[0, 0] for x in tensors(found))
    assert boxes[:2].tolist() == [[7.5, 7.5, 71.5, 55.5], [75.5, -0.5, 83.5, 35.5]]  # pixel 0 has its centre at 0
    assert [IMAGE_CLASSES[label] for label in labels[:2]] == ["car", "person"]
    assert scores[:2].tolist() == pytest.approx([1 / (1 + math.exp(-2)), 1 / (1 + math.exp(-1))])
    assert scores[2:].max() < 1e-6
    assert cells[:2].tolist() == [[23.5, 39.5, 16], [75.5, 11.5, 8]]
    assert logits[0].tolist() == pytest.approx([-20, -20, 2, -20, -20, -20, -20])
    assert torch.equal(features[0], maps[1][0, :, 2, 1])
    assert torch.equal(features[1], maps[0][0, :, 1, 9])


def test_the_better_of_two_boxes_of_a_class_at_one_place_stays() -> None:
    maps, predictions = maps_and_predictions()
    put(predictions, 0, 4, 4, "car", 1.0, [3, 3, 3, 3])
    put(predictions, 0, 4, 5, "car", 2.0, [4, 3, 3, 3])  # 6 of 8 columns are shared with it
    put(predictions, 0, 4, 3, "truck", 0.5, [3, 3, 3, 3])  # of another class
    found = best_image_boxes(maps, predictions, STRIDES, YES, most=3)
    assert [IMAGE_CLASSES[label] for label in found.labels[0, 0, :2]] == ["car", "truck"]
    assert found.scores[0, 0].tolist() == pytest.approx([1 / (1 + math.exp(-2)), 1 / (1 + math.exp(-0.5)), 0], abs=1e-6)


def test_boxes_end_at_the_image_and_missing_images_have_none() -> None:
    maps, predictions = maps_and_predictions(4)
    for image in range(4):
        put([x[image:] for x in predictions], 2, 1, 2, "bus", 3.0, [9, 9, 9, 9])
    sizes = torch.tensor([[[96, 64], [90, 50]], [[96, 64], [80, 64]]])
    found = best_image_boxes(maps, predictions, STRIDES, torch.tensor([[True, True], [True, False]]), sizes, most=2)
    assert found.boxes.shape == (2, 2, 2, 4)
    assert found.features.shape == (2, 2, 2, 2)
    assert found.boxes[:, :, 0].tolist() == [
        [[-0.5, -0.5, 95.5, 63.5], [-0.5, -0.5, 89.5, 49.5]], [[-0.5, -0.5, 95.5, 63.5], [-0.5, -0.5, 79.5, 63.5]]
    ]  # fmt: skip
    assert (found.scores[..., 0] > 0.9).tolist() == [[True, True], [True, False]]
    whole = best_image_boxes(maps, predictions, STRIDES, YES.expand(4, 1), most=2)
    assert whole.boxes[1, 0, 0].tolist() == [-0.5, -0.5, 95.5, 63.5]


def test_images_of_a_batch_do_not_change_each_other() -> None:
    maps = [torch.randn(6, 3, *size) for size in SIZES]
    predictions = [3 * torch.randn(6, 51, *size) for size in SIZES]
    together = best_image_boxes(maps, predictions, STRIDES, torch.ones(2, 3, dtype=torch.bool))
    for image in range(6):
        alone = [[x[image : image + 1] for x in every] for every in (maps, predictions)]
        found = best_image_boxes(*alone, STRIDES, YES)
        for one, expected in zip(tensors(found), tensors(together), strict=True):
            torch.testing.assert_close(one[0, 0], expected[image // 3, image % 3])


@pytest.mark.parametrize("most", [0.3, 0.6])
def test_doubles_are_those_of_the_greedy_form(most: float) -> None:
    random = np.random.default_rng(0)
    objects = random.uniform(0, 200, (20, 1, 2))
    centers = objects + random.normal(0, 6, (20, 12, 2))  # crowds, in which boxes remove each other in chains
    size = random.uniform(10, 40, (20, 1, 2)) * random.uniform(0.8, 1.25, (20, 12, 2))
    boxes = np.concatenate([centers - size / 2, centers + size / 2], -1).reshape(-1, 4)
    boxes, labels = boxes[random.permutation(len(boxes))], random.integers(0, 3, len(boxes))
    stay = without_doubles(torch.from_numpy(boxes)[None], torch.from_numpy(labels)[None], most)[0]
    expected = greedy(boxes, labels, most)
    assert 20 < sum(expected) < 200
    assert stay.bool().tolist() == expected


def test_gradients_reach_the_features_and_the_boxes() -> None:
    maps = [torch.randn(1, 3, *size, requires_grad=True) for size in SIZES]
    predictions = [torch.randn(1, 51, *size, requires_grad=True) for size in SIZES]
    found = best_image_boxes(maps, predictions, STRIDES, YES)
    (found.features.sum() + found.boxes.sum() + found.scores.sum()).backward()
    assert all(x.grad is not None and x.grad.isfinite().all() for x in (*maps, *predictions))
    assert sum(x.grad.abs().sum() for x in predictions) > 0


COUNT = 20


@pytest.fixture(scope="module")
def model():
    config, backbone = small_config(), NanoDetConfig(max_boxes=16)
    hybrid = HybridQueriesConfig(COUNT)
    torch.manual_seed(1)  # some boxes are inside the grid
    return BEVFormer(
        replace(config, backbone=backbone, neck=replace(config.neck, levels=2), hybrid_queries=hybrid)
    ).eval()


def lifted(model, inputs):
    """Class logits and codes of all boxes in the images; slopes."""
    boxes = model.backbone.image_boxes(model.image_maps(inputs.images), inputs.has_image, inputs.image_sizes)
    return model.hybrid_queries.lift(boxes, inputs.image_from_bev, inputs.image_sizes)


@torch.no_grad()
def test_they_are_the_lifted_boxes(model):
    inputs = small_inputs()
    outputs = model(inputs)
    queries = model.config.decoder.queries
    assert outputs.class_logits.shape[2] == outputs.box_codes.shape[2] == queries + COUNT
    logits, codes, *_ = lifted(model, inputs)
    queries_of = {
        tuple(code.tolist()): logit for code, logit in zip(codes[0], logits[0], strict=True) if logit.max() > NO_BOX
    }
    seen = outputs.class_logits[-1, 0, queries:].amax(-1) > NO_BOX
    hybrid = outputs.box_codes[-1, 0, queries:][seen], outputs.class_logits[-1, 0, queries:][seen]
    assert len(hybrid[0]) > 3
    for code, logit in zip(*hybrid, strict=True):
        assert torch.equal(queries_of[tuple(code.tolist())], logit)  # untrained queries explain nothing


CAMERA = torch.tensor([[WIDTH / 2, WIDTH / 2, 0, 0], [0, HEIGHT / 2, -HEIGHT, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
IMAGE_SIZES = torch.tensor([[[WIDTH, HEIGHT]]])


def detected(rectangles):
    """Cars in one image, seen with certainty."""
    shape = 1, 1, len(rectangles)
    labels, none = torch.full(shape, IMAGE_CLASSES.index("car")), [torch.zeros(*shape, size) for size in (7, 128, 3)]
    return ImageBoxes(rectangles.view(*shape, 4), torch.full(shape, 0.9), labels, *none)


@torch.no_grad()
@pytest.mark.parametrize("explains", [True, False])
def test_the_learned_queries_are_trusted_where_they_explain_what_the_detector_sees(model, explains):
    """Six cars; the learned boxes lie on them, or nearer to the camera, where they look twice as large."""
    hybrid, car = model.hybrid_queries, model.config.classes.index("car")
    codes = torch.zeros(1, 6, 10)
    codes[0, :, 0], codes[0, :, 1], codes[0, :, 7] = torch.linspace(-5, 5, 6), 10.0, 1.0
    codes[0, :, 2:4] = torch.log(torch.tensor([1.8, 4.5]))
    codes[0, :, 5] = 1.0
    rectangles, is_seen = rectangles_of(codes, CAMERA.view(1, 1, 4, 4), IMAGE_SIZES)
    assert is_seen.all()
    codes[..., :2] *= 1.0 if explains else 0.5
    logits = torch.full((1, 6, len(model.config.classes)), -5.0)
    logits[..., car] = 2.0
    told, hybrid_logits = hybrid.weighed(
        (logits[None], codes[None]), logits, detected(rectangles[0, 0]), (CAMERA.view(1, 1, 4, 4), IMAGE_SIZES)
    )
    lost = logits - told[0] if not explains else logits - hybrid_logits
    assert (lost > 1).all()
    kept = told[0] if explains else hybrid_logits
    assert torch.equal(kept, logits)


@torch.no_grad()
@pytest.mark.parametrize(("deviation", "is_levelled"), [(0.002, True), (0.2, False)])
def test_a_rig_is_levelled_by_a_slope_that_is_sure(model, monkeypatch, deviation, is_levelled):
    """The road climbs by 3 % forward: a point on it lies on the plane of the levelled bev frame."""
    hybrid, slopes = model.hybrid_queries, torch.tensor([[0.01, 0.03]])
    covariance = torch.eye(2)[None] * deviation**2
    monkeypatch.setattr(hybrid.lift, "forward", lambda *_: (RoadSlopes(slopes, covariance),))
    boxes, ground_z = detected(torch.zeros(1, 4)), hybrid.lift.ground_z
    levelled = hybrid.levelled(boxes, (CAMERA.view(1, 1, 4, 4), IMAGE_SIZES, None))[0][0, 0]
    if not is_levelled:
        assert torch.equal(levelled, CAMERA)
        return
    on_road = torch.tensor([5.0, 20.0, ground_z + 5 * 0.01 + 20 * 0.03, 1.0])
    in_level = torch.linalg.solve(levelled, CAMERA @ on_road)
    assert in_level[2] == pytest.approx(ground_z, abs=0.01)
    assert in_level[:2].tolist() == pytest.approx([5.0, 20.0], abs=0.02)


@torch.no_grad()
@pytest.mark.parametrize(("seen", "agrees"), [((0.014, 0.034), True), ((0.05, 0.03), False)])
def test_a_horizon_counts_where_it_does_not_contradict_the_boxes(model, monkeypatch, seen, agrees):
    hybrid, slopes, covariance = model.hybrid_queries, torch.tensor([[0.01, 0.03]]), torch.eye(2)[None] * 0.004**2
    monkeypatch.setattr(hybrid.lift, "forward", lambda *_: (RoadSlopes(slopes, covariance),))
    horizon = RoadSlopes(torch.tensor([seen]), covariance)
    cameras = CAMERA.view(1, 1, 4, 4), IMAGE_SIZES, None
    _, told, expected = hybrid.levelled(detected(torch.zeros(1, 4)), cameras, horizon)
    np.testing.assert_allclose(told.mean[0], [0.012, 0.032] if agrees else slopes[0], atol=2e-3)
    assert told.covariance[0, 0, 0] < 0.6 * covariance[0, 0, 0] or not agrees
    np.testing.assert_allclose(expected.mean[0], seen if agrees else (0, 0), atol=2e-3)  # without the boxes


def test_the_model_for_photographs_is_levelled_by_both():
    config = load_config("photographs")
    assert config.levels
    assert config.horizon


@torch.no_grad()
def test_a_detector_stands_beside_a_backbone_that_sees_smaller_images(model):
    """The boxes are those of the detector on whole images, the BEV map that of the backbone on images of 2/3."""
    image = replace(small_config().image, pad_divisor=48)
    config = small_config(image=image, image_detector=NanoDetConfig(max_boxes=16), backbone_scale=(2, 3))
    beside = BEVFormer(replace(config, hybrid_queries=HybridQueriesConfig(COUNT))).eval()
    beside.image_detector.load_state_dict(model.backbone.state_dict())
    inputs = small_inputs()
    inputs = replace(inputs, images=torch.nn.functional.pad(inputs.images, (0, 0, 0, 96 - HEIGHT)))
    outputs = beside(inputs)
    maps = model.backbone(inputs.images.flatten(0, 1))
    expected = model.backbone.image_boxes(maps, inputs.has_image, inputs.image_sizes)
    assert torch.equal(outputs.image_boxes.boxes, expected.boxes)
    assert outputs.class_logits.shape[2] == config.decoder.queries + COUNT
    smaller = torch.nn.functional.interpolate(inputs.images.flatten(0, 1), (64, 64), mode="bicubic")
    for found, wanted in zip(beside.image_maps(inputs.images), beside.backbone(smaller), strict=True):
        assert torch.equal(found, wanted)
    assert config.level_shapes == tuple((x.shape[-2], x.shape[-1]) for x in beside.neck(beside.backbone(smaller)))


@torch.no_grad()
def test_nothing_comes_of_cameras_without_images_and_of_places_outside_the_grid(model):
    inputs, queries = small_inputs(), model.config.decoder.queries
    blind = replace(inputs, has_image=torch.zeros_like(inputs.has_image))
    assert (model(blind).class_logits[:, :, queries:] <= NO_BOX).all()
    logits, codes, *_ = lifted(model, inputs)
    (x0, x1), (y0, y1) = model.config.bev_grid.x_range_m, model.config.bev_grid.y_range_m
    x, y = codes[0, :, 0], codes[0, :, 1]
    inside = ((x > x0) & (x < x1) & (y > y0) & (y < y1) & (logits[0].amax(-1) > NO_BOX)).sum()
    found = model(inputs).class_logits[-1, 0, queries:].amax(-1) > NO_BOX
    assert found.sum() == min(inside, COUNT)


@torch.no_grad()
def test_few_cameras_give_as_many_queries_some_of_them_empty():
    backbone, hybrid = NanoDetConfig(max_boxes=4), HybridQueriesConfig(COUNT)
    config = small_config()
    neck = replace(config.neck, levels=2)
    model = BEVFormer(replace(config, backbone=backbone, neck=neck, hybrid_queries=hybrid)).eval()
    outputs = model(small_inputs())
    logits, codes = (x[-1, 0, config.decoder.queries :] for x in (outputs.class_logits, outputs.box_codes))
    assert len(logits) == len(codes) == COUNT
    assert (logits[8:] <= NO_BOX).all()
    assert not codes[8:].any()


def test_they_need_a_detector():
    with pytest.raises(ValueError, match="hybrid_queries needs image_detector, or a backbone that is a detector"):
        replace(small_config(), hybrid_queries=HybridQueriesConfig(8))


CLASSES = tuple(NUSCENES_CLASSES)
GROUND_Z, CAMERA_M, FOCAL, SIZE = -1.84, 1.5, 500.0, (704.0, 396.0)


def camera(yaw: float, pitch: float = 0.0) -> np.ndarray:
    """(4, 4) image_from_bev of a camera at the origin, CAMERA_M above the ground, that looks along x turned by yaw."""
    c, s = math.cos(yaw), math.sin(yaw)
    down = np.array([0, 0, -1.0])
    ahead, right = np.array([c, s, 0]), np.array([s, -c, 0])
    ahead, down = math.cos(pitch) * ahead + math.sin(pitch) * down, math.cos(pitch) * down - math.sin(pitch) * ahead
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]]) @ [right, down, ahead]
    matrix[:3, 3] = -matrix[:3, :3] @ [0, 0, GROUND_Z + CAMERA_M]
    return matrix


def upright(
    matrix: np.ndarray, distance: float, yaw: float, height: float, width: float, z: float = 0.0
) -> list[float]:
    """Box in the image of a flat upright object that stands `z` above the ground."""
    ahead, side = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
    points = [[*(distance * ahead + w * width / 2 * side), GROUND_Z + z + h, 1] for w in (-1, 1) for h in (0, height)]
    projected = np.array(points) @ matrix.T
    pixels = projected[:, :2] / projected[:, 2:3]
    return [*pixels.min(0), *pixels.max(0)]


def found(boxes: list[list[float]], name: str, score: float = 0.6) -> ImageBoxes:
    """Boxes of one class in one image."""
    logits = torch.full((1, 1, len(boxes), len(IMAGE_CLASSES)), -6.0)
    logits[..., IMAGE_CLASSES.index(name)] = math.log(score / (1 - score))
    shape = logits.shape[:3]
    labels, features = logits.argmax(-1), torch.zeros(*shape, 128)
    return ImageBoxes(
        torch.tensor([[boxes]]).float(), torch.full(shape, score), labels, logits, features, torch.zeros(*shape, 3)
    )


def lifted_of(lift: Lift, boxes: ImageBoxes, *matrices: np.ndarray) -> tuple[torch.Tensor, ...]:
    with torch.inference_mode():
        return lift(boxes, torch.tensor(np.stack(matrices)).float()[None], torch.tensor([[SIZE] * len(matrices)]))


@pytest.fixture(scope="module")
def lift() -> Lift:
    torch.manual_seed(0)
    return Lift(LiftConfig(), CLASSES).eval()


@pytest.mark.parametrize("yaw", [0.0, 2.0, -2.5])
def test_a_person_is_put_where_foot_and_height_say(lift: Lift, yaw: float) -> None:
    box = upright(camera(yaw), 14, yaw + 0.2, 1.75, 0.6)
    logits, codes, *_ = lifted_of(lift, found([box], "person"), camera(yaw))
    assert CLASSES[logits[0, 0].argmax()] == "pedestrian"
    assert codes[0, 0, :2].numpy() == pytest.approx([14 * math.cos(yaw + 0.2), 14 * math.sin(yaw + 0.2)], abs=1.0)


def test_a_box_whose_foot_and_height_disagree_scores_less(lift: Lift) -> None:
    whole = upright(camera(0), 14, 0, 1.75, 0.6)
    logits, *_ = lifted_of(lift, found([whole, upright(camera(0), 14, 0, 1.2, 0.6)], "person"), camera(0))
    whole_score, score = logits[0].amax(-1)
    assert score < whole_score - 0.2


def test_all_boxes_tell_how_the_vehicle_pitches(lift: Lift) -> None:
    ahead = [(9.0, -0.4), (13.0, 0.3), (18.0, 0.1), (25.0, -0.2)]
    slopes = {}
    for pitch_deg in (-1.0, 0.0, 1.0):
        seen = camera(0.0, math.radians(pitch_deg))
        boxes = found([upright(seen, d, yaw, 1.75, 0.6) for d, yaw in ahead], "person")
        slopes[pitch_deg] = math.degrees(
            lifted_of(lift, boxes, camera(0.0))[2].mean[0, 0]
        )  # it is believed to be level
    # A vehicle that looks down by a degree sees feet higher up: a ground that rises by a degree.
    assert slopes[1.0] - slopes[0.0] == pytest.approx(1.0, abs=0.4)
    assert slopes[-1.0] - slopes[0.0] == pytest.approx(-1.0, abs=0.4)


def test_no_box_has_no_score_and_no_slope(lift: Lift) -> None:
    boxes = found([upright(camera(0), 14, 0, 1.75, 0.6)], "person")
    none = ImageBoxes(boxes.boxes, 0 * boxes.scores, boxes.labels, boxes.logits, boxes.features, boxes.cells)
    logits, codes, slopes = lifted_of(lift, none, camera(0))
    assert (logits == NO_BOX).all()
    assert codes.isfinite().all()
    assert (slopes.mean == 0).all()


def test_a_box_of_a_second_class_does_not_count(lift: Lift) -> None:
    boxes = found([upright(camera(0), 14, 0, 1.75, 0.6)] * 2, "person")
    boxes.labels[0, 0, 1] = IMAGE_CLASSES.index("car")
    logits, *_ = lifted_of(lift, boxes, camera(0))
    assert logits[0, 0].max() > 0
    assert logits[0, 1].max() == NO_BOX
