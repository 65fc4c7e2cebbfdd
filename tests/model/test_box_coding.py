"""Box codes to boxes, and back."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from small_model import small_config

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import wrap_angle
from bevcli.model.box_coding import decode, encode
from bevcli.model.step import ModelOutputs

CONFIG = small_config()


def outputs(logits: np.ndarray, codes: np.ndarray) -> ModelOutputs:
    """Two decoder layers, the first with arbitrary numbers; logits (Q, classes), codes (Q, 10)."""
    layers = [torch.from_numpy(np.stack([np.full_like(x, 7), x])).float()[:, None] for x in (logits, codes)]
    return ModelOutputs(torch.zeros(1, 1, 1), *layers)


def some_boxes(count: int) -> Boxes3D:
    random = np.random.default_rng(0)
    return Boxes3D(
        centers=random.uniform(-10, 10, (count, 3)),
        sizes_lwh=random.uniform(0.4, 9, (count, 3)),
        yaws=random.uniform(-np.pi, np.pi, count),
        velocities=random.normal(size=(count, 2)),
        classes=np.array(["car"] * count),
    )


def test_decoding_undoes_encoding() -> None:
    boxes = some_boxes(6)
    logits = np.full((6, 3), -9.0)
    logits[:, 0] = np.arange(6, 0, -1)  # so that the order by score is this one
    decoded = decode(outputs(logits, encode(boxes)), CONFIG)[0][:6]
    for name in ("centers", "sizes_lwh", "velocities"):
        np.testing.assert_allclose(getattr(decoded, name), getattr(boxes, name), atol=1e-4)
    np.testing.assert_allclose(wrap_angle(decoded.yaws - boxes.yaws), 0, atol=1e-5)
    assert decoded.classes.tolist() == ["car"] * 6


def test_the_code_of_a_car_that_heads_along_y() -> None:
    car = Boxes3D(
        np.array([[1.0, 2, -1]]),
        np.array([[4.5, 1.9, 1.6]]),
        np.array([np.pi / 2]),
        np.array([[0.0, 8]]),
        np.array(["car"]),
    )
    # The original's angle is -yaw - pi/2 = -pi: sine 0, cosine -1.
    expected = [1, 2, np.log(1.9), np.log(4.5), -1, np.log(1.6), 0, -1, 0, 8]
    np.testing.assert_allclose(encode(car)[0], expected, atol=1e-12)


def test_unknown_velocities_are_nan_in_the_code() -> None:
    boxes = some_boxes(1)
    boxes.velocities[:] = np.nan
    assert np.isnan(encode(boxes)[0, 8:]).all()


def test_best_scores_are_decoded_a_query_may_have_two_classes() -> None:
    logits = np.array([[3.0, 2.0, -5.0], [-4.0, 1.0, -6.0]])
    codes = encode(some_boxes(2))
    boxes = decode(outputs(logits, codes), CONFIG)[0]
    assert boxes.classes[:3].tolist() == ["car", "pedestrian", "pedestrian"]
    assert boxes.scores is not None
    np.testing.assert_allclose(boxes.scores[:3], 1 / (1 + np.exp([-3.0, -2, -1])), rtol=1e-5)
    np.testing.assert_array_equal(boxes.centers[0], boxes.centers[1])


@pytest.mark.parametrize(("queries", "expected"), [(2, 6), (50, 10)])
def test_there_are_at_most_max_boxes_boxes(queries: int, expected: int) -> None:
    random = np.random.default_rng(0)
    boxes = decode(outputs(random.normal(size=(queries, 3)), random.normal(size=(queries, 10))), CONFIG)[0]
    assert len(boxes) == expected
