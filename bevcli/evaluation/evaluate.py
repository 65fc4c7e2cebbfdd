"""`evaluate`: read predictions and ground truth, match their frames, and score boxes and maps."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

from bevcli.evaluation.config import DetectionConfig, TrackingConfig
from bevcli.evaluation.detection import DetectionScores, evaluate_detections
from bevcli.evaluation.inputs import ScoredInput, open_ground_truth, open_predictions, without_cycles_in_racks
from bevcli.evaluation.pairing import FramePairs, pair_frames
from bevcli.evaluation.scores_report import FrameScores, driving_tables, driving_to_dict, finite
from bevcli.evaluation.segmentation import SegmentationScores, evaluate_segmentation
from bevcli.geometry.boxes import IMPOSSIBLE, Boxes3D, attributes_by_speed
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass, are_nuscenes
from bevcli.printing import counted
from bevcli.sequences.files.class_names import ClassNames, count_classes
from bevcli.sequences.nuscenes.format import NuScenesOptions
from bevcli.workshop.tracking_scores.scoring import TrackingScores, evaluate_tracking
from bevcli.workshop.vad.driving_scores import DrivingScores, Scored, evaluate_driving

OWN_CLASSES = (
    "the classes are not nuScenes' ten: the formulas are nuScenes', with the classes and ranges of the model, and the "
    "numbers are not comparable to nuScenes'"
)


@dataclass(frozen=True, kw_only=True)
class Scores(FrameScores):
    """The result of `evaluate`.

    Attributes:
        pairs: the frames that were scored.
        driving: the scores of lines of the map, forecasts and planned paths that were asked for.
    """

    pairs: FramePairs
    driving: DrivingScores = field(default_factory=DrivingScores)

    def to_dict(self) -> dict[str, Any]:
        return super().to_dict() | finite(driving_to_dict(self.driving))

    def table(self) -> str:
        frames = f"{counted(self.detection.frame_count, 'frames')}, matched by {self.pairs.matched_by}"
        return "\n\n".join([frames, super().table(), *driving_tables(self.driving)])

    def write_plots(self, folder: Path | str) -> list[Path]:
        """Write plots as PNG files into a folder, made where it is missing; return their paths. Raises OutputError."""
        from bevcli.evaluation import plots  # only plots need matplotlib

        figures = {
            "precision_recall.png": plots.draw_precision_recall(self.detection),
            "errors_by_range.png": plots.draw_errors_by_range(self.detection),
            "misses_and_false_alarms.png": plots.draw_bev_sheet(self.detection, self.pairs),
        }
        return plots.save_figures(figures, Path(folder))


def evaluate(
    predictions: Path | str,
    ground_truth: Path | str,
    max_range: float | None = None,
    count_missing: bool = False,
    *,
    tracking: bool = False,
    driving: Sequence[Scored] = (),
    scene: str | None = None,
    version: str | None = None,
    split: str | None = None,
    class_map: Mapping[str, str] | None = None,
) -> Scores:
    """Score predictions with the nuScenes detection metrics, and maps with IoU where both sides have them.

    Args:
        predictions: a predictions.json, the folder of a run, or a nuScenes submission (results_nusc.json).
        ground_truth: a ground_truth.json, a sequence folder that contains one, or a nuScenes root.
        max_range: distance from the ego vehicle beyond which nothing is scored, metres. Default: the range of each
            class, cut where the model's BEV grid ends if the predictions state it; no limit where no frame has an
            ego pose, as in the devkit.
        count_missing: whether ground-truth frames without a prediction count as missed; they are left out by default.
        tracking: whether to score tracks, too: AMOTA and the metrics that come with it. Predictions and ground truth
            need identities ("instance").
        driving: what else to score: "map" (lines), "motion" (forecasts) and "plan" (planned paths).
        scene: score only this scene of the ground truth.
        version: of a nuScenes root, such as "v1.0-mini".
        split: of a nuScenes root, such as "val".
        class_map: class names in the files -> the classes of the model, such as {"Lorry": "truck"}.

    Returns:
        The scores. Predictions without attributes get them from class and speed.

    Raises:
        InputError: a file is missing or wrong, the two have no frame in common, `tracking` and one of them has no
            identities, or one of them lacks what `driving` asks for.
        ConfigError: max_range is not positive.
    """
    found = open_predictions(Path(predictions), class_map)
    classes = found.boxes.classes or NUSCENES_CLASSES
    truth = open_ground_truth(Path(ground_truth), NuScenesOptions(version, split), scene, class_map, classes)
    pairs = pair_frames(found.boxes, truth.boxes, count_missing=count_missing)
    pairs = without_cycles_in_racks(pairs, truth.bicycle_racks)
    model_range = _model_range_m(found, pairs, classes) if max_range is None else None
    limit = max_range if model_range is None else model_range
    config = DetectionConfig.of(classes).for_frames(limit, ego_pose_known=pairs.ego_pose_known)
    predicted, true = ([frame.boxes for frame in side] for side in (pairs.predictions, pairs.ground_truth))
    detection = evaluate_detections(_with_attributes(predicted, classes), true, config, pairs.ego_xy)
    segmentation, map_notes = _score_maps(found, truth, pairs)
    tracked = TrackingConfig.of(classes).for_frames(limit, ego_pose_known=pairs.ego_pose_known)
    tracks, track_notes = _score_tracks(pairs, tracked) if tracking else (None, [])
    drives = evaluate_driving(driving, Path(predictions), found, truth, pairs)
    limits = _range_notes(max_range, model_range, pairs)
    notes = (*pairs.notes, *map_notes, *_class_notes(predicted, true, classes), *limits, *_detection_notes(detection))
    impossible = truth.impossible_boxes
    left_out = (f"{counted(impossible, 'boxes')} of the ground truth {IMPOSSIBLE}",) if impossible else ()
    notes = (*notes, *track_notes, *drives.notes, *left_out)
    return Scores(detection, segmentation, tracks, notes, pairs=pairs, driving=drives)


def _range_notes(max_range: float | None, model_range: float | None, pairs: FramePairs) -> Iterator[str]:
    if max_range is None and not pairs.ego_pose_known:
        yield 'no frame has "world_from_ego": class ranges are not applied (`max_range=M` applies them)'
    if model_range is not None:
        yield (
            f"nothing beyond {model_range:g} m is scored: the BEV grid of the model that made the predictions ends "
            "there (`max_range=M` sets another limit)"
        )


def _score_tracks(pairs: FramePairs, config: TrackingConfig) -> tuple[TrackingScores, list[str]]:
    """The scores of the tracks, and notes about what differs from nuScenes."""
    stamps = [frame.stamp for frame in pairs.ground_truth]
    predicted, true = ([frame.boxes for frame in side] for side in (pairs.predictions, pairs.ground_truth))
    scores = evaluate_tracking(predicted, true, stamps, config, pairs.ego_xy)
    notes = []
    if pairs.frame_of_reference != "world":
        notes.append(
            f"tracks are scored in the {pairs.frame_of_reference} frame: gaps in tracks are interpolated there, not in "
            "the world frame"
        )
    ordered = pairwise(sorted(stamps, key=lambda stamp: (stamp.scene, stamp.timestamp_ns)))
    gaps = [(b.timestamp_ns - a.timestamp_ns) / 1e9 for a, b in ordered if a.scene == b.scene]
    if gaps and not 0.8 < median(gaps) / config.frame_period_s < 1.25:
        notes.append(
            f"frames are {median(gaps):.2g} s apart, but TID and LGD count {config.frame_period_s:g} s for each of "
            "them, as in the nuScenes devkit"
        )
    return scores, notes


def _with_attributes(frames: Sequence[Boxes3D], classes: Mapping[str, ObjectClass]) -> Sequence[Boxes3D]:
    if any(boxes.attributes is not None for boxes in frames):
        return frames
    return [replace(boxes, attributes=attributes_by_speed(boxes, classes)) for boxes in frames]


def _score_maps(
    predictions: ScoredInput, ground_truth: ScoredInput, pairs: FramePairs
) -> tuple[SegmentationScores | None, list[str]]:
    """The scores of the maps, and notes about frames that were left out."""
    found, true = predictions.maps, ground_truth.maps
    if found is None or true is None:
        missing = "predictions" if found is None else "ground truth"
        return None, [f"maps are not scored: the {missing} have none"] if found or true else []
    indices = [
        (one.stamp.index, other.stamp.index)
        for one, other in zip(pairs.predictions, pairs.ground_truth, strict=True)
        if found.has(one.stamp.index) and true.has(other.stamp.index)
    ]
    left_out = len(pairs.predictions) - len(indices)
    notes = [f"{left_out} of {len(pairs.predictions)} frames lack a map on one side: left out"] if left_out else []
    classes = [name for name in true.classes if name in found.classes]
    if not classes:
        kinds = f"predictions {', '.join(found.classes)}; ground truth {', '.join(true.classes)}"
        return None, [f"maps are not scored: they have no class in common ({kinds})"]
    unscored = [name for name in (*found.classes, *true.classes) if name not in classes]
    if unscored:
        notes.append(f"map classes on one side only, not scored: {', '.join(unscored)}")
    maps = ((found.load(one), true.load(other)) for one, other in indices)
    return evaluate_segmentation(maps, classes), notes


def _model_range_m(predictions: ScoredInput, pairs: FramePairs, classes: Mapping[str, ObjectClass]) -> float | None:
    """Distance to the end of the model's BEV grid, metres; None if unknown, not applicable, or beyond all ranges."""
    stated = predictions.boxes.extras.get("range_m")
    farthest = max(one.range_m for one in classes.values())
    if not pairs.ego_pose_known or not isinstance(stated, (int, float)) or not 0 < stated < farthest:
        return None
    return float(stated)


def _class_notes(
    predicted: Sequence[Boxes3D], true: Sequence[Boxes3D], classes: Mapping[str, ObjectClass]
) -> Iterator[str]:
    """Name the classes on each side that are not scored."""
    if not are_nuscenes(classes):
        yield OWN_CLASSES
    for side, frames in (("the ground truth", true), ("the predictions", predicted)):
        yield from ClassNames(classes=classes).note(count_classes(frames), side)


def _detection_notes(detection: DetectionScores) -> Iterator[str]:
    if not detection.overall.prediction_count:
        yield "the predictions contain no box within the class ranges: every score is 0"
    classes = detection.overall.classes
    absent = [name for name, scores in classes.items() if not scores.ground_truth_count]
    if len(absent) == len(classes):
        yield "the ground truth contains no box that is scored: every score is 0"
    elif absent:
        present = detection.overall.of_classes_with_ground_truth()
        yield (
            f"no ground truth of {', '.join(absent)}: these classes have AP 0 in mAP and NDS, as in the nuScenes "
            f"devkit; without them mAP {present.mean_ap:.3f}, NDS {present.nd_score:.3f}"
        )
    if detection.unmeasured:
        names = {"vel_err": "velocities", "attr_err": "attributes"}
        missing = " or ".join(names[name] for name in detection.unmeasured)
        yield f"the ground truth has no {missing}: NDS is the mean without that error"
