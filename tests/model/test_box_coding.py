"""Box codes to boxes, and back."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_boxes import made_boxes
from small_model import small_config

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, wrap_angle
from bevcli.model.config import ModelConfig
from bevcli.model.decoder import encode
from bevcli.model.step import ModelOutputs

CONFIG = small_config()
FADING = replace(CONFIG, decoder=replace(CONFIG.decoder, fade_duplicates=0.7))
MERGING = replace(CONFIG, decoder=replace(CONFIG.decoder, merge_duplicates=0.6))


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
    decoded = outputs(logits, encode(boxes)).boxes(CONFIG)[:6]
    for name in ("centers", "sizes_lwh", "velocities"):
        np.testing.assert_allclose(getattr(decoded, name), getattr(boxes, name), atol=1e-4)
    np.testing.assert_allclose(wrap_angle(decoded.yaws - boxes.yaws), 0, atol=1e-5)
    assert decoded.classes.tolist() == ["car"] * 6


def test_unknown_velocities_are_nan_in_the_code() -> None:
    boxes = some_boxes(1)
    boxes.velocities[:] = np.nan
    assert np.isnan(encode(boxes)[0, 8:]).all()


def test_best_scores_are_decoded_a_query_may_have_two_classes() -> None:
    logits = np.array([[3.0, 2.0, -5.0], [-4.0, 1.0, -6.0]])
    codes = encode(some_boxes(2))
    boxes = outputs(logits, codes).boxes(CONFIG)
    assert boxes.classes[:3].tolist() == ["car", "pedestrian", "pedestrian"]
    assert boxes.scores is not None
    np.testing.assert_allclose(boxes.scores[:3], 1 / (1 + np.exp([-3.0, -2, -1])), rtol=1e-5)
    np.testing.assert_array_equal(boxes.centers[0], boxes.centers[1])


@pytest.mark.parametrize(("queries", "expected"), [(2, 6), (50, 10)])
def test_there_are_at_most_max_boxes_boxes(queries: int, expected: int) -> None:
    random = np.random.default_rng(0)
    boxes = outputs(random.normal(size=(queries, 3)), random.normal(size=(queries, 10))).boxes(CONFIG)
    assert len(boxes) == expected


def scores_in_a_row(config: ModelConfig, x: list[float], logits: list[list[float]]) -> Array:
    """Scores of boxes 2 m wide at these x, in metres, by x and class. logits: (Q, classes)."""
    boxes = made_boxes([(place, 0.0) for place in x], sizes_lwh=2.0)
    decoded = outputs(np.array(logits), encode(boxes)).boxes(config)
    assert decoded.scores is not None
    assert (np.diff(decoded.scores) <= 0).all()
    best = decoded[decoded.scores > 0.01]
    assert best.scores is not None
    return best.scores[np.lexsort((best.classes, best.centers[:, 0]))]


def test_a_duplicate_fades_with_its_distance_from_the_better_box() -> None:
    x, logits = [0.0, 0.001, 1.4, 9.0], [[2.0, -9, -9], [1.0, -9, -9], [0.0, -9, -9], [0.5, -9, -9]]
    before = scores_in_a_row(CONFIG, x, logits)
    after = scores_in_a_row(FADING, x, logits)
    # 1.4 m are FADING_WIDTHS widths of 2 m.
    np.testing.assert_allclose(after / before, [1, 0.3, 1 - 0.7 / np.e, 1], atol=0.002)


def test_only_boxes_of_the_same_class_fade() -> None:
    x, logits = [0.0, 0.0], [[2.0, -9, -9], [-9, 1.0, -9]]
    np.testing.assert_array_equal(scores_in_a_row(FADING, x, logits), scores_in_a_row(CONFIG, x, logits))


def test_several_better_boxes_fade_a_box_once() -> None:
    x, logits = [0.0, 0.0, 0.0], [[2.0, -9, -9], [1.0, -9, -9], [0.0, -9, -9]]
    np.testing.assert_allclose(
        np.sort(scores_in_a_row(FADING, x, logits)), np.sort(1 / (1 + np.exp([-2.0, -1, 0])) * [1, 0.3, 0.3]), rtol=1e-5
    )


def merged_boxes(centers: list[tuple[float, float]], logits: list[list[float]]) -> Boxes3D:
    """The decoded boxes with scores above 0.01, of queries with boxes 2 m wide and long, duplicates merged."""
    count = len(centers)
    boxes = replace(some_boxes(count), sizes_lwh=np.full((count, 3), 2.0), centers=np.insert(centers, 2, 0.5, axis=1))
    decoded = outputs(np.array(logits), encode(boxes)).boxes(MERGING)
    assert decoded.scores is not None
    assert (np.diff(decoded.scores) <= 0).all()
    return decoded[decoded.scores > 0.01]


def test_duplicates_share_their_places_by_score_and_distance() -> None:
    boxes = merged_boxes([(0.0, 9.7), (0.0, 10.3)], [[0.0, -9, -9], [0.0, -9, -9]])
    other = np.exp(-((0.3 / 0.6) ** 2))  # 0.6 m are 0.3 of the size; the reach is 0.6
    moved = 0.6 * other / (1 + other)
    np.testing.assert_allclose(np.sort(boxes.centers[:, 1]), [9.7 + moved, 10.3 - moved], rtol=1e-4)
    np.testing.assert_allclose(boxes.centers[:, 2], 0.5, rtol=1e-5)
    np.testing.assert_allclose(boxes.scores, 1 - 0.5 ** (1 + 0.5 * 0.5 * other), rtol=1e-4)


def test_boxes_of_other_objects_and_classes_stay() -> None:
    centers, logits = [(0.0, 9.0), (0.0, 9.1), (0.0, 19.0)], [[0.0, -9, -9], [-9, 0.0, -9], [0.0, -9, -9]]
    boxes = merged_boxes(centers, logits)
    np.testing.assert_allclose(np.sort(boxes.centers[:, 1]), [9, 9.1, 19], rtol=1e-4)
    np.testing.assert_allclose(boxes.scores, 0.5, rtol=1e-3)


def test_scores_of_merged_boxes_stay_below_1() -> None:
    boxes = merged_boxes([(0.0, 9.0)] * 6, [[4.0, -9, -9]] * 6)
    assert boxes.scores is not None
    assert (boxes.scores > 1 / (1 + np.exp(-4.0))).all()
    assert (boxes.scores <= 1).all()


def test_boxes_of_tiny_scores_keep_their_numbers_finite() -> None:
    boxes = outputs(np.full((3, 3), -300.0), encode(some_boxes(3))).boxes(MERGING)
    assert np.isfinite(boxes.centers).all()
