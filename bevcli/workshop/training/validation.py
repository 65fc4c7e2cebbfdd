"""Scores of a model over several drives: each is run as by `bevcli run`, and all are scored as by `bevcli eval`."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

import numpy as np

from bevcli.evaluation.config import DetectionConfig
from bevcli.evaluation.detection import evaluate_detections
from bevcli.evaluation.evaluate import FrameScores, finite
from bevcli.evaluation.inputs import Compared, FramePairs
from bevcli.evaluation.scorers import score_results
from bevcli.evaluation.segmentation import evaluate_segmentation
from bevcli.frame import MAP_CLASSES, Frame, Prediction
from bevcli.geometry.boxes import Boxes3D, attributes_by_speed
from bevcli.geometry.object_classes import ObjectClass
from bevcli.geometry.transforms import inverse
from bevcli.inference.runner import Runner
from bevcli.sequences.files.boxes_file import FrameBoxes
from bevcli.workshop.synth.drives import Drives


@dataclass(frozen=True)
class DriveScores:
    """The detection scores of one drive alone, over the classes that it has.

    Attributes:
        name: of the drive.
        cameras: the number of its cameras.
        mean_ap: mAP, 0 to 1; NaN without ground truth.
        nd_score: NDS, 0 to 1; NaN without ground truth.
    """

    name: str
    cameras: int
    mean_ap: float
    nd_score: float


@dataclass(frozen=True)
class Validation(FrameScores):
    """Scores over all frames of several drives.

    Attributes:
        drives: the scores of each drive alone; empty if they were not asked for.
    """

    drives: tuple[DriveScores, ...] = ()

    def summary(self) -> dict[str, float]:
        """mAP, NDS and mAVE (m/s) over the classes that have ground truth, and IoU by class; NaN if not measured."""
        table = self.detection.overall.of_classes_with_ground_truth()
        iou = {} if self.segmentation is None else self.segmentation.iou
        detection = {"mAP": table.mean_ap, "NDS": table.nd_score, "mAVE": table.errors["vel_err"]}
        return detection | {f"IoU {name}": iou.get(name, math.nan) for name in MAP_CLASSES}

    def row(self) -> dict[str, float]:
        """The columns of validation.csv: the summary, mATE (metres), and AP by class, 0 without ground truth."""
        table = self.detection.overall
        aps = {f"AP {name}": scores.mean_ap for name, scores in table.classes.items()}
        return {**self.summary(), "mATE": table.of_classes_with_ground_truth().errors["trans_err"], **aps}

    def __str__(self) -> str:
        """What is measured of the summary, on one line."""
        return ", ".join(f"{name} {value:.3f}" for name, value in self.summary().items() if not math.isnan(value))

    def to_dict(self) -> dict[str, Any]:
        return super().to_dict() | (finite({"drives": [vars(drive) for drive in self.drives]}) if self.drives else {})

    def table(self) -> str:
        scores = super().table()
        return f"{scores}\n\n{drives_table(self.drives)}" if self.drives else scores


def validate(
    runner: Runner,
    drives: Drives,
    max_range_m: float | None = None,
    after_frame: Callable[[], None] = lambda: None,
    *,
    each_drive: bool = False,
) -> Validation:
    """Runs every frame of the drives and scores the frames that have ground truth.

    Tracks are scored where the runner has a tracker.

    Args:
        max_range_m: ignore boxes beyond this distance, metres; by default beyond the nearest side of the BEV grid.
        each_drive: score each drive alone too.
    """
    range_m = runner.config.bev_grid.nearest_side_m if max_range_m is None else max_range_m
    classes = runner.config.object_classes
    config = DetectionConfig.of(classes).cut_at(range_m)
    tracked = runner.options.tracker is not None
    predictions: list[Boxes3D] = []
    truths: list[Boxes3D] = []
    maps = []
    tracks: list[tuple[FrameBoxes, FrameBoxes]] = []
    of_drives: list[DriveScores] = []
    for index in range(len(drives)):
        sequence, first = drives.open(index), len(truths)
        places, preprocessor = range(len(sequence.stamps)), runner.preprocessor()
        for frame, prediction, _ in runner.run(sequence, places, preprocessor):
            if frame.ground_truth is not None:
                if tracked:
                    # Scenes of different drives may share a name.
                    stamp = replace(frame.stamp, scene=f"{index} {frame.stamp.scene}")
                    sides = (prediction.boxes_world, frame.ground_truth)
                    found, true = (FrameBoxes(stamp, frame.world_from_ego, boxes) for boxes in sides)
                    tracks.append((found, true))
                predicted, truth = boxes_ego(frame, frame.ground_truth, prediction, classes)
                predictions.append(predicted)
                truths.append(truth)
            if prediction.segmentation is not None and frame.ground_truth_map is not None:
                maps.append((prediction.segmentation, frame.ground_truth_map))
            after_frame()
        if each_drive:
            table = evaluate_detections(predictions[first:], truths[first:], config).overall
            table = table.of_classes_with_ground_truth()
            of_drives.append(DriveScores(sequence.name, len(sequence.rig.cameras), table.mean_ap, table.nd_score))
    return Validation(
        evaluate_detections(predictions, truths, config),
        evaluate_segmentation(maps) if maps else None,
        score_results({"tracking": True}, Compared(_pairs(tracks), classes, range_m)) if tracked else {},
        drives=tuple(of_drives),
    )


def drives_table(drives: Sequence[DriveScores]) -> str:
    """A line for each drive, and the mean and the lowest mAP of the drives with ground truth."""
    width = max(len("drive"), *(len(drive.name) for drive in drives))
    lines = [f"{'drive':{width}}  cameras    mAP    NDS"]
    lines += [f"{one.name:{width}}  {one.cameras:7}  {one.mean_ap:.3f}  {one.nd_score:.3f}" for one in drives]
    scored = [one.mean_ap for one in drives if not math.isnan(one.mean_ap)]
    if scored:
        lines.append(f"mAP: mean {fmean(scored):.3f}, lowest {min(scored):.3f}")
    return "\n".join(lines)


def boxes_ego(
    frame: Frame, ground_truth: Boxes3D, prediction: Prediction, classes: Mapping[str, ObjectClass]
) -> tuple[Boxes3D, Boxes3D]:
    """Predicted and ground truth boxes in the ego frame. The model has no attributes: they follow from the speed."""
    predicted = prediction.boxes_ego
    predicted = replace(predicted, attributes=attributes_by_speed(predicted, classes))
    return predicted, ground_truth.transformed(inverse(frame.world_from_ego.matrix))


def _pairs(frames: list[tuple[FrameBoxes, FrameBoxes]]) -> FramePairs:
    """Predicted and true boxes in the world frame, for the scores of tracks."""
    found, true = zip(*frames, strict=True) if frames else ((), ())
    poses = [frame.world_from_ego.matrix for frame in true]
    return FramePairs("world", found, true, np.array(poses).reshape(-1, 4, 4), True, "frame", ())
