"""From two opened inputs to all scores, and to what the user should be told beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from bevcli.evaluation.config import DetectionConfig
from bevcli.evaluation.detection import evaluate
from bevcli.evaluation.detection_scores import DetectionScores
from bevcli.evaluation.inputs import ScoredInput, without_cycles_in_racks
from bevcli.evaluation.pairing import FramePairs, pair_frames
from bevcli.evaluation.segmentation import SegmentationScores, evaluate_segmentation
from bevcli.geometry.boxes import Boxes3D, attributes_by_speed


@dataclass(frozen=True)
class Scores:
    """Everything that `bevcli eval` shows. segmentation: None where one side has no maps."""

    pairs: FramePairs
    config: DetectionConfig
    detection: DetectionScores
    segmentation: SegmentationScores | None
    notes: tuple[str, ...]


def score(
    predictions: ScoredInput,
    ground_truth: ScoredInput,
    max_range_m: float | None = None,
    *,
    count_missing: bool = False,
) -> Scores:
    """Score predictions. max_range_m: cuts every class's range. count_missing: see `pair_frames`.

    Class ranges hold where frames state an ego pose. Where none does, the devkit's reading is kept: nothing is
    too far away, unless max_range_m is given. Predictions that state no attribute get them by class and speed. Raises
    InputError where the two do not fit together.
    """
    pairs = pair_frames(predictions.boxes, ground_truth.boxes, count_missing=count_missing)
    pairs = without_cycles_in_racks(pairs, ground_truth.bicycle_racks)
    config = DetectionConfig()
    if max_range_m is not None:
        config = config.cut_at(max_range_m)
    elif not pairs.ego_pose_known:
        config = config.unlimited()
    detection = evaluate(_with_attributes(pairs.predictions), pairs.ground_truth, config, pairs.ego_xy)
    segmentation, map_notes = _score_maps(predictions, ground_truth, pairs)
    notes = [*pairs.notes, *map_notes]
    if max_range_m is None and not pairs.ego_pose_known:
        notes.append('no frame states "world_from_ego": class ranges are not applied (--max-range M applies them)')
    return Scores(pairs, config, detection, segmentation, (*notes, *_detection_notes(detection)))


def _with_attributes(frames: Sequence[Boxes3D]) -> Sequence[Boxes3D]:
    if any(boxes.attributes is not None for boxes in frames):
        return frames
    return [replace(boxes, attributes=attributes_by_speed(boxes)) for boxes in frames]


def _score_maps(
    predictions: ScoredInput, ground_truth: ScoredInput, pairs: FramePairs
) -> tuple[SegmentationScores | None, list[str]]:
    found, true = predictions.maps, ground_truth.maps
    if found is None or true is None:
        missing = "predictions" if found is None else "ground truth"
        return None, [f"maps are not scored: the {missing} have none"] if found or true else []
    numbers = [
        (one.index, other.index)
        for one, other in zip(pairs.prediction_stamps, pairs.ground_truth_stamps, strict=True)
        if found.has(one.index) and true.has(other.index)
    ]
    left_out = len(pairs.predictions) - len(numbers)
    notes = [f"{left_out} of {len(pairs.predictions)} frames lack a map on one side: left out"] if left_out else []
    classes = [name for name in true.classes if name in found.classes]
    maps = ((found.load(one), true.load(other)) for one, other in numbers)
    return evaluate_segmentation(maps, classes), notes


def _detection_notes(detection: DetectionScores) -> list[str]:
    notes = []
    if not detection.prediction_count:
        notes.append("the predictions hold no box within the class ranges: every score is 0")
    classes = detection.overall.classes
    absent = [name for name, scores in classes.items() if not scores.ground_truth_count]
    if len(absent) == len(classes):
        notes.append("the ground truth holds no box that is scored: every score is 0")
    elif absent:
        present = detection.overall.of_classes_with_ground_truth()
        notes.append(
            f"no ground truth of {', '.join(absent)}: they count 0 in mAP and NDS, as in nuScenes' devkit; "
            f"without them mAP {present.mean_ap:.3f}, NDS {present.nd_score:.3f}"
        )
    if detection.unmeasured:
        named = {"vel_err": "velocities", "attr_err": "attributes"}
        what = " and ".join(named[name] for name in detection.unmeasured)
        notes.append(f"the ground truth states no {what}: NDS is the mean without that error")
    return notes
