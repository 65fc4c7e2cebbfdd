"""How good a model is while it trains: whole drives run as `bevcli run` does, scored as `bevcli eval` does."""

from __future__ import annotations

import math
from dataclasses import dataclass

from bevcli.evaluation.config import DetectionConfig
from bevcli.evaluation.detection import evaluate
from bevcli.evaluation.detection_scores import ScoreTable
from bevcli.evaluation.segmentation import evaluate_segmentation
from bevcli.frame import MAP_CLASSES
from bevcli.geometry.transforms import inverse
from bevcli.model.bevformer import BEVFormerConfig
from bevcli.pipeline.preprocess import Preprocessor
from bevcli.pipeline.runner import Runner
from bevcli.training.drives import Drives


@dataclass(frozen=True)
class Validation:
    """Scores of the classes that have ground truth; NaN where nothing measures them.

    aps: by class, averaged over the matching distances. iou: by class of the map.
    """

    mean_ap: float
    nd_score: float
    translation_error_m: float
    velocity_error: float
    aps: dict[str, float]
    iou: dict[str, float]

    def summary(self) -> dict[str, float]:
        """The numbers that are looked at first, by their names."""
        first = {"mAP": self.mean_ap, "NDS": self.nd_score, "mAVE": self.velocity_error}
        return first | {f"IoU {name}": value for name, value in self.iou.items()}

    def row(self) -> dict[str, float]:
        """The numbers by the names of the curve's columns."""
        aps = {f"AP {name}": value for name, value in self.aps.items()}
        return {**self.summary(), "mATE": self.translation_error_m, **aps}


def validate(runner: Runner, drives: Drives) -> Validation:
    """Runs every frame of the drives, with history, and scores what the model can reach."""
    predictions, truths, maps = [], [], []
    for place in range(len(drives)):
        sequence = drives.open(place)
        for frame, prediction, _ in runner.run(sequence, range(len(sequence.stamps)), Preprocessor(runner.config)):
            if frame.ground_truth is not None:
                predictions.append(prediction.boxes_ego)
                truths.append(frame.ground_truth.transformed(inverse(frame.world_from_ego.matrix)))
            if prediction.segmentation is not None and frame.ground_truth_map is not None:
                maps.append((prediction.segmentation, frame.ground_truth_map))
    scores = evaluate(predictions, truths, DetectionConfig().cut_at(reach_m(runner.config)))
    table: ScoreTable = scores.overall.of_classes_with_ground_truth()
    return Validation(
        mean_ap=table.mean_ap,
        nd_score=table.nd_score,
        translation_error_m=table.errors["trans_err"],
        velocity_error=table.errors["vel_err"],
        aps={
            name: table.classes[name].mean_ap if name in table.classes else math.nan for name in runner.config.classes
        },
        iou=dict(evaluate_segmentation(maps).iou) if maps else dict.fromkeys(MAP_CLASSES, math.nan),
    )


def reach_m(config: BEVFormerConfig) -> float:
    """How far the model's BEV grid reaches to its nearest side, metres."""
    grid = config.bev_grid
    return min(abs(end) for end in (*grid.x_range_m, *grid.y_range_m))
