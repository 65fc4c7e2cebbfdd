"""The nuScenes detection score: AP, mAP, true-positive errors and NDS of boxes. Reads no files."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bevcli.evaluation.config import ERRORS, DetectionConfig
from bevcli.evaluation.detection_scores import ClassScores, ScoreTable, recall_curve
from bevcli.evaluation.matching import ClassMatches, ScoredBoxes, gather, match_class
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, wrap_angle


@dataclass(frozen=True)
class DetectionScores:
    """The scores of the boxes of some frames. Each table is computed when it is first asked for.

    Attributes:
        frame_count: number of frames.
        matches: by class, the matching.
        unmeasured: names of errors that are left out, because no ground truth has the quantity.
        config: parameters of the matching and of the score.
    """

    frame_count: int
    matches: tuple[ClassMatches, ...] = field(repr=False)
    unmeasured: tuple[str, ...]
    config: DetectionConfig

    @cached_property
    def overall(self) -> ScoreTable:
        """All classes, as in the devkit."""
        return self._table(self.matches)

    @cached_property
    def by_range(self) -> dict[tuple[float, float], ScoreTable]:
        """By the radii of rings around the ego vehicle, nearest first, the classes that have ground truth there."""
        bins = {ends: [part.within(*ends) for part in self.matches] for ends in self.config.range_bins_m}
        return {ends: self._table_of_present(matches) for ends, matches in bins.items()}

    @cached_property
    def by_visibility(self) -> dict[tuple[float, float], ScoreTable]:
        """By the ends of ranges of visibility, the classes that have such ground truth, without false positives.

        Empty where ground truth has no visibilities.
        """
        if all(np.isnan(part.ground_truth.column("visibilities")).all() for part in self.matches):
            return {}
        bins = {ends: [part.visible(*ends) for part in self.matches] for ends in self.config.visibility_bins}
        return {ends: self._table_of_present(matches) for ends, matches in bins.items()}

    def _table_of_present(self, matches: Sequence[ClassMatches]) -> ScoreTable:
        return self._table([part for part in matches if part.truth_counts.any()])

    def _table(self, matches: Sequence[ClassMatches]) -> ScoreTable:
        scores = {part.name: _score_class(part, self.config, self.unmeasured) for part in matches}
        return ScoreTable(scores, self.config.mean_ap_weight)


def evaluate_detections(
    predictions: Sequence[Boxes3D],
    ground_truth: Sequence[Boxes3D],
    config: DetectionConfig | None = None,
    ego_xy: ArrayLike | None = None,
) -> DetectionScores:
    """Score the boxes of F frames.

    Args:
        predictions: F sets of boxes with scores.
        ground_truth: F sets of boxes, each in the frame of reference of the predictions of that frame; it may differ
            from frame to frame. Boxes with num_points 0 are left out.
        config: parameters of the score. Default: the devkit's.
        ego_xy: (F, 2), position of the ego vehicle in the frame of reference, metres; class ranges start there.
            Default: the origin, for boxes in the ego frame.

    Returns:
        The scores, equal to those of nuScenes devkit 1.2.0 (detection_cvpr_2019). As there, a class without ground
        truth has AP 0 and errors of 1. One difference: if no ground truth has a velocity, or none has an attribute,
        that error is NaN and left out of NDS.
    """
    assert len(predictions) == len(ground_truth)
    config = config or DetectionConfig()
    ego = np.zeros((len(predictions), 2)) if ego_xy is None else np.asarray(ego_xy, dtype=np.float64)
    truth, found = (_with_points(gather(side, ego)) for side in (ground_truth, predictions))
    matches = tuple(match_class(name, truth, found, config) for name in config.class_ranges_m)
    return DetectionScores(len(predictions), matches, _unmeasured(truth), config)


def _with_points(boxes: ScoredBoxes) -> ScoredBoxes:
    # On both sides, as in the devkit: then ground truth used as predictions has a perfect score.
    return boxes[boxes.column("num_points") != 0]


def _score_class(part: ClassMatches, config: DetectionConfig, unmeasured: tuple[str, ...]) -> ClassScores:
    truth_count = int(part.truth_counts.sum())
    scores = part.predictions.column("scores")
    curves = {
        distance: recall_curve(matched[counts] >= 0, scores[counts], truth_count)
        for distance, matched, counts in zip(config.distances_m, part.matched, part.counts, strict=True)
    }
    row = config.error_row
    hits = np.flatnonzero(part.counts[row] & (part.matched[row] >= 0))
    truths = part.ground_truth[part.matched[row][hits]]
    one = config.classes[part.name]
    errors = _true_positive_errors(truths, part.predictions[hits], symmetric=one.symmetric)
    curve = curves[config.error_distance_m]
    undefined = {*one.undefined_errors, *unmeasured}
    return ClassScores(
        ground_truth_count=truth_count,
        prediction_count=int(part.counts[row].sum()),
        recall=len(hits) / truth_count if truth_count else float("nan"),
        aps={distance: curve.average_precision(config) for distance, curve in curves.items()},
        errors={
            name: float("nan") if name in undefined else curve.mean_error(config, scores[hits], values)
            for name, values in errors.items()
        },
        curves=curves,
    )


def _true_positive_errors(truths: ScoredBoxes, predictions: ScoredBoxes, *, symmetric: bool) -> dict[str, Array]:
    """The five errors of M matched pairs of one class, each (M,), by the devkit's names.

    trans_err: distance of the centres on the ground, metres.
    scale_err: 1 - IoU of the boxes with the same centre and heading.
    orient_err: angle between the headings, radians; with symmetric, front and back are the same.
    vel_err: m/s; NaN where ground truth has no velocity.
    attr_err: 0 for the right attribute, 1 for a wrong one; NaN where ground truth has none.
    """
    truth, found, attributes = truths.boxes, predictions.boxes, truths.column("attributes")
    offsets = found.centers[:, :2] - truth.centers[:, :2]
    intersection = np.minimum(truth.sizes_lwh, found.sizes_lwh).prod(axis=1)
    union = truth.sizes_lwh.prod(axis=1) + found.sizes_lwh.prod(axis=1) - intersection
    half_turns = 2 if symmetric else 1
    turn = wrap_angle(half_turns * (truth.yaws - found.yaws)) / half_turns
    errors = (
        np.hypot(offsets[:, 0], offsets[:, 1]),
        1 - intersection / union,
        np.abs(turn),
        np.linalg.norm(found.velocities - truth.velocities, axis=1),
        np.where(attributes == "", np.nan, attributes != predictions.column("attributes")),
    )
    return dict(zip(ERRORS, errors, strict=True))


def _unmeasured(truth: ScoredBoxes) -> tuple[str, ...]:
    """The errors whose quantity no ground truth has."""
    unknown = {"vel_err": np.isnan(truth.boxes.velocities).any(axis=1), "attr_err": truth.column("attributes") == ""}
    return tuple(name for name, each in unknown.items() if len(truth) and each.all())
