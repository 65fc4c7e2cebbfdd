"""`compare`: the scores of two models on the same frames, their differences with intervals, and the worst frames."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import ConfigError, InputError
from bevcli.printing import counted
from bevcli.workshop.scores import ResultOptions
from bevcli.workshop.scores.detection import (
    ClassMatches,
    ClassScores,
    DetectionScores,
    ScoreTable,
    recall_curve,
    true_positive_errors,
)
from bevcli.workshop.scores.evaluate import Scores, finite, read, score
from bevcli.workshop.scores.inputs import Compared
from bevcli.workshop.scores.plots import write_comparison
from bevcli.workshop.scores.tables import Cell, Table
from bevcli.workshop.scores.worst_frames import MODELS, WorstFrames, find_worst_frames

SEED = 0


def draw_frames(frame_count: int, resamples: int) -> NDArray[np.int64]:
    """(R, F), how often each resample has each of F frames; F in total. Equal in every call."""
    return np.random.default_rng(SEED).multinomial(frame_count, np.full(frame_count, 1 / frame_count), size=resamples)


def resampled(detection: DetectionScores, draws: NDArray[np.int64]) -> Iterator[ScoreTable]:
    """The scores of each resample, without curves. draws: (R, F) of `draw_frames`.

    An error is left out if no ground truth of all frames has the quantity.
    """
    classes = {matches.name: _resampled_class(matches, detection, draws) for matches in detection.matches}
    for row in zip(*classes.values(), strict=True):
        yield ScoreTable(dict(zip(classes, row, strict=True)), detection.config.mean_ap_weight)


def _resampled_class(
    matches: ClassMatches, detection: DetectionScores, draws: NDArray[np.int64]
) -> Iterator[ClassScores]:
    """The scores of one class in each resample."""
    config, scores, is_match = detection.config, matches.predictions.column("scores"), matches.matched >= 0
    hits = np.flatnonzero(is_match[config.error_row])
    errors = true_positive_errors(matches, hits, config, detection.unmeasured)
    for drawn in draws:
        copies, truth_count = drawn[matches.predictions.frames], int(drawn[matches.ground_truth.frames].sum())
        rows, drawn_hits = np.repeat(np.arange(len(scores)), copies), np.repeat(np.arange(len(hits)), copies[hits])
        curves = [recall_curve(row[rows], scores[rows], truth_count) for row in is_match]
        aps = [curve.average_precision(config) for curve in curves]
        means = {
            name: curves[config.error_row].mean_error(
                config, scores[hits[drawn_hits]], None if values is None else values[drawn_hits]
            )
            for name, values in errors.items()
        }
        yield ClassScores(truth_count, len(scores), np.nan, dict(zip(config.distances_m, aps, strict=True)), means, {})


CONFIDENCE = 0.95
RESAMPLES = 1000
WORST = 3
FEW_FRAMES = 10


@dataclass(frozen=True)
class Difference:
    """One score of the models A and B.

    Attributes:
        values: of A and of B.
        interval: of the difference, 95 %, lower end first; NaN of a single frame.
    """

    values: tuple[float, float]
    interval: tuple[float, float]

    @property
    def difference(self) -> float:
        """B - A: above 0 where B is better."""
        return self.values[1] - self.values[0]

    @property
    def better(self) -> str:
        """ "A" or "B" where the interval is on one side of 0, else ""."""
        low, high = self.interval
        return "B" if low > 0 else "A" if high < 0 else ""

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"values": list(self.values), "difference": self.difference, "interval": list(self.interval)}


@dataclass(frozen=True)
class Comparison:
    """The result of `compare`.

    Attributes:
        files: the predictions of A and of B.
        scores: of A and of B, on the frames, classes and ranges that both have.
        classes: AP by class.
        mean_ap: mAP.
        nd_score: NDS.
        worst: the frames with most missed and most invented boxes, and those where A and B differ most.
        resamples: number of resamples of the frames for the intervals.
        notes: what was assumed or left out, one line each.
    """

    files: tuple[Path, Path]
    scores: tuple[Scores, Scores]
    classes: Mapping[str, Difference]
    mean_ap: Difference
    nd_score: Difference
    worst: WorstFrames
    resamples: int
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """All of it as a dict for JSON. docs/scoring.md explains the keys."""
        content: dict[str, Any] = {
            "predictions": list(map(str, self.files)),
            "frames": self.scores[0].detection.frame_count,
            "resamples": self.resamples,
            "confidence": CONFIDENCE,
            "mean_ap": self.mean_ap.to_dict(),
            "nd_score": self.nd_score.to_dict(),
            "mean_dist_aps": {name: difference.to_dict() for name, difference in self.classes.items()},
            **self.worst.to_dict(),
            "scores": [scores.to_dict() for scores in self.scores],
            "notes": list(self.notes),
        }
        return {key: finite(value) for key, value in content.items()}

    def table(self) -> str:
        """The differences and the worst frames as text for a terminal."""
        first = self.scores[0]
        files = [f"{model}: {file}" for model, file in zip(MODELS, self.files, strict=True)]
        frames = counted(first.detection.frame_count, "frames")
        how = f"{frames}, matched by {first.pairs.matched_by}; intervals from {self.resamples} resamples of the frames"
        view = [] if self.worst.view is None else [f"Look at it: {self.worst.view}"]
        return "\n\n".join(["\n".join([*files, how]), *map(str, self.tables()), *view])

    def tables(self) -> Iterator[Table]:
        """The tables of that text, with their numbers."""
        classes = self.scores[0].detection.overall.classes
        boxes = {name: item.ground_truth_count for name, item in classes.items()}
        rows = [_row(name, boxes[name], item) for name, item in self.classes.items() if boxes[name]]
        rows += [_row("mAP", sum(boxes.values()), self.mean_ap), _row("NDS", "", self.nd_score)]
        interval = f"{100 * CONFIDENCE:.0f} % interval"
        columns = ("class", "boxes", "AP A", "AP B", "B - A", interval, "better")
        yield Table("classes", columns, rows, signed=("B - A", interval))
        yield self._by_range()
        yield from self.worst.tables()

    def write_plots(self, folder: Path | str) -> list[Path]:
        """Write the curves of both and the other plots of each into a folder, made where it is missing.

        folder: or a .pdf, .svg or .png file, which gets the curves alone. Returns the paths. Raises OutputError.
        """
        detections, pairs = [scores.detection for scores in self.scores], [scores.pairs for scores in self.scores]
        return write_comparison(detections, pairs, self.files, Path(folder))

    def _by_range(self) -> Table:
        """AP by distance, of each class with ground truth and of all, of A and of B."""
        bins = [scores.detection.by_range for scores in self.scores]
        columns = ("AP by range", "", *(f"{low:g}-{high:g} m" for low, high in bins[0]))
        rows: list[tuple[Cell, ...]] = []
        overall = self.scores[0].detection.overall.classes
        for name in (name for name in self.classes if overall[name].ground_truth_count):
            for model, tables in zip(MODELS, bins, strict=True):
                of_bins = [table.classes.get(name) for table in tables.values()]
                rows.append((name, model, *(scores.mean_ap if scores else math.nan for scores in of_bins)))
        for model, tables in zip(MODELS, bins, strict=True):
            rows.append(("mAP", model, *(table.mean_ap for table in tables.values())))
        return Table("AP by range", columns, rows, left=(0, 1))


def _row(name: str, boxes: int | str, difference: Difference) -> tuple[Cell, ...]:
    return (name, boxes, *difference.values, difference.difference, difference.interval, difference.better)


def compare(
    a: Path | str,
    b: Path | str,
    ground_truth: Path | str,
    max_range: float | None = None,
    count_missing: bool = False,
    *,
    resamples: int = RESAMPLES,
    scene: str | None = None,
    version: str | None = None,
    split: str | None = None,
    class_map: Mapping[str, str] | None = None,
    **results: int | None,
) -> Comparison:
    """Compare the boxes of two models on the same frames.

    A difference is the score of B minus that of A. Its interval holds the central 95 % of the differences of many
    resamples of the frames, which are drawn with replacement and are the same for both models.

    Args:
        a, b: predictions as `bevcli.evaluate` takes them.
        ground_truth: see `bevcli.evaluate`.
        max_range: see there. By default the range of both ends with the smaller BEV grid.
        count_missing: see there. Frames that only one model has are left out without it.
        resamples: number of resamples.
        scene, version, split, class_map: see `bevcli.evaluate`.
        results: worst=3: length of the lists of frames.

    Returns:
        The comparison. Without another range or other frames, the scores are those of `bevcli.evaluate`.

    Raises:
        InputError: as there, or the two have no frame or class in common.
        ConfigError: max_range or resamples is not positive.
    """
    options = ResultOptions(**results)  # type: ignore[arg-type]
    if further := [name for name, value in vars(options).items() if value and name != "worst"]:
        raise InputError(
            f"`{further[0]}=True` (`--{further[0]}`): two files of predictions are compared by their boxes only: "
            "leave it out"
        )
    if resamples < 1:
        raise ConfigError(f"`resamples` is {resamples} (expected 1 or more)")
    which: dict[str, Any] = {"scene": scene, "version": version, "split": split, "class_map": class_map}
    models = [read(path, ground_truth, count_missing, **which) for path in (a, b)]
    models, notes = _on_common_ground(models, max_range)
    scores = [score(model) for model in models]
    models = [replace(model, detection=scored.detection) for model, scored in zip(models, scores, strict=True)]
    count = scores[0].detection.frame_count
    if count < FEW_FRAMES:
        notes.append(f"the intervals are too narrow for {counted(count, 'frames')} (expected {FEW_FRAMES} or more)")
    of_a, of_b = (side.notes for side in scores)
    notes += [note for note in of_a if note in of_b]
    notes += [f"A: {note}" for note in of_a if note not in of_b] + [f"B: {note}" for note in of_b if note not in of_a]
    differences = _differences(scores, resamples)
    return Comparison(
        (Path(a), Path(b)),
        (scores[0], scores[1]),
        {name: differences[name] for name in scores[0].detection.overall.classes},
        differences["mAP"],
        differences["NDS"],
        find_worst_frames(models, options.worst or WORST),
        resamples,
        tuple(notes),
    )


def _on_common_ground(models: Sequence[Compared], max_range: float | None) -> tuple[list[Compared], list[str]]:
    """The frames, the classes and the range that both models have, and notes about what is left out."""
    notes = []
    keys = [[(true.stamp, true.extras.get("sample_token")) for true in model.pairs.ground_truth] for model in models]
    indices_by_key = [{key: index for index, key in enumerate(index_of)} for index_of in keys]
    common = [key for key in keys[0] if key in indices_by_key[1]]
    if not common:
        raise InputError("the two predictions have no frame of the ground truth in common: choose two of one drive")
    if len(common) < max(map(len, keys)):
        frames = counted(len(common), "frames")
        notes.append(f"only the {frames} of both are compared: A has {len(keys[0])}, B has {len(keys[1])}")
    classes = {name: settings for name, settings in models[0].classes.items() if name in models[1].classes}
    if not classes:
        raise InputError("the two models have no class in common: rename classes with `class_map` (`--class-map`)")
    others = [name for model in models for name in model.classes if name not in classes]
    if others:
        notes.append(f"only classes of both are compared, without {', '.join(dict.fromkeys(others))}")
    for name, settings in classes.items():
        classes[name] = replace(settings, range_m=min(settings.range_m, models[1].classes[name].range_m))
    ends = [model.predictions.range_m for model in models if model.predictions and model.pairs.ego_pose_known]
    nearer = [end for end in ends if end is not None and end < max(settings.range_m for settings in classes.values())]
    if max_range is None and nearer:
        max_range = min(nearer)
        notes.append(
            f"nothing beyond {max_range:g} m is scored: the BEV grid of a model ends there (`max_range` (`--max-range "
            "M`) sets another limit)"
        )
    return [
        replace(_at(model, [index_of[key] for key in common]), classes=classes, max_range_m=max_range)
        for model, index_of in zip(models, indices_by_key, strict=True)
    ], notes


def _at(model: Compared, indices: list[int]) -> Compared:
    """Only the frames at these indices of the pairs, without maps."""
    pairs = model.pairs
    kept = replace(
        pairs,
        predictions=tuple(pairs.predictions[index] for index in indices),
        ground_truth=tuple(pairs.ground_truth[index] for index in indices),
        reference_from_ego=pairs.reference_from_ego[indices],
    )
    assert model.predictions is not None
    assert model.truth is not None
    predictions, truth = replace(model.predictions, maps=None), replace(model.truth, maps=None)
    return replace(model, pairs=kept, predictions=predictions, truth=truth)


def _differences(scores: Sequence[Scores], resamples: int) -> dict[str, Difference]:
    """AP by class, "mAP" and "NDS"."""
    detections = [score.detection for score in scores]
    count = detections[0].frame_count
    draws = draw_frames(count, resamples)
    drawn = [[_numbers(table) for table in resampled(detection, draws)] for detection in detections]
    of_a, of_b = (_numbers(detection.overall) for detection in detections)
    differences = {}
    for name in of_a:
        gains = [b[name] - a[name] for a, b in zip(*drawn, strict=True)]
        differences[name] = Difference((of_a[name], of_b[name]), interval(gains) if count > 1 else (math.nan, math.nan))
    return differences


def _numbers(table: ScoreTable) -> dict[str, float]:
    """AP by class, "mAP" and "NDS"."""
    aps = {name: scores.mean_ap for name, scores in table.classes.items()}
    return {**aps, "mAP": table.mean_ap, "NDS": table.nd_score}


def interval(differences: Sequence[float]) -> tuple[float, float]:
    """The ends between which 95 % of the values lie, as many below as above."""
    low, high = np.quantile(differences, ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    return float(low), float(high)
