"""evaluate_tracking: from boxes with identities to AMOTA and the metrics that come with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bevcli.errors import InputError
from bevcli.evaluation.tracking.class_metrics import METRICS, ClassTracking, score_class
from bevcli.evaluation.tracking.config import TrackingConfig
from bevcli.evaluation.tracking.tracked_boxes import scored_tracks
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array

SUMMED = ("mt", "ml", "tp", "fp", "fn", "ids", "frag")


@dataclass(frozen=True)
class TrackingScores:
    """The tracking metrics of all classes.

    Attributes:
        classes: class -> its metrics.
        config: the parameters that they were computed with.
        scenes: number of scenes.
        frames: number of frames.
    """

    classes: Mapping[str, ClassTracking]
    config: TrackingConfig
    scenes: int
    frames: int

    @property
    def overall(self) -> dict[str, float]:
        """Metric -> its sum or its mean over the classes that have ground truth; NaN where no class has any."""
        values = {name: [scores.metrics[name] for scores in self.classes.values()] for name in METRICS}
        return {name: _over_classes(name, np.array(column, dtype=np.float64)) for name, column in values.items()}


def evaluate_tracking(
    predictions: Sequence[Boxes3D],
    ground_truth: Sequence[Boxes3D],
    stamps: Sequence[FrameStamp],
    config: TrackingConfig | None = None,
    ego_xy: Array | None = None,
) -> TrackingScores:
    """Scores tracks as the nuScenes devkit does.

    Args:
        predictions: boxes of F frames with `instances` and `track_scores` (or `scores`). Boxes without an identity
            are left out.
        ground_truth: boxes of the same frames with `instances`, in the same frame of reference. That is the world, or
            any other one that does not move within a scene.
        stamps: scene and time of each frame.
        config: default `TrackingConfig()`.
        ego_xy: (F, 2) position of the ego vehicle in the frame of reference, metres. Default: the origin.

    Raises:
        InputError: a ground-truth box or all predictions have no identity, or a frame has one identity twice.
    """
    config = TrackingConfig() if config is None else config
    _require_identities(predictions, ground_truth, stamps, tuple(config.class_ranges_m))
    ego_xy = np.zeros((len(stamps), 2)) if ego_xy is None else ego_xy
    found = scored_tracks(predictions, stamps, ego_xy, config.class_ranges_m, "predictions")
    true = scored_tracks(ground_truth, stamps, ego_xy, config.class_ranges_m, "ground truth")
    classes = {
        name: score_class(true[true.classes == name], found[found.classes == name], config)
        for name in config.class_ranges_m
    }
    return TrackingScores(classes, config, len({stamp.scene for stamp in stamps}), len(stamps))


def _require_identities(
    predictions: Sequence[Boxes3D],
    ground_truth: Sequence[Boxes3D],
    stamps: Sequence[FrameStamp],
    classes: tuple[str, ...],
) -> None:
    for boxes, stamp in zip(ground_truth, stamps, strict=True):
        scored = boxes[np.isin(boxes.classes, classes)]
        without = len(scored) if scored.instances is None else int((scored.instances == "").sum())
        if without:
            raise InputError(
                f'ground truth: scene "{stamp.scene}" frame {stamp.index}: {without} of {len(scored)} boxes have no '
                '"instance" (tracking metrics need the identity of every object)'
            )
    if any(map(len, predictions)) and not any(
        boxes.instances is not None and (boxes.instances != "").any() for boxes in predictions
    ):
        raise InputError(
            'predictions: no box has an "instance" (tracking metrics need identities): run bevcli run with --track'
        )


def _over_classes(name: str, values: Array) -> float:
    known = values[~np.isnan(values)]
    if not len(known):
        return np.nan
    return float(known.sum() if name in SUMMED else known.mean())
