"""`stress`: runs a model over the same drives under each condition, scores each, and writes the results."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Items
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bevcli.errors import InputError, OutputError
from bevcli.evaluation.config import DetectionConfig
from bevcli.evaluation.detection import evaluate_detections
from bevcli.frame import Sequence
from bevcli.geometry.boxes import Boxes3D
from bevcli.pipeline.model_loading import Model
from bevcli.pipeline.preprocess import Preprocessor
from bevcli.pipeline.run_folder import RunFolder
from bevcli.pipeline.run_state import saved_state
from bevcli.pipeline.runner import Runner, StepOptions
from bevcli.pipeline.state_file import load_state, save_state
from bevcli.robustness.conditions import CORRUPTIONS, Condition, choose_conditions
from bevcli.robustness.contact_sheet import SheetOptions
from bevcli.robustness.lost_images import LostImage
from bevcli.robustness.results import ConditionScores, StressResults
from bevcli.robustness.sequences import FrameStore, KeptFrames, split_scenes
from bevcli.robustness.stress_files import StressState, stress_facts, write_figures, write_results
from bevcli.training.validation import boxes_ego


@dataclass(frozen=True)
class StressOptions:
    """How a stress test is made.

    Attributes:
        seed: of all random numbers, 0 or greater.
        lost_images: what the model gets for a lost image.
        temporal: whether the previous BEV map is used.
        max_range_m: boxes beyond this distance are ignored, metres; by default beyond the nearest side of the BEV grid.
    """

    seed: int = 0
    lost_images: LostImage = "black"
    temporal: bool = True
    max_range_m: float | None = None


@dataclass(frozen=True)
class SceneBoxes:
    """The boxes of the F scored frames of a scene, in the ego frame.

    Attributes:
        predictions: F times the predicted boxes.
        ground_truth: F times the ground truth.
    """

    predictions: tuple[Boxes3D, ...]
    ground_truth: tuple[Boxes3D, ...]


class _Stopped(Exception):
    """The caller has asked to stop."""


def stress(
    model: Model,
    drives: Items[Sequence],
    conditions: Items[Condition],
    out: Path,
    options: StressOptions = StressOptions(),
    *,
    against: StressResults | None = None,
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
        out: the folder for stress.json and, when the test is complete, stress.png and corruptions.png; made where it is
            missing.
        options: see `StressOptions`.
        against: another run's results, for corruption errors.
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
        raise OutputError("--force and --resume exclude each other: pass one of them")
    store = FrameStore()
    scenes = [KeptFrames(scene, store) for drive in drives for scene in split_scenes(drive)]
    facts = stress_facts(model, drives, options)
    with RunFolder(out, force=force, resume=resume) as folder:
        state = saved_state(folder, facts, StressState, "a stress test") if resume else None
        if state is None:
            folder.remove_written()
            state = StressState(facts)
            save_state(folder.state_path, state)
        test = _Test(model, scenes, options, folder, after_frame, should_stop)
        header = test.header(facts)
        done = test.done_frames(conditions, state)
        if done:
            resumed(done)
        is_complete = True
        try:
            for condition in conditions:
                if not state.has(condition):
                    state = StressState(facts, _in_order((*state.scores, test.run(condition))))
                    save_state(folder.state_path, state)
                    write_results(folder, StressResults(header, state.scores, is_complete=False), against)
                    test.remove_boxes(condition)
        except _Stopped:
            is_complete = False
        results = StressResults(header, state.scores, is_complete)
        write_results(folder, results, against)
        if is_complete:
            shown = [each for each in choose_conditions() if state.has(each)]
            sheet = SheetOptions(options.seed, options.lost_images, place=len(scenes[0].stamps) // 2)
            write_figures(folder, results, against, scenes[0], shown, sheet)
    return results


class _Test:
    """One model, its scenes, and the folder in which finished scenes of the current condition are kept."""

    def __init__(
        self,
        model: Model,
        scenes: Items[Sequence],
        options: StressOptions,
        folder: RunFolder,
        after_frame: Callable[[], None],
        should_stop: Callable[[], bool],
    ) -> None:
        self._model, self._scenes, self._options, self._folder = model, scenes, options, folder
        self._after_frame, self._should_stop = after_frame, should_stop
        range_m = options.max_range_m or model.config.bev_grid.nearest_side_m
        self._range_m = range_m
        self._metrics = DetectionConfig().cut_at(range_m)
        self._runner: Runner | None = None

    def header(self, facts: dict[str, str]) -> dict[str, Any]:
        """What was tested, for stress.json. It names no folders, so that the file is the same everywhere."""
        weights = self._model.weights
        return {
            "model": self._model.name,
            "weights": {
                "file": "random" if weights is None else weights.name,
                "hash": facts["weights"].split(", ")[-1],
            },
            "precision": self._model.precision,
            "temporal": self._options.temporal,
            "seed": self._options.seed,
            "lost_images": self._options.lost_images,
            "max_range_m": self._range_m,
            "drives": [
                {"name": scene.name, "scene": scene.stamps[0].scene, "frames": len(scene.stamps)}
                for scene in self._scenes
            ],
        }

    def done_frames(self, conditions: Items[Condition], state: StressState) -> int:
        """The number of frames of these conditions that need not be run again."""
        each = [len(scene.stamps) for scene in self._scenes]
        finished = sum(state.has(condition) for condition in conditions) * sum(each)
        kept = next((condition for condition in conditions if not state.has(condition)), None)
        if kept is None:
            return finished
        return finished + sum(n for place, n in enumerate(each) if self._boxes_path(kept, place).exists())

    def run(self, condition: Condition) -> ConditionScores:
        """The scores under a condition. Raises _Stopped."""
        boxes = [self._scene_boxes(condition, place) for place in range(len(self._scenes))]
        predictions = [frame for scene in boxes for frame in scene.predictions]
        truths = [frame for scene in boxes for frame in scene.ground_truth]
        table = evaluate_detections(predictions, truths, self._metrics).overall.of_classes_with_ground_truth()
        aps = {name: scores.mean_ap for name, scores in table.classes.items()}
        return ConditionScores(condition.name, condition.severity, table.mean_ap, table.nd_score, table.errors, aps)

    def remove_boxes(self, condition: Condition) -> None:
        """Removes the stored boxes of a finished condition."""
        for place in range(len(self._scenes)):
            self._boxes_path(condition, place).unlink(missing_ok=True)

    def _boxes_path(self, condition: Condition, place: int) -> Path:
        name = "-".join(("boxes", condition.name, condition.severity or "0", str(place)))
        return self._folder.state_path.with_name(f"{name}.safetensors")

    def _scene_boxes(self, condition: Condition, place: int) -> SceneBoxes:
        """The boxes of a scene: read if they are there already, else computed and stored."""
        path = self._boxes_path(condition, place)
        if path.exists():
            kept: SceneBoxes = load_state(path)
            return kept
        scene = self._scenes[place]
        parts = [
            self._run_sequence(part)
            for part in condition.sequences(scene, self._options.seed, self._options.lost_images)
        ]
        boxes = SceneBoxes(
            tuple(frame for part in parts for frame in part.predictions),
            tuple(frame for part in parts for frame in part.ground_truth),
        )
        if not boxes.ground_truth:
            raise InputError(f"{scene.name}: has no ground truth (expected boxes to score against)")
        self._folder.add(path)
        save_state(path, boxes)
        return boxes

    def _run_sequence(self, sequence: Sequence) -> SceneBoxes:
        model = self._model
        if self._runner is None:
            self._runner = Runner(model.prepared, model.device, StepOptions(model.precision, self._options.temporal))
        predictions, truths = [], []
        steps = self._runner.run(sequence, range(len(sequence.stamps)), Preprocessor(model.config))
        for frame, prediction, _ in steps:
            if frame.ground_truth is not None:
                predicted, truth = boxes_ego(frame, frame.ground_truth, prediction)
                predictions.append(predicted)
                truths.append(truth)
            self._after_frame()
            if self._should_stop():
                raise _Stopped
        return SceneBoxes(tuple(predictions), tuple(truths))


def _in_order(scores: Items[ConditionScores]) -> tuple[ConditionScores, ...]:
    """Clean first, then as in CORRUPTIONS."""
    order = {("clean", ""): -1}
    for corruption in CORRUPTIONS:
        for severity in corruption.levels:
            order[corruption.name, severity] = len(order)
    return tuple(sorted(scores, key=lambda each: order[each.corruption, each.severity]))
