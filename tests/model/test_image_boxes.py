"""Boxes in the images: the decoding of a detector's maps, and the removal of doubles, against plain loops."""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np
import pytest
import torch
from torch import Tensor

from bevcli.model.image_boxes import IMAGE_CLASSES, ImageBoxes, best_image_boxes, without_doubles

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
