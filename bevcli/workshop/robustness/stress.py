"""`stress`: runs a model over the same drives under each condition and scores each; stress.json and its table."""

import contextlib
import json
import math
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import msgspec

from bevcli.errors import InputError, OutputError
from bevcli.frame import Drive
from bevcli.geometry.boxes import Boxes3D
from bevcli.inference import StepOptions
from bevcli.inference.load import Model
from bevcli.inference.runner import Runner
from bevcli.model.config import ModelConfig
from bevcli.parsing.documents import read_json
from bevcli.printing import aligned
from bevcli.runs.state import DIGITS, RunFolder, digest, load_state, run_fingerprint, save_state, saved_state
from bevcli.sequences.open import DriveView, scenes_of, select, select_range
from bevcli.sequences.options import InputOptions
from bevcli.workshop.calibration.calibrate import calibrate
from bevcli.workshop.robustness import StressOptions
from bevcli.workshop.robustness.conditions import CLEAN, CORRUPTIONS, Condition, Corruption, Group, choose_conditions
from bevcli.workshop.scores.detection import DetectionConfig, evaluate_detections, known_mean
from bevcli.workshop.scores.evaluate import boxes_ego, finite
from bevcli.workshop.synth import DriveOptions
from bevcli.workshop.synth.drives import FrameMemory, KeptFrames, RenderedDrives
from bevcli.writing import write_whole

RESULTS, FORMAT = "stress.json", "bevcli-stress/1"
# Predicted boxes and ground truth of each scored frame of a scene, in the ego frame.
SceneBoxes = tuple[tuple[Boxes3D, Boxes3D], ...]
KEPT_BYTES = 1 << 30  # decoded images that are kept in memory, of all scenes together
_INPUT_KEYS = ("frames of the input", "calibration", "files of the input")


@dataclass(frozen=True)
class ConditionScores:
    """An entry of "conditions" in stress.json: scores over the classes that have ground truth."""

    corruption: str  # name, or "clean"
    severity: str  # "easy", "mid", "hard" or a level; "" for clean
    nd_score: float  # NDS, 0 to 1
    mean_ap: float  # mAP, 0 to 1
    tp_errors: Mapping[str, float | None]  # by the devkit's names; NaN (None of a file) if undefined
    mean_dist_aps: Mapping[str, float]  # class -> AP


@dataclass(frozen=True)
class StressResults:
    """The scores of a model under several conditions."""

    header: Mapping[str, Any]  # what was tested, such as model, weights, drives, seed; for JSON
    scores: tuple[ConditionScores, ...]  # by condition, clean first
    is_complete: bool = True  # whether all requested conditions were run

    @property
    def clean(self) -> ConditionScores | None:
        """The scores without corruption; None if they are not there yet."""
        return next((scores for scores in self.scores if scores.corruption == CLEAN.name), None)

    def of(self, name: str) -> dict[str, ConditionScores]:
        """Severity -> scores of a corruption, in the order of the severities."""
        return {scores.severity: scores for scores in self.scores if scores.corruption == name}

    def tested(self) -> tuple[Corruption, ...]:
        """The corruptions that have scores, in their order."""
        return tuple(corruption for corruption in CORRUPTIONS if self.of(corruption.name))

    def resilience(self, name: str) -> float:
        """Resilience rate of a corruption: its mean NDS over its severities, over the NDS of clean drives."""
        severities = self.of(name).values()
        if self.clean is None or not severities or not self.clean.nd_score:
            return math.nan
        return sum(scores.nd_score for scores in severities) / len(severities) / self.clean.nd_score

    def corruption_error(self, name: str, against: Self) -> float:
        """Corruption error: the sum of 1 - NDS over the severities that both runs have, over that of the other run."""
        scores, other = self.of(name), against.of(name)
        common = [severity for severity in scores if severity in other]
        below = sum(1 - other[severity].nd_score for severity in common)
        return sum(1 - scores[severity].nd_score for severity in common) / below if below else math.nan

    def mean_resilience(self, group: Group = Group.ROBOBEV) -> float:
        """The mean resilience rate of a group's corruptions that were tested, RoboBEV's mRR; NaN without any."""
        return known_mean(self.resilience(part.name) for part in self.tested() if part.group is group)

    def mean_corruption_error(self, against: Self) -> float:
        """mCE: the mean corruption error of RoboBEV's corruptions that both runs have; NaN without any."""
        return known_mean(
            self.corruption_error(part.name, against) for part in self.tested() if part.group is Group.ROBOBEV
        )

    def to_dict(self, against: Self | None = None) -> dict[str, Any]:
        """All of it for JSON; undefined numbers are None. docs/robustness.md explains the keys."""
        names = [corruption.name for corruption in self.tested()]
        content: dict[str, Any] = {
            "format": FORMAT,
            **self.header,
            "complete": self.is_complete,
            "conditions": [vars(scores) for scores in self.scores],
            "resilience": {name: self.resilience(name) for name in names},
            "mRR": self.mean_resilience(),
            "mean_resilience_unseen": self.mean_resilience(Group.UNSEEN),
        }
        if against is not None:
            content["against"] = {name: against.header.get(name) for name in ("model", "weights")}
            content["corruption_error"] = {name: self.corruption_error(name, against) for name in names}
            content["mCE"] = self.mean_corruption_error(against)
        return finite(content)

    def differences(self, other: Self) -> tuple[str, ...]:
        """Settings other than model and weights that differ between the tests: their scores cannot be compared."""
        names = ("drives", "max_range_m", "seed", "lost_images")
        return tuple(name for name in names if self.header.get(name) != other.header.get(name))


def read_results(path: Path) -> StressResults:
    """Reads a stress.json. Raises InputError where it is missing or wrong."""
    content = read_json(path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f'{path}: is no result of `bevcli stress` (expected "format": "{FORMAT}")')
    try:
        scores = msgspec.convert(content["conditions"], tuple[ConditionScores, ...])
    except (KeyError, msgspec.ValidationError) as error:
        raise InputError(f'{path}: "conditions" is wrong ({type(error).__name__}: {error})') from None
    return StressResults(content, scores, content.get("complete") is True)


@dataclass(frozen=True)
class StressState:
    """A test after a number of finished conditions, for `resume`."""

    fingerprint: dict[str, str]  # see `run_fingerprint`
    scores: tuple[ConditionScores, ...] = ()  # of the finished conditions


def rendered_drives(options: DriveOptions, config: ModelConfig, source: InputOptions) -> list[Drive]:
    """The rendered drives of the options; `frames` and `class_map` are those of `source`. Raises InputError."""
    assert options.rendered is not None
    rendered = RenderedDrives(options.rendered, options.cache, config, class_map=source.class_map)
    drives = [rendered.open(index) for index in range(len(rendered))]
    return drives if source.frames is None else [select_range(drive, source.frames) for drive in drives]


def stress(
    model: Model,
    drives: Sequence[Drive],
    conditions: Sequence[Condition],
    out: Path,
    options: StressOptions = StressOptions(),
    *,
    force: bool = False,
    resume: bool = False,
) -> StressResults:
    """Score a model on the same drives under each condition: see `StressTest`, which gives the loop."""
    test = StressTest(model, drives, conditions, out, options, force=force, resume=resume)
    for _ in test.run():
        pass
    return test.results


class StressTest:
    """A model, its drives, and the folder in which finished scenes of the current condition are kept.

    The results are written after each condition, those of a scene at its end: an interrupted test can go on. The same
    drives, model, options and conditions give the same stress.json, byte by byte, also if the test was interrupted.

    Attributes:
        results: the scores so far.
    """

    def __init__(
        self,
        model: Model,
        drives: Sequence[Drive],
        conditions: Sequence[Condition],
        out: Path,
        options: StressOptions = StressOptions(),
        *,
        force: bool = False,
        resume: bool = False,
    ) -> None:
        """Read what is to be compared with. Raises InputError where a drive has no frames.

        Args:
            model: of `load_model`.
            drives: of `open_sequence`, with ground truth.
            conditions: of `choose_conditions`. Results of an earlier, resumed test are kept.
            out: the folder for stress.json; made where it is missing.
            options: see `StressOptions`.
            force: remove the files that an earlier test wrote into `out`.
            resume: go on with an interrupted test; it may get further conditions.
        """
        if force and resume:
            raise OutputError("`force` (`--force`) and `resume` (`--resume`) exclude each other: pass one of them")
        self._model = model.in_engine(drives[0].rig, drives[0])
        self._options, self._conditions, self._resume = options, conditions, resume
        memory, scenes = FrameMemory(KEPT_BYTES), [scene for drive in drives for scene in split_scenes(drive)]
        self._scenes = [KeptFrames(scene, memory, index) for index, scene in enumerate(scenes)]
        self._against = None if options.against is None else read_results(options.against)
        # All that the results depend on, apart from the conditions.
        fingerprints = [run_fingerprint(self._model, drive, replace(options, against=None)) for drive in drives]
        names = _INPUT_KEYS if len(drives) > 1 else ()
        together = {name: digest(tuple(of_drive[name] for of_drive in fingerprints))[:12] for name in names}
        self._fingerprint = fingerprints[0] | together | {"drives": ", ".join(drive.name for drive in drives)}
        self._folder = RunFolder(out, force=force, resume=resume)
        self._range_m = options.max_range_m or self._model.config.bev_grid.nearest_side_m
        self._metrics = DetectionConfig.of(self._model.config.object_classes).cut_at(self._range_m)
        self.results = StressResults(self._header(), (), is_complete=False)

    def run(self) -> Generator[int]:
        """Run the test; yield the number of finished frames: first of an earlier, resumed test, then after each frame.

        Leave the loop to end the test early.

        Raises:
            InputError: a frame cannot be read, or a drive has no ground truth.
            OutputError: the folder holds something already, is in use, or cannot be written; or the test to resume was
                another one.
        """
        with self._folder as folder:
            state = saved_state(folder, self._fingerprint, StressState) if self._resume else None
            if state is None:
                folder.remove_written()
                state = StressState(self._fingerprint)
                save_state(folder.state_path, state)
            self.results = replace(self.results, scores=state.scores)
            finished = {(scores.corruption, scores.severity) for scores in state.scores}
            pending = [
                condition for condition in self._conditions if (condition.name, condition.severity) not in finished
            ]
            lengths = [len(scene.stamps) for scene in self._scenes]
            done = (len(self._conditions) - len(pending)) * sum(lengths)
            if pending:  # frames of its first condition may be stored
                done += sum(n for i, n in enumerate(lengths) if self._boxes_path(pending[0], i).exists())
            yield done
            runner = self._model.runner(StepOptions(track=False, temporal=self._options.temporal))
            try:
                for condition in pending:
                    for index in range(len(self._scenes)):
                        for _ in self._run_scene(runner, condition, index):
                            done += 1
                            yield done
                    scores = {(s.corruption, s.severity): s for s in (*self.results.scores, self._scores(condition))}
                    order = [(known.name, known.severity) for known in choose_conditions()]  # clean first
                    self.results = replace(self.results, scores=tuple(scores[key] for key in order if key in scores))
                    save_state(folder.state_path, StressState(self._fingerprint, self.results.scores))
                    self._write_results()
                    for index in range(len(self._scenes)):
                        self._boxes_path(condition, index).unlink(missing_ok=True)
            except GeneratorExit:
                self._write_results()
                raise
            self.results = replace(self.results, is_complete=True)
            self._write_results()

    def _header(self) -> dict[str, Any]:
        """A description of the test for stress.json. It names no folders, so that the file is the same everywhere."""
        weights = self._model.weights
        return {
            "model": self._model.name,
            "weights": {"file": weights.name if weights else "random", "hash": self._model.weights_hash[:DIGITS]},
            "precision": self._model.precision,
            "temporal": self._options.temporal,
            "seed": self._options.seed,
            "lost_images": self._options.lost_images,
            "max_range_m": self._range_m,
            "drives": [{"name": s.name, "scene": s.stamps[0].scene, "frames": len(s.stamps)} for s in self._scenes],
        }

    def _boxes_path(self, condition: Condition, index: int) -> Path:
        name = "-".join(("boxes", condition.name, condition.severity or "0", str(index)))
        return self._folder.state_path.with_name(f"{name}.safetensors")

    def _run_scene(self, runner: Runner, condition: Condition, index: int) -> Iterator[None]:
        """Compute the boxes of a scene, unless they are there already; yield after each frame."""
        path, scene, options = self._boxes_path(condition, index), self._scenes[index], self._options
        if path.exists():
            return
        boxes: list[tuple[Boxes3D, Boxes3D]] = []
        for changed in condition.sequences(scene, options.seed, options.lost_images):
            drive = changed
            if options.calibrate:
                with contextlib.suppress(InputError):  # a drive that shows no rig keeps its own
                    drive = DriveView(changed, rig=calibrate(changed).rig)
            for frame, prediction, _ in runner.run(drive):
                if frame.ground_truth is not None:
                    boxes.append(boxes_ego(frame, frame.ground_truth, prediction, self._metrics.classes))
                yield
        if not boxes:
            raise InputError(f"{scene.name}: has no ground truth (expected boxes to score against)")
        self._folder.add(path)
        save_state(path, tuple(boxes))

    def _scores(self, condition: Condition) -> ConditionScores:
        """The scores of a condition of which all scenes were run."""
        paths = [self._boxes_path(condition, index) for index in range(len(self._scenes))]
        predictions, truths = zip(*(boxes for path in paths for boxes in load_state(path, SceneBoxes)), strict=True)
        table = evaluate_detections(predictions, truths, self._metrics).overall.of_classes_with_ground_truth()
        aps = {name: scores.mean_ap for name, scores in table.classes.items()}
        return ConditionScores(condition.name, condition.severity, table.nd_score, table.mean_ap, table.errors, aps)

    def _write_results(self) -> None:
        path = self._folder.path / RESULTS
        self._folder.add(path)
        write_whole(path, (json.dumps(self.results.to_dict(self._against), indent=1) + "\n").encode())


def split_scenes(drive: Drive) -> list[Drive]:
    """One sequence per scene. Raises InputError if the drive has no frames."""
    if not drive.stamps:
        raise InputError(f"{drive.name}: has no frames")
    return [select(drive, indices) for indices in scenes_of(drive.stamps)]


def stress_table(results: StressResults, against: StressResults | None = None) -> str:
    """NDS and mAP by corruption and severity as text; with `against`, also the corruption errors."""
    parts = []
    if results.clean is not None:
        parts.append(f"clean drives: NDS {results.clean.nd_score:.3f}, mAP {results.clean.mean_ap:.3f}")
    tested = results.tested()
    groups = {
        tuple(corruption.levels): [c for c in tested if c.levels.keys() == corruption.levels.keys()]
        for corruption in tested
    }
    parts += [_block(results, severities, group, against) for severities, group in groups.items()]
    published, unseen = (
        sum(corruption.group is group for corruption in tested) for group in (Group.ROBOBEV, Group.UNSEEN)
    )
    if published:
        over = f"over {published} of RoboBEV's 8 corruptions"
        lines = [f"mRR {_percent(results.mean_resilience())} % {over}"]
        if against is not None:
            other = against.header.get("model", "?")
            lines.append(f"mCE {_percent(results.mean_corruption_error(against))} % against {other} {over}")
        parts.append("\n".join(lines))
    if unseen:
        mean = _percent(results.mean_resilience(Group.UNSEEN))
        parts.append(f"mean resilience {mean} % over {unseen} of 5 corruptions that no training of bevcli uses")
    return "\n\n".join(parts)


def _block(
    results: StressResults, severities: tuple[str, ...], group: list[Corruption], against: StressResults | None
) -> str:
    scale = "level " if severities[0].isdecimal() else ""
    head = [cell for severity in severities for cell in (f"{scale}{severity}: NDS", "mAP")]
    rows = [("corruption", *head, "mean NDS", "RR %", *(("CE %",) if against else ()))]
    for corruption in group:
        scores = results.of(corruption.name)
        cells = []
        for condition in map(scores.get, severities):
            cells += [f"{condition.nd_score:.3f}", f"{condition.mean_ap:.3f}"] if condition else ["-", "-"]
        mean = sum(condition.nd_score for condition in scores.values()) / len(scores)
        rates = [f"{mean:.3f}", _percent(results.resilience(corruption.name))]
        rates += [_percent(results.corruption_error(corruption.name, against))] if against else []
        rows.append((corruption.name, *cells, *rates))
    return aligned(rows)


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.1f}"
