"""How good a model is on several drives together: each run as `bevcli run` does, scored as `bevcli eval` does."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from bevcli.evaluation.config import DetectionConfig
from bevcli.evaluation.detection import evaluate_detections
from bevcli.evaluation.detection_scores import DetectionScores
from bevcli.evaluation.segmentation import SegmentationScores, evaluate_segmentation
from bevcli.frame import MAP_CLASSES, Frame, Prediction
from bevcli.geometry.attributes import attributes_by_speed
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import inverse
from bevcli.model.bevformer import BEVFormerConfig
from bevcli.pipeline.preprocess import Preprocessor
from bevcli.pipeline.runner import Runner
from bevcli.training.drives import Drives


@dataclass(frozen=True)
class Validation:
    """config: how detections were scored. segmentation: None where model or drives have no maps."""

    config: DetectionConfig
    detection: DetectionScores
    segmentation: SegmentationScores | None

    def summary(self) -> dict[str, float]:
        """The numbers that are looked at first: of the classes with ground truth, NaN where nothing measures them."""
        table = self.detection.overall.of_classes_with_ground_truth()
        iou = {} if self.segmentation is None else self.segmentation.iou
        first = {"mAP": table.mean_ap, "NDS": table.nd_score, "mAVE": table.errors["vel_err"]}
        return first | {f"IoU {name}": iou.get(name, math.nan) for name in MAP_CLASSES}

    def row(self) -> dict[str, float]:
        """The numbers by the names of the curve's columns; AP is 0 for a class without ground truth."""
        table = self.detection.overall
        aps = {f"AP {name}": scores.mean_ap for name, scores in table.classes.items()}
        return {**self.summary(), "mATE": table.of_classes_with_ground_truth().errors["trans_err"], **aps}


def validate(
    runner: Runner,
    drives: Drives,
    max_range_m: float | None = None,
    after_frame: Callable[[], None] = lambda: None,
) -> Validation:
    """Runs every frame of the drives. max_range_m: nothing farther is scored; default what the model can reach."""
    config = DetectionConfig().cut_at(reach_m(runner.config) if max_range_m is None else max_range_m)
    predictions, truths, maps = [], [], []
    for place in range(len(drives)):
        sequence = drives.open(place)
        for frame, prediction, _ in runner.run(sequence, range(len(sequence.stamps)), Preprocessor(runner.config)):
            if frame.ground_truth is not None:
                found, truth = _boxes_ego(frame, frame.ground_truth, prediction)
                predictions.append(found)
                truths.append(truth)
            if prediction.segmentation is not None and frame.ground_truth_map is not None:
                maps.append((prediction.segmentation, frame.ground_truth_map))
            after_frame()
    detection = evaluate_detections(predictions, truths, config)
    return Validation(config, detection, evaluate_segmentation(maps) if maps else None)


def reach_m(config: BEVFormerConfig) -> float:
    """How far the model's BEV grid reaches to its nearest side, metres."""
    grid = config.bev_grid
    return min(abs(end) for end in (*grid.x_range_m, *grid.y_range_m))


def _boxes_ego(frame: Frame, ground_truth: Boxes3D, prediction: Prediction) -> tuple[Boxes3D, Boxes3D]:
    """Found and true boxes in the ego frame; the model names no attribute, so its boxes get them by speed."""
    found = prediction.boxes_ego
    found = replace(found, attributes=attributes_by_speed(found))
    return found, ground_truth.transformed(inverse(frame.world_from_ego.matrix))
