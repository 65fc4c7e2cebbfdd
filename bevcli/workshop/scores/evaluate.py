"""`evaluate`: read predictions and ground truth, match their frames, and score boxes and maps.

Scores become a dict for JSON, with the key names of the nuScenes devkit, and tables for the terminal.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.frame import MAP_CLASSES, BevMap, Frame, Prediction
from bevcli.geometry.boxes import IMPOSSIBLE, Boxes3D, attributes_by_speed
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass, are_nuscenes
from bevcli.geometry.transforms import inverse
from bevcli.printing import counted, number
from bevcli.sequences.files.boxes_file import ClassNames, count_classes
from bevcli.workshop.formats import NuScenesOptions
from bevcli.workshop.scores import ResultOptions, inputs
from bevcli.workshop.scores.detection import ERRORS, DetectionConfig, DetectionScores, ScoreTable, evaluate_detections
from bevcli.workshop.scores.plots import write_plots
from bevcli.workshop.scores.tables import Cell, Table
from bevcli.workshop.scores.tracking import TrackingScores, score_tracks
from bevcli.workshop.scores.worst_frames import WorstFrames, find_worst_frames
from bevcli.workshop.vad.driving_scores import DrivingScores, evaluate_driving

OWN_CLASSES = (
    "the classes are not nuScenes' ten: the formulas are nuScenes', with the classes and ranges of the model, and the "
    "numbers are not comparable to nuScenes'"
)
_ERROR_HEADS = ("ATE m", "ASE", "AOE rad", "AVE m/s", "AAE")


@dataclass(frozen=True)
class SegmentationScores:
    """The scores of maps: IoU in cells, each summed over all frames."""

    intersection: Mapping[str, float]  # by class, cells that have it in prediction and ground truth, over all maps
    union: Mapping[str, float]  # by class, cells that have it in prediction or ground truth, over all maps
    frame_count: int  # number of pairs of maps

    @property
    def iou(self) -> dict[str, float]:
        """By class, 0 to 1; NaN where neither predictions nor ground truth have the class."""
        return {name: self.intersection[name] / union if union else math.nan for name, union in self.union.items()}


@dataclass(frozen=True)
class FrameScores:
    """The scores of the boxes, maps and further results of some frames."""

    detection: DetectionScores  # the scores of the boxes
    segmentation: SegmentationScores | None = None  # None where predictions or ground truth have no maps
    tracking: TrackingScores | None = None  # the scores of tracks
    vad: DrivingScores | None = None  # those of lines of the map, forecasts and planned paths
    worst: WorstFrames | None = None  # the frames with most missed and most invented boxes
    notes: tuple[str, ...] = ()  # what was assumed or left out, one line each

    @property
    def others(self) -> list[TrackingScores | DrivingScores | WorstFrames]:
        """The scores of further results that were asked for."""
        return [scores for scores in (self.tracking, self.vad, self.worst) if scores is not None]

    def to_dict(self) -> dict[str, Any]:
        """All scores as a dict for JSON; undefined numbers are None. docs/scoring.md explains the keys."""
        detection, maps, config = self.detection, self.segmentation, self.detection.config
        present = detection.overall.of_classes_with_ground_truth()
        content = {
            **_table_to_dict(detection.overall),
            "classes_with_ground_truth": {
                "classes": list(present.classes),
                "mean_ap": present.mean_ap,
                "nd_score": present.nd_score,
            },
            "by_range": [
                {"from_m": low, "to_m": high, **_table_to_dict(table)}
                for (low, high), table in detection.by_range.items()
            ],
            "recall_by_visibility": [
                {
                    "from": low,
                    "to": high,
                    "recall": table.mean_recall,
                    "ground_truth_boxes": table.ground_truth_count,
                    "found_boxes": table.prediction_count,
                    "label_recalls": {name: scores.recall for name, scores in table.classes.items()},
                }
                for (low, high), table in detection.by_visibility.items()
            ],
            "iou": None if maps is None else dict(maps.iou),
            "frames": detection.frame_count,
            "map_frames": 0 if maps is None else maps.frame_count,
            "ground_truth_boxes": detection.overall.ground_truth_count,
            "prediction_boxes": detection.overall.prediction_count,
            "notes": list(self.notes),
            "cfg": {
                "class_range": dict(config.class_ranges_m),
                "dist_ths": list(config.distances_m),
                "dist_th_tp": config.error_distance_m,
                "min_recall": config.min_recall,
                "min_precision": config.min_precision,
                "mean_ap_weight": config.mean_ap_weight,
            },
        }
        for scores in self.others:
            content |= scores.to_dict()
        return finite(content)

    def table(self) -> str:
        """The scores of boxes by class, range and visibility, and those of further results, as text for a terminal."""
        view = [] if self.worst is None or self.worst.view is None else [f"Look at it: {self.worst.view}"]
        return "\n\n".join([*map(str, self.tables()), *view])

    def tables(self) -> Iterator[Table]:
        """The tables of that text, with their numbers."""
        yield _classes(self.detection)
        yield _ranges(self.detection)
        if bins := self.detection.by_visibility:
            rows = [
                (f"{100 * low:.0f}-{100 * high:.0f} %", t.ground_truth_count, t.prediction_count, t.mean_recall)
                for (low, high), t in bins.items()
            ]
            yield Table("visibility", ("visibility", "boxes", "found", "recall, mean over classes"), rows)
        if (maps := self.segmentation) is not None:
            yield Table("maps", ("map class", "IoU"), list(maps.iou.items()), below=f"\n({maps.frame_count} maps)")
        for scores in self.others:
            yield from scores.tables()


@dataclass(frozen=True, kw_only=True)
class Scores(FrameScores):
    """The result of `evaluate`."""

    pairs: inputs.FramePairs  # the frames that were scored

    def table(self) -> str:
        frames = f"{counted(self.detection.frame_count, 'frames')}, matched by {self.pairs.matched_by}"
        return f"{frames}\n\n{super().table()}"

    def write_plots(self, folder: Path | str) -> list[Path]:
        """Write plots as PNG files into a folder, made where it is missing; return their paths. Raises OutputError."""
        return write_plots(self.detection, self.pairs, Path(folder))


def evaluate(
    predictions: Path | str,
    ground_truth: Path | str,
    max_range: float | None = None,
    count_missing: bool = False,
    *,
    scene: str | None = None,
    version: str | None = None,
    split: str | None = None,
    class_map: Mapping[str, str] | None = None,
    **results: int | None,
) -> Scores:
    """Score predictions with the nuScenes detection metrics, and maps with IoU where both sides have them.

    Args:
        predictions: a predictions.json, the folder of a run, or a nuScenes submission (results_nusc.json).
        ground_truth: a ground_truth.json, a sequence folder that contains one, or a nuScenes root.
        max_range: distance from the ego vehicle beyond which nothing is scored, metres. Default: the range of each
            class, cut where the model's BEV grid ends if the predictions state it; no limit where no frame has an
            ego pose, as in the devkit.
        count_missing: whether ground-truth frames without a prediction count as missed; they are left out by default.
        scene: score only this scene of the ground truth.
        version: of a nuScenes root, such as "v1.0-mini".
        split: of a nuScenes root, such as "val".
        class_map: class names in the files -> the classes of the model, such as {"Lorry": "truck"}.
        results: further results to score. tracking=True: AMOTA and the metrics that come with it; both sides need
            identities ("instance"). map=True, motion=True and plan=True: lines of the map, forecasts and planned paths.
            worst=5: the five frames with most missed, and those with most invented, boxes.

    Returns:
        The scores. Predictions without attributes get them from class and speed.

    Raises:
        InputError: a file is missing or wrong, the two have no frame in common, or one of them lacks what `results`
            asks for.
        ConfigError: max_range is not positive.
        TypeError: `results` has an unknown option.
    """
    options = ResultOptions(**results)  # type: ignore[arg-type]
    part = {"scene": scene, "version": version, "split": split}
    compared = read(predictions, ground_truth, count_missing, class_map, part)
    return score(replace(compared, max_range_m=max_range), options)


def read(
    predictions: Path | str,
    ground_truth: Path | str,
    count_missing: bool,
    class_map: Mapping[str, str] | None,
    part: Mapping[str, str | None],
) -> inputs.Compared:
    """Read predictions and ground truth, and match their frames. Arguments and errors are those of `evaluate`."""
    predicted = inputs.open_predictions(Path(predictions), class_map)
    classes, options = predicted.boxes.classes or NUSCENES_CLASSES, NuScenesOptions(part["version"], part["split"])
    truth = inputs.open_ground_truth(Path(ground_truth), options, part["scene"], class_map, classes)
    pairs = inputs.pair_frames(predicted.boxes, truth.boxes, count_missing=count_missing)
    pairs = inputs.without_cycles_in_racks(pairs, truth.bicycle_racks)
    selection = {name: value for name, value in part.items() if value}
    return inputs.Compared(pairs, classes, None, predicted, truth, selection=selection)


def score(compared: inputs.Compared, results: ResultOptions = ResultOptions()) -> Scores:
    """Score what was read. The default range of `evaluate` holds for a `max_range_m` of None."""
    pairs, classes, max_range = compared.pairs, compared.classes, compared.max_range_m
    predicted, truth = compared.predictions, compared.truth
    assert predicted is not None
    assert truth is not None
    # Where the model's BEV grid ends, metres; None if unknown, not applicable, or beyond all ranges.
    model_range, farthest = predicted.range_m, max(object_class.range_m for object_class in classes.values())
    if max_range is not None or not pairs.ego_pose_known or (model_range or farthest) >= farthest:
        model_range = None
    limit = max_range if model_range is None else model_range
    config = DetectionConfig.of(classes).for_frames(limit, ego_pose_known=pairs.ego_pose_known)
    scored, true_boxes = pairs.boxes
    if all(boxes.attributes is None for boxes in scored):
        scored = [replace(boxes, attributes=attributes_by_speed(boxes, classes)) for boxes in scored]
    detection = evaluate_detections(scored, true_boxes, config, pairs.ego_xy)
    segmentation, map_notes = _score_maps(predicted, truth, pairs)
    compared = replace(compared, max_range_m=limit, detection=detection)
    scores = Scores(
        detection,
        segmentation,
        score_tracks(compared) if results.tracking else None,
        evaluate_driving(results, compared) if results.map or results.motion or results.plan else None,
        find_worst_frames([compared], results.worst) if results.worst else None,
        pairs=pairs,
    )
    notes = (
        *pairs.notes,
        *map_notes,
        *_notes(detection, pairs, max_range, model_range),
        *(note for result in scores.others for note in result.notes),
    )
    if impossible := truth.impossible_boxes:
        notes = (*notes, f"{counted(impossible, 'boxes')} of the ground truth {IMPOSSIBLE}")
    return replace(scores, notes=notes)


def boxes_ego(
    frame: Frame, ground_truth: Boxes3D, prediction: Prediction, classes: Mapping[str, ObjectClass]
) -> tuple[Boxes3D, Boxes3D]:
    """Predicted and ground truth boxes in the ego frame. The model has no attributes: they follow from the speed."""
    predicted = prediction.boxes_ego
    predicted = replace(predicted, attributes=attributes_by_speed(predicted, classes))
    return predicted, ground_truth.transformed(inverse(frame.world_from_ego.matrix))


def _score_maps(
    predictions: inputs.ScoredInput, ground_truth: inputs.ScoredInput, pairs: inputs.FramePairs
) -> tuple[SegmentationScores | None, list[str]]:
    """The scores of the maps, and notes about frames that were left out."""
    predicted, true = predictions.maps, ground_truth.maps
    if predicted is None or true is None:
        missing = "predictions" if predicted is None else "ground truth"
        return None, [f"maps are not scored: the {missing} have none"] if predicted or true else []
    indices = [
        (prediction.stamp.index, truth.stamp.index)
        for prediction, truth in zip(pairs.predictions, pairs.ground_truth, strict=True)
        if predicted.has(prediction.stamp.index) and true.has(truth.stamp.index)
    ]
    left_out = len(pairs.predictions) - len(indices)
    notes = [f"{left_out} of {len(pairs.predictions)} frames lack a map on one side: left out"] if left_out else []
    classes = [name for name in true.classes if name in predicted.classes]
    if not classes:
        kinds = f"predictions {', '.join(predicted.classes)}; ground truth {', '.join(true.classes)}"
        return None, [f"maps are not scored: they have no class in common ({kinds})"]
    unscored = [name for name in (*predicted.classes, *true.classes) if name not in classes]
    if unscored:
        notes.append(f"map classes on one side only, not scored: {', '.join(unscored)}")
    maps = ((predicted.load(prediction), true.load(truth)) for prediction, truth in indices)
    return evaluate_segmentation(maps, classes), notes


def evaluate_segmentation(
    pairs: Iterable[tuple[BevMap, BevMap]], classes: Iterable[str] = tuple(MAP_CLASSES)
) -> SegmentationScores:
    """Score pairs of maps (prediction, ground truth), one pair a frame.

    Classes are compared by name; they may have different bits in the two maps. A prediction with another extent or cell
    size is sampled at the centres of the ground truth's cells; cells outside its extent are left out.
    """
    names = tuple(classes)
    intersection, union, count = np.zeros(len(names)), np.zeros(len(names)), 0
    for prediction, truth in pairs:
        predicted, true = _at_ground_truth_cells(prediction, truth)
        bits = [np.array([bev_map.classes.get(name, 0) for name in names], np.uint8) for bev_map in (prediction, truth)]
        predicted_is, true_is = (predicted[:, None] & bits[0]) > 0, (true[:, None] & bits[1]) > 0  # (cells, classes)
        intersection += (predicted_is & true_is).sum(axis=0)
        union += (predicted_is | true_is).sum(axis=0)
        count += 1
    both, either = (dict(zip(names, counts.tolist(), strict=True)) for counts in (intersection, union))
    return SegmentationScores(both, either, count)


def _at_ground_truth_cells(prediction: BevMap, truth: BevMap) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Both maps' values at the ground truth's cells inside the prediction's extent, each (M,)."""
    rows, columns = truth.cells.shape
    (x0, x1), (y0, y1) = truth.x_range_m, truth.y_range_m
    x = x0 + (np.arange(columns) + 0.5) * (x1 - x0) / columns
    y = y1 - (np.arange(rows) + 0.5) * (y1 - y0) / rows  # the first row has the largest y
    (px0, px1), (py0, py1) = prediction.x_range_m, prediction.y_range_m
    column = np.floor((x - px0) / (px1 - px0) * prediction.cells.shape[1]).astype(int)
    row = np.floor((py1 - y) / (py1 - py0) * prediction.cells.shape[0]).astype(int)
    columns_inside = (column >= 0) & (column < prediction.cells.shape[1])
    rows_inside = (row >= 0) & (row < prediction.cells.shape[0])
    predicted = prediction.cells[np.ix_(row[rows_inside], column[columns_inside])]
    return predicted.ravel(), truth.cells[np.ix_(rows_inside, columns_inside)].ravel()


def _notes(
    detection: DetectionScores, pairs: inputs.FramePairs, max_range: float | None, model_range: float | None
) -> Iterator[str]:
    predicted, true = pairs.boxes
    if not are_nuscenes(detection.config.classes):
        yield OWN_CLASSES
    for side, frames in (("the ground truth", true), ("the predictions", predicted)):
        yield from ClassNames(classes=detection.config.classes).note(count_classes(frames), side)
    if max_range is None and not pairs.ego_pose_known:
        yield 'no frame has "world_from_ego": class ranges are not applied (`max_range` (`--max-range M`) applies them)'
    if model_range is not None:
        yield (
            f"nothing beyond {model_range:g} m is scored: the BEV grid of the model that made the predictions ends "
            "there (`max_range` (`--max-range M`) sets another limit)"
        )
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


def _table_to_dict(table: ScoreTable) -> dict[str, Any]:
    return {
        "mean_ap": table.mean_ap,
        "nd_score": table.nd_score,
        "tp_errors": table.errors,
        "tp_scores": table.error_scores,
        "label_aps": {
            name: {f"{distance:.1f}": ap for distance, ap in scores.aps.items()}
            for name, scores in table.classes.items()
        },
        "mean_dist_aps": {name: scores.mean_ap for name, scores in table.classes.items()},
        "label_tp_errors": {name: dict(scores.errors) for name, scores in table.classes.items()},
        "label_recalls": {name: scores.recall for name, scores in table.classes.items()},
        "label_ground_truth_boxes": {name: scores.ground_truth_count for name, scores in table.classes.items()},
    }


def finite(value: Any) -> Any:
    """The value with None in place of NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _classes(detection: DetectionScores) -> Table:
    table = detection.overall
    distances = [f"AP@{distance:g}m" for distance in next(iter(table.classes.values())).aps]
    rows: list[tuple[Cell, ...]] = []
    for name, scores in table.classes.items():
        errors = (scores.errors[error] for error in ERRORS)
        rows.append((name, scores.ground_truth_count, scores.mean_ap, *scores.aps.values(), scores.recall, *errors))
    means = [table.errors[name] for name in ERRORS]
    rows.append(("all", table.ground_truth_count, table.mean_ap, *[""] * len(distances), "", *means))
    below = f"\n\nmAP {number(table.mean_ap)}   NDS {number(table.nd_score)}"
    columns, sums = ("class", "boxes", "AP", *distances, "recall", *_ERROR_HEADS), {"NDS": table.nd_score}
    return Table("classes", columns, rows, below=below, sums=sums)


def _ranges(detection: DetectionScores) -> Table:
    bins = detection.by_range
    rows: list[tuple[Cell, ...]] = []
    for name in detection.overall.classes:
        of_bins = [table.classes.get(name) for table in bins.values()]
        rows.append((name, *(scores.mean_ap if scores else math.nan for scores in of_bins)))
    rows.append(("mAP", *(table.mean_ap for table in bins.values())))
    rows.append(("NDS", *(table.nd_score for table in bins.values())))
    return Table("AP by range", ("AP by range", *(f"{low:g}-{high:g} m" for low, high in bins)), rows)
