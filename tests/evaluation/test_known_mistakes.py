"""The patterns of known mistakes: boxes with the mistake have it, and good boxes have not."""

from dataclasses import replace

import numpy as np
import pytest

from bevcli.evaluation.config import ERRORS
from bevcli.evaluation.detection import evaluate_detections
from bevcli.evaluation.scores_report import FrameScores
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.workshop.batch.reproduce_command import known_mistakes

# Length, width and height in metres of a usual object of each class.
SIZES = {
    "car": (4.6, 1.95, 1.7), "truck": (7.0, 2.5, 2.9), "construction_vehicle": (6.4, 2.8, 3.2), "bus": (11.0, 2.9, 3.5),
    "trailer": (12.3, 2.9, 3.9), "barrier": (0.5, 2.5, 1.0), "motorcycle": (2.1, 0.8, 1.5), "bicycle": (1.7, 0.6, 1.3),
    "pedestrian": (0.73, 0.67, 1.8), "traffic_cone": (0.41, 0.41, 1.1),
}  # fmt: skip
SPEED = 1.0  # m/s of every object


@pytest.fixture(scope="module")
def truth() -> Boxes3D:
    rng = np.random.default_rng(0)
    names = np.repeat(list(NUSCENES_CLASSES), 12)
    headings = rng.uniform(-3, 3, len(names))
    places = np.stack(np.meshgrid(np.arange(12), np.arange(10)), axis=-1).reshape(-1, 2) * 3.0 - 15
    return Boxes3D(
        centers=np.column_stack([places, np.zeros(len(names))]),
        sizes_lwh=np.array([SIZES[name] for name in names]),
        yaws=headings,
        velocities=SPEED * np.column_stack([np.cos(headings), np.sin(headings)]),
        classes=names,
        attributes=np.repeat(["vehicle.moving"], len(names)),
    )


def scored(truth: Boxes3D, **changes: object) -> dict:
    """The scores of boxes like the truth, with changes and an error of 10 %."""
    rng = np.random.default_rng(1)
    boxes = replace(truth, scores=rng.uniform(0.1, 1, len(truth)), **changes)
    boxes = replace(boxes, sizes_lwh=1.1 * boxes.sizes_lwh, velocities=0.9 * boxes.velocities)
    return FrameScores(evaluate_detections([boxes], [truth])).to_dict()


def test_good_boxes_show_no_mistake(truth):
    assert known_mistakes(scored(truth)) == []


def test_exchanged_width_and_length_are_recognised(truth):
    sizes = truth.sizes_lwh[:, [1, 0, 2]]
    metrics = scored(truth, sizes_lwh=sizes, yaws=truth.yaws + np.pi / 2)
    [found] = known_mistakes(metrics)
    assert "width and length are exchanged" in found
    assert metrics["tp_errors"]["scale_err"] == pytest.approx(0.7, abs=0.1)


@pytest.mark.parametrize(
    ("errors", "mistakes"),
    [
        ((0.6725, 0.7089, 1.5625, 0.3936, 0.1975), 1),  # issue 24 of BEVFormer: base
        ((0.7034, 0.7108, 1.5524, 0.3715, 0.1949), 1),  # issue 72 of BEVDet
        ((0.673, 0.274, 0.372, 0.394, 0.198), 0),  # the paper: base
        ((0.725, 0.272, 0.391, 0.802, 0.200), 1),  # the paper: base without history
    ],
)
def test_public_evaluations_are_judged_right(errors, mistakes):
    metrics = {
        "mean_dist_aps": dict.fromkeys(NUSCENES_CLASSES, 0.4),
        "classes_with_ground_truth": {"classes": list(NUSCENES_CLASSES)},
        "label_tp_errors": {name: dict(zip(ERRORS, errors, strict=True)) for name in NUSCENES_CLASSES},
    }
    assert len(known_mistakes(metrics)) == mistakes


def test_boxes_without_velocity_are_like_those_without_history(truth):
    metrics = scored(truth, velocities=np.zeros_like(truth.velocities))
    [found] = known_mistakes(metrics)
    assert found.startswith("mAVE 1.00 m/s is the pattern of a model without history (about 1): check that")
    [found] = known_mistakes(metrics, temporal=False)
    assert found.endswith("expected here, as the model ran without history")


def test_classes_that_are_not_found_say_nothing(truth):
    """Their errors count as 1, which is not measured."""
    assert known_mistakes(scored(truth, centers=truth.centers + 100)) == []
