"""Checks of drives before they are trained on or scored, scores of a model over several drives, and learning curves.

Each drive is run as by `bevcli run`, and all are scored as by `bevcli eval`.
"""

import contextlib
import csv
import importlib.util
import io
import logging
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bevcli.errors import BevcliError, InputError
from bevcli.frame import MAP_CLASSES, Drive, Frame, Prediction
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.inference.runner import Runner
from bevcli.model.config import ModelConfig
from bevcli.parsing.files import MIB, read_text
from bevcli.printing import aligned, counted, one_line
from bevcli.sequences.files.boxes_file import ClassNames, FrameBoxes
from bevcli.sequences.native.folder import BOXES_FILE
from bevcli.sequences.open import count_labels, scenes_of
from bevcli.workshop.scores.detection import DetectionConfig, evaluate_detections
from bevcli.workshop.scores.evaluate import FrameScores, boxes_ego, evaluate_segmentation, finite
from bevcli.workshop.scores.inputs import Compared, FramePairs
from bevcli.workshop.scores.tracking import score_tracks
from bevcli.workshop.synth import DriveOptions
from bevcli.workshop.synth.drives import FRAMES_PER_DRIVE, Drives
from bevcli.workshop.training.samples import ClipConfig
from bevcli.writing import output_errors, whole_file


def check_training_drives(
    data: DriveOptions, drives: Drives, held_out: Drives | None, clips: ClipConfig, config: ModelConfig
) -> tuple[str, ...]:
    """Notes about the drives of a training, each set once. Renders no drive.

    drives: to train on. held_out: to score on; None for the same drives.
    Raises InputError where a frame to train on has no ground truth or a drive is shorter than a clip, and as
    `check_classes`.
    """
    if data.rendered is not None:
        if clips.frames > FRAMES_PER_DRIVE:
            raise _too_short(f"rendered drives ({FRAMES_PER_DRIVE})", clips.frames, FRAMES_PER_DRIVE)
        _check_rendered_classes(data.class_map, config)
        return ()
    lengths = {drive.name: longest_scene(drive) for drive in map(drives.open, range(len(drives)))}
    short = {name: frames for name, frames in lengths.items() if frames < clips.frames}
    if short:
        named = ", ".join(f"{name} ({frames})" for name, frames in short.items())
        raise _too_short(named, clips.frames, min(short.values()))
    _check_ground_truth(drives, clips)
    notes = [*check_classes(drives, f"{_count(drives)} to train on", "trained on", config)]
    if held_out is not None:
        notes += check_classes(held_out, f"{_count(held_out)} to score on", "scored", config)
    return tuple(notes)


def check_scored_drives(data: DriveOptions, drives: Drives, config: ModelConfig) -> tuple[str, ...]:
    """Notes about drives that are scored. Renders no drive. Raises InputError as `check_classes`."""
    if data.rendered is not None:
        _check_rendered_classes(data.class_map, config)
        return ()
    return tuple(check_classes(drives, _count(drives), "scored", config))


def check_classes(drives: Drives, described: str, use: str, config: ModelConfig) -> Iterator[str]:
    """Notes about the classes in the ground truth of drives: boxes that are left out, and classes without a box.

    Args:
        drives: folders; opens each of them, and reads the frames of a format that has no table of its boxes.
        described: the set of drives, for messages, such as "the 4 held-out drives".
        use: what happens to boxes of known classes: "trained on" or "scored".

    Raises InputError where no box has a class of the model.
    """
    counts: Counter[str] = Counter()
    for drive in map(drives.open, range(len(drives))):
        counts.update(count_labels(drive))
    absent = [name for name in config.classes if not counts[name]]
    if counts and len(absent) == len(config.classes):
        named = ", ".join(f"{name} ({count})" for name, count in sorted(counts.items()))
        raise _no_known_class(f"the ground truth of {described}", named, counts.most_common(1)[0][0], config)
    yield from ClassNames(classes=config.classes).note(counts, described, use)
    if counts and absent:
        yield f"{described}: no box has the class {' or '.join(absent)} of the model {config.name}"


def _check_rendered_classes(class_map: Mapping[str, str], config: ModelConfig) -> None:
    names = ClassNames(class_map, config.classes)
    if not {names[name] for name in NUSCENES_CLASSES} & set(config.classes):
        raise _no_known_class("the ground truth of rendered drives", ", ".join(NUSCENES_CLASSES), "car", config)


def _check_ground_truth(drives: Drives, clips: ClipConfig) -> None:
    first = clips.frames - 1 if clips.learn == "last" and clips.short_share == 0 else 0
    for drive in map(drives.open, range(len(drives))):
        indices = [index for scene in scenes_of(drive.stamps) for index in scene[first:]]
        frames = map(drive.ground_truth_frame, indices)
        missing = [frame.stamp.index for frame in frames if frame.ground_truth is None]
        if missing:
            raise InputError(
                f"{drive.name}: {len(missing)} of {len(indices)} frames to train on have no ground truth boxes, "
                f"the first is frame {missing[0]}: add them to {BOXES_FILE}, or remove the frames"
            )


def longest_scene(drive: Drive) -> int:
    """The number of frames of the longest scene of a drive."""
    return max(map(len, scenes_of(drive.stamps)), default=0)


def _count(drives: Drives) -> str:
    return "the drive" if len(drives) == 1 else f"the {len(drives)} drives"


def _too_short(drives: str, clip_frames: int, frames: int) -> InputError:
    return InputError(
        f"drives with fewer frames than a clip, {clip_frames} at the model's frame rate: {drives}: leave them out, or "
        f'pass `changes={{"clips.frames": {frames}}}` (`--set clips.frames={frames}`)'
    )


def _no_known_class(described: str, named: str, example: str, config: ModelConfig) -> InputError:
    return InputError(
        f"{described} has no class of the model {config.name} (expected {', '.join(config.classes)}; found {named}): "
        f"pass `class_map={{{example!r}: {config.classes[0]!r}}}` (`--class-map {example}={config.classes[0]}`), or "
        "set classes in the model's file"
    )


@dataclass(frozen=True)
class DriveScores:
    """The detection scores of one drive alone, over the classes that it has."""

    name: str  # of the drive
    cameras: int  # the number of its cameras
    mean_ap: float  # mAP, 0 to 1; NaN without ground truth
    nd_score: float  # NDS, 0 to 1; NaN without ground truth


@dataclass(frozen=True)
class Validation(FrameScores):
    """Scores over all frames of several drives."""

    drives: tuple[DriveScores, ...] = ()  # the scores of each drive alone; empty if they were not asked for

    def summary(self) -> dict[str, float]:
        """mAP, NDS and mAVE (m/s) over the classes that have ground truth, NaN without any; IoU by class, of a map."""
        table = self.detection.overall.of_classes_with_ground_truth()
        iou = {} if self.segmentation is None else self.segmentation.iou
        detection = {"mAP": table.mean_ap, "NDS": table.nd_score, "mAVE": table.errors["vel_err"]}
        return detection | {f"IoU {name}": iou[name] for name in MAP_CLASSES if name in iou}

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


ScoredFrame = tuple[int, Frame, Prediction]  # index of the drive, the frame, and what the model predicts


def run_drives(runner: Runner, drives: Drives) -> Iterator[ScoredFrame]:
    """Run every frame of the drives. A drive that lacks images gets a warning: what they show is missed."""
    for index in range(len(drives)):
        drive, missing = drives.open(index), 0
        for frame, prediction, _ in runner.run(drive):
            missing += len(frame.dropped)
            yield index, frame, prediction
        if missing:
            words = f"{drive.name}: {counted(missing, 'images')} cannot be read: what they show counts as missed"
            logging.getLogger("bevcli").warning("warning: %s", one_line(words))


def score_drives(
    runner: Runner,
    drives: Drives,
    max_range_m: float | None = None,
    *,
    each_drive: bool = False,
    frames: Iterable[ScoredFrame] | None = None,
) -> Validation:
    """The scores over the frames that have ground truth. Tracks are scored where the runner has a tracker.

    Args:
        max_range_m: ignore boxes beyond this distance, metres; by default beyond the nearest side of the BEV grid.
        each_drive: score each drive alone too.
        frames: of `run_drives`, the default; none is kept.
    """
    range_m = runner.config.bev_grid.nearest_side_m if max_range_m is None else max_range_m
    classes = runner.config.object_classes
    config = DetectionConfig.of(classes).cut_at(range_m)
    tracked = runner.tracker is not None
    boxes: list[list[tuple[Boxes3D, Boxes3D]]] = [[] for _ in range(len(drives))]
    maps = []
    tracks: list[tuple[FrameBoxes, FrameBoxes]] = []
    for index, frame, prediction in run_drives(runner, drives) if frames is None else frames:
        if frame.ground_truth is not None:
            if tracked:
                # Scenes of different drives may share a name.
                stamp = replace(frame.stamp, scene=f"{index} {frame.stamp.scene}")
                sides = (prediction.boxes_world, frame.ground_truth)
                predicted, true = (FrameBoxes(stamp, frame.world_from_ego, side) for side in sides)
                tracks.append((predicted, true))
            boxes[index].append(boxes_ego(frame, frame.ground_truth, prediction, classes))
        if prediction.segmentation is not None and frame.ground_truth_map is not None:
            maps.append((prediction.segmentation, frame.ground_truth_map))
    of_drives = []
    for drive, of_drive in zip(map(drives.open, range(len(drives))), boxes, strict=True) if each_drive else ():
        table = evaluate_detections(*_sides(of_drive), config).overall.of_classes_with_ground_truth()
        of_drives.append(DriveScores(drive.name, len(drive.rig.cameras), table.mean_ap, table.nd_score))
    return Validation(
        evaluate_detections(*_sides([pair for of_drive in boxes for pair in of_drive]), config),
        evaluate_segmentation(maps) if maps else None,
        score_tracks(Compared(_pairs(tracks), classes, range_m)) if tracked else None,
        drives=tuple(of_drives),
    )


def _sides(pairs: list[tuple[Boxes3D, Boxes3D]]) -> tuple[list[Boxes3D], list[Boxes3D]]:
    return [predicted for predicted, _ in pairs], [true for _, true in pairs]


def drives_table(drives: Sequence[DriveScores]) -> str:
    """A line for each drive, and the mean and the lowest mAP of the drives with ground truth."""
    rows = [(x.name, str(x.cameras), f"{x.mean_ap:.3f}", f"{x.nd_score:.3f}") for x in drives]
    scored = [drive.mean_ap for drive in drives if not math.isnan(drive.mean_ap)]
    below = f"\nmAP: mean {fmean(scored):.3f}, lowest {min(scored):.3f}" if scored else ""
    return aligned([("drive", "cameras", "mAP", "NDS"), *rows]) + below


def _pairs(frames: list[tuple[FrameBoxes, FrameBoxes]]) -> FramePairs:
    """Predicted and true boxes in the world frame, for the scores of tracks."""
    predicted, true = zip(*frames, strict=True) if frames else ((), ())
    poses = [frame.world_from_ego.matrix for frame in true]
    return FramePairs("world", predicted, true, np.array(poses).reshape(-1, 4, 4), True, "frame", ())


LARGEST_CSV_BYTES = 256 * MIB
Row = Mapping[str, float]


class LearningCurve:
    """A CSV file with a column `step` and one row a step, and TensorBoard's curves of the same numbers.

    Attributes:
        path: the file.
        rows: its rows.
    """

    def __init__(self, path: Path, done: int = 0, group: str = "", events: Any = None) -> None:
        """Opens the file of a resumed training, or starts a new one.

        done: steps done. Rows after them, of an interrupted run, are dropped; 0 starts a new file.
        group: of the curves in TensorBoard, before their names. events: of `event_writer`; None for no such curves.
        Raises OutputError, and InputError for a damaged file.
        """
        self.path, self._group, self._events = path, group, events
        self.rows: list[Row] = [row for row in _read_rows(path) if row["step"] <= done] if done else []
        with whole_file(path) as unfinished:
            _write_rows(unfinished, self.rows, "w")

    def add(self, step: int, numbers: Row) -> None:
        """Appends a row and writes it to the files at once, finite numbers only for TensorBoard."""
        row = dict.fromkeys(self.rows[0] if self.rows else (), math.nan) | {"step": step, **numbers}
        _write_rows(self.path, [row], "a", header=not self.rows)
        self.rows.append(row)
        if self._events is not None:
            for name, value in numbers.items():
                if math.isfinite(value):
                    self._events.add_scalar(f"{self._group}/{name}", value, step)
            self._events.flush()


def draw_learning_curves(loss: LearningCurve, validation: LearningCurve, path: Path) -> None:
    """Writes a PNG: smoothed losses on the left, scores on the right."""
    figure = Figure(figsize=(12, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    rows, size = loss.rows, max(1, len(loss.rows) // 200)  # of the blocks whose means are drawn
    blocks = [rows[start : start + size] for start in range(0, len(rows) - size + 1, size)]
    smooth: list[Row] = [{name: sum(row[name] for row in block) / size for name in block[0]} for block in blocks]
    _draw_rows(left, smooth, skipped=("step", "learning rate", "gradient norm"))
    shown = ("step", "mAP", "NDS")
    scores: list[Row] = [{k: v for k, v in row.items() if k in shown or k.startswith("IoU")} for row in validation.rows]
    _draw_rows(right, scores, skipped=("step",), marker="o")
    left.set(title="Training loss", xlabel="step", yscale="log")
    right.set(title="Validation", xlabel="step")
    right.set_ylim(bottom=0)
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, dpi=110)


def _draw_rows(axes: Any, rows: list[Row], skipped: tuple[str, ...], marker: str = "") -> None:
    for name in rows[0] if rows else ():
        values = [row[name] for row in rows]
        if name not in skipped and not all(map(math.isnan, values)):
            axes.plot([row["step"] for row in rows], values, label=name, marker=marker)
    if rows:
        axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))  # beside the curves
    axes.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
    axes.grid(alpha=0.3)


def _read_rows(path: Path) -> list[Row]:
    """The rows of a file, without damaged ones. Raises InputError."""
    if not path.is_file():
        return []
    text = read_text(path, LARGEST_CSV_BYTES)
    rows: list[Row] = []
    try:
        for row in csv.DictReader(io.StringIO(text)):
            with contextlib.suppress(ValueError, TypeError):  # half a row, from a full disk
                rows.append({name: float(value) for name, value in row.items()})
    except csv.Error as error:
        raise InputError(f"{path}: {error}: move it away, or start a new training") from None
    if rows and "step" not in rows[0]:
        raise InputError(f"{path}: has no column step: move it away, or start a new training")
    return rows


def _write_rows(path: Path, rows: list[Row], mode: str, *, header: bool = True) -> None:
    with output_errors(path), path.open(mode, newline="", encoding="utf-8") as file:
        if rows:
            writer = csv.DictWriter(file, list(rows[0]))
            if header:
                writer.writeheader()
            writer.writerows({name: f"{value:.6g}" for name, value in row.items()} for row in rows)


def require_tensorboard() -> None:
    """Raise BevcliError where the package tensorboard is not installed."""
    if importlib.util.find_spec("tensorboard") is None:
        raise BevcliError(
            '`log="tensorboard"` (`--log tensorboard`) needs the package tensorboard: '
            "pip install 'bevcli[tensorboard]'"
        )


def event_writer(folder: Path, done: int) -> Any:
    """A writer of event files: `tensorboard --logdir FOLDER` draws them, also while the training runs.

    done: steps done. TensorBoard hides later ones, of an interrupted training.
    """
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=done + 1 if done else None)
