"""`stress`: runs a model over the same drives under each condition, scores each, and writes the results."""

import contextlib
import json
from collections.abc import Callable, Iterator, Sequence as Items
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bevcli.errors import InputError, OutputError
from bevcli.evaluation.config import DetectionConfig
from bevcli.evaluation.detection import evaluate_detections
from bevcli.frame import Sequence
from bevcli.geometry.boxes import Boxes3D, attributes_by_speed
from bevcli.geometry.transforms import inverse
from bevcli.inference.load import Model
from bevcli.inference.runner import Runner
from bevcli.runs.folder import RunFolder
from bevcli.runs.state import DIGITS, digest, load_state, run_facts, save_state, saved_state
from bevcli.sequences.open import scenes_of, select
from bevcli.workshop.calibration.calibrate import CorrectedDrive, calibrate
from bevcli.workshop.robustness.conditions import KEPT_BYTES, Condition, KeptFrames, choose_conditions
from bevcli.workshop.robustness.options import StressOptions
from bevcli.workshop.robustness.results import ConditionScores, StressResults, read_results
from bevcli.writing import write_whole

RESULTS = "stress.json"
# Predicted boxes and ground truth of each scored frame of a scene, in the ego frame.
SceneBoxes = tuple[tuple[Boxes3D, Boxes3D], ...]
_INPUT_FACTS = ("frames of the input", "calibration", "files of the input")


@dataclass(frozen=True)
class StressState:
    """A test after a number of finished conditions, for `resume`."""

    facts: dict[str, str]  # what the results depend on, see `run_facts`
    scores: tuple[ConditionScores, ...] = ()  # of the finished conditions


class _Stopped(Exception):
    """The caller has asked to stop."""


def stress(
    model: Model,
    drives: Items[Sequence],
    conditions: Items[Condition],
    out: Path,
    options: StressOptions = StressOptions(),
    *,
    force: bool = False,
    resume: bool = False,
    after_frame: Callable[[], None] = lambda: None,
    resumed: Callable[[int], None] = lambda frames: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> StressResults:
    """Scores a model on the same drives under each condition.

    The results are written after each condition, those of a scene at its end: an interrupted test can go on. The same
    drives, model, options and conditions give the same stress.json, byte by byte, also if the test was interrupted.

    Args:
        model: of `load_model`.
        drives: of `open_sequence`, with ground truth.
        conditions: of `choose_conditions`. Results of an earlier, resumed test are kept.
        out: the folder for stress.json; made where it is missing.
        options: see `StressOptions`.
        force: remove the files that an earlier test wrote into `out`.
        resume: go on with an interrupted test; it may get further conditions.
        after_frame: called after each frame.
        resumed: called once with the number of frames that need not be run again.
        should_stop: asked after each frame; True ends the test. The results are then not complete.

    Raises:
        InputError: a frame cannot be read, or a drive has no ground truth.
        OutputError: the folder holds something already, is in use, or cannot be written; or the test to resume was
            another one.
    """
    if force and resume:
        raise OutputError("`force` and `resume` exclude each other: pass one of them")
    model = model.in_engine(drives[0].rig, drives[0])
    parts = [part for drive in drives for part in split_scenes(drive)]
    scenes = [KeptFrames(part, KEPT_BYTES // len(parts)) for part in parts]
    against = None if options.against is None else read_results(options.against)
    facts = _facts(model, drives, replace(options, against=None))
    with RunFolder(out, force=force, resume=resume) as folder:
        state = saved_state(folder, facts, StressState) if resume else None
        if state is None:
            folder.remove_written()
            state = StressState(facts)
            save_state(folder.state_path, state)
        run = _StressRun(model, scenes, options, folder, after_frame, should_stop)
        finished = {(scores.corruption, scores.severity) for scores in state.scores}
        left = [condition for condition in conditions if (condition.name, condition.severity) not in finished]
        done = run.kept_frames(left) + (len(conditions) - len(left)) * sum(len(scene.stamps) for scene in scenes)
        if done:
            resumed(done)
        results = StressResults(run.header(), state.scores, is_complete=False)
        with contextlib.suppress(_Stopped):
            for condition in left:
                scores = (*results.scores, run.scores(condition))
                results = replace(results, scores=tuple(sorted(scores, key=_order)))
                save_state(folder.state_path, StressState(facts, results.scores))
                _write_results(folder, results, against)
                run.remove_boxes(condition)
            results = replace(results, is_complete=True)
        _write_results(folder, results, against)
    return results


@dataclass
class _StressRun:
    """One model, its scenes, and the folder in which finished scenes of the current condition are kept."""

    model: Model
    scenes: Items[Sequence]
    options: StressOptions
    folder: RunFolder
    after_frame: Callable[[], None]
    should_stop: Callable[[], bool]
    runner: Runner | None = None

    def __post_init__(self) -> None:
        self.range_m = self.options.max_range_m or self.model.config.bev_grid.nearest_side_m
        self.metrics = DetectionConfig.of(self.model.config.object_classes).cut_at(self.range_m)

    def header(self) -> dict[str, Any]:
        """A description of the test for stress.json. It names no folders, so that the file is the same everywhere."""
        weights = self.model.weights
        return {
            "model": self.model.name,
            "weights": {"file": weights.name if weights else "random", "hash": self.model.weights_hash[:DIGITS]},
            "precision": self.model.precision,
            "temporal": self.options.temporal,
            "seed": self.options.seed,
            "lost_images": self.options.lost_images,
            "max_range_m": self.range_m,
            "drives": [{"name": s.name, "scene": s.stamps[0].scene, "frames": len(s.stamps)} for s in self.scenes],
        }

    def kept_frames(self, left: Items[Condition]) -> int:
        """The number of frames of the first condition that is left whose boxes are stored."""
        scenes = [scene for n, scene in enumerate(self.scenes) if left and self._boxes_path(left[0], n).exists()]
        return sum(len(scene.stamps) for scene in scenes)

    def scores(self, condition: Condition) -> ConditionScores:
        """Raises _Stopped."""
        frames = [frame for index in range(len(self.scenes)) for frame in self._scene_boxes(condition, index)]
        predictions, truths = zip(*frames, strict=True)
        table = evaluate_detections(predictions, truths, self.metrics).overall.of_classes_with_ground_truth()
        aps = {name: scores.mean_ap for name, scores in table.classes.items()}
        return ConditionScores(condition.name, condition.severity, table.nd_score, table.mean_ap, table.errors, aps)

    def remove_boxes(self, condition: Condition) -> None:
        for index in range(len(self.scenes)):
            self._boxes_path(condition, index).unlink(missing_ok=True)

    def _boxes_path(self, condition: Condition, index: int) -> Path:
        name = "-".join(("boxes", condition.name, condition.severity or "0", str(index)))
        return self.folder.state_path.with_name(f"{name}.safetensors")

    def _scene_boxes(self, condition: Condition, index: int) -> SceneBoxes:
        """The boxes of a scene: read if they are there already, else computed and stored."""
        path = self._boxes_path(condition, index)
        if path.exists():
            return load_state(path, SceneBoxes)
        scene = self.scenes[index]
        boxes: SceneBoxes = ()
        for part in condition.sequences(scene, self.options.seed, self.options.lost_images):
            boxes += tuple(self._run_sequence(_calibrated(part) if self.options.calibrate else part))
        if not boxes:
            raise InputError(f"{scene.name}: has no ground truth (expected boxes to score against)")
        self.folder.add(path)
        save_state(path, boxes)
        return boxes

    def _run_sequence(self, sequence: Sequence) -> Iterator[tuple[Boxes3D, Boxes3D]]:
        model = self.model
        if self.runner is None:
            self.runner = model.runner(track=False, temporal=self.options.temporal)
        steps = self.runner.run(sequence, range(len(sequence.stamps)), self.runner.preprocessor())
        for frame, prediction, _ in steps:
            if frame.ground_truth is not None:
                predicted = prediction.boxes_ego  # the model has no attributes: they follow from the speed
                predicted = replace(predicted, attributes=attributes_by_speed(predicted, self.metrics.classes))
                yield predicted, frame.ground_truth.transformed(inverse(frame.world_from_ego.matrix))
            self.after_frame()
            if self.should_stop():
                raise _Stopped


def _calibrated(sequence: Sequence) -> Sequence:
    """The sequence with the rig that it shows; itself where it shows none."""
    try:
        return CorrectedDrive(sequence, calibrate(sequence))
    except InputError:
        return sequence


def split_scenes(drive: Sequence) -> list[Sequence]:
    """One sequence per scene. Raises InputError if the drive has no frames."""
    if not drive.stamps:
        raise InputError(f"{drive.name}: has no frames")
    return [select(drive, indices) for indices in scenes_of(drive.stamps)]


def _order(scores: ConditionScores) -> int:
    """Clean first, then as in CORRUPTIONS."""
    conditions = [(condition.name, condition.severity) for condition in choose_conditions()]
    return conditions.index((scores.corruption, scores.severity))


def _facts(model: Model, drives: Items[Sequence], options: StressOptions) -> dict[str, str]:
    """The facts that the results depend on, apart from the conditions."""
    of_drives = [run_facts(model, drive, options) for drive in drives]
    facts = dict(of_drives[0])
    if len(of_drives) > 1:
        facts |= {name: digest(tuple(of_drive[name] for of_drive in of_drives))[:12] for name in _INPUT_FACTS}
    return facts | {"drives": ", ".join(drive.name for drive in drives)}


def _write_results(folder: RunFolder, results: StressResults, against: StressResults | None) -> None:
    path = folder.path / RESULTS
    folder.add(path)
    write_whole(path, (json.dumps(results.to_dict(against), indent=1) + "\n").encode())
