"""`compare`: the scores of two models on the same frames, their differences with intervals, and the worst frames."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import ConfigError, InputError
from bevcli.jit import njit
from bevcli.printing import counted
from bevcli.workshop.scores import ResultOptions
from bevcli.workshop.scores.detection import (
    RECALLS,
    ClassMatches,
    ClassScores,
    DetectionScores,
    ScoreTable,
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
    config, predictions, truth_frames = detection.config, matches.predictions, matches.ground_truth.frames
    hits = tuple(np.flatnonzero(row >= 0) for row in matches.matched)
    errors = true_positive_errors(matches, hits[config.error_row], config, detection.unmeasured)
    defined = {name: values for name, values in errors.items() if values is not None}
    of_hits = np.array(list(defined.values())).reshape(len(defined), -1)  # (E, T)
    scores = predictions.column("scores").astype(np.float64)
    limits, unknown = (round(100 * config.min_recall) + 1, config.min_precision), dict.fromkeys(errors, np.nan)
    for drawn in draws:
        copies, truth_count = drawn[predictions.frames], int(drawn[truth_frames].sum())
        aps, means = _score(copies, scores, hits, of_hits, truth_count, config.error_row, limits, RECALLS)
        by_distance = dict(zip(config.distances_m, aps.tolist(), strict=True))
        measured = dict(zip(defined, means.tolist(), strict=True))
        yield ClassScores(truth_count, len(scores), np.nan, by_distance, unknown | measured, {})


@njit(nogil=True)
def _score(copies, scores, hits, errors, truth_count, error_row, limits, recalls):  # type: ignore[no-untyped-def]
    """AP at each distance (D,), and the mean errors (E,).

    copies: (P,) int64, how often each prediction counts, in descending order of score. scores: (P,). hits: of each
    distance, indices of the true positives. errors: (E, T) of the hits at the distance `error_row`, NaN where unknown.
    limits: index of the first recall that counts, and the lowest precision.
    """
    first, min_precision = limits
    # Loops, because numba compiles numpy's functions of whole arrays for as long as all else here.
    aps, means, seen = np.zeros(len(hits)), np.ones(len(errors)), copies.copy()
    for index in range(1, len(seen)):
        seen[index] += seen[index - 1]
    for row in range(len(hits)):
        precision, at = _curve(copies, seen, scores, hits[row], truth_count, recalls)
        for recall in range(first, len(recalls)):
            aps[row] += max(precision[recall] - min_precision, 0.0)
        aps[row] = aps[row] / (len(recalls) - first) / (1 - min_precision)
        if row == error_row:
            for index in range(len(errors)):
                means[index] = _mean_error(copies, scores, hits[row], errors[index], at, first)
    return aps, means


@njit(nogil=True)
def _curve(copies, seen, scores, hits, truth_count, recalls):  # type: ignore[no-untyped-def]
    """Precision and score at the recalls (101,) each: between two true positives, those before and at the second."""
    precision, at = np.zeros(len(recalls)), np.zeros(len(recalls))
    hit_count, index = 0, 0
    for hit in hits:
        for copy in range(copies[hit]):
            before = seen[hit] - copies[hit] + copy  # predictions
            last_precision, last_score = 1.0, scores[hit]  # where the curve begins
            if before:
                last_precision, last_score = hit_count / before, scores[hit if copy else _last(copies, hit)]
            start, end, new = hit_count / truth_count, (hit_count + 1) / truth_count, (hit_count + 1) / (before + 1)
            while index < len(recalls) and recalls[index] < end:
                share = (recalls[index] - start) / (end - start)
                precision[index] = last_precision + share * (new - last_precision)
                at[index] = last_score + share * (scores[hit] - last_score)
                index += 1
            hit_count += 1
    if hit_count and index < len(recalls) and recalls[index] == hit_count / truth_count:
        precision[index], at[index] = hit_count / seen[-1], scores[_last(copies, len(copies))]
    return precision, at


@njit(nogil=True)
def _last(copies, end):  # type: ignore[no-untyped-def]
    """The last prediction before `end` that counts."""
    index = end - 1
    while not copies[index]:
        index -= 1
    return index


@njit(nogil=True)
def _mean_error(copies, scores, hits, errors, at, first):  # type: ignore[no-untyped-def]
    """The running mean of an error at the scores of the recalls `at`, averaged over the recalls that are reached."""
    last = 0
    for recall in range(len(at)):
        if at[recall] != 0:
            last = recall
    if last < first:
        return 1.0
    recall, reached, error_count, total, mean, result = first, 0, 0, 0.0, 0.0, 0.0
    last_score, last_mean = 0.0, 0.0
    for index, hit in enumerate(hits):
        for _ in range(copies[hit]):
            if not np.isnan(errors[index]):
                error_count, total = error_count + 1, total + errors[index]
            mean, reached = total / error_count if error_count else 0.0, reached + 1
            while recall <= last and at[recall] >= scores[hit]:
                if reached > 1 and at[recall] > scores[hit]:
                    share = (last_score - at[recall]) / (last_score - scores[hit])
                    result += last_mean + share * (mean - last_mean)
                else:
                    result += mean
                recall += 1
            last_score, last_mean = scores[hit], mean
    result += (last - recall + 1) * mean  # recalls with a lower score than the last true positive
    return result / (last - first + 1) if error_count else 1.0


CONFIDENCE = 0.95
RESAMPLES = 1000
WORST = 3
FEW_FRAMES = 10


@dataclass(frozen=True)
class Difference:
    """One score of the models A and B."""

    values: tuple[float, float]  # of A and of B
    interval: tuple[float, float]  # of the difference, 95 %, lower end first; NaN of a single frame

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
    """The result of `compare`."""

    files: tuple[Path, Path]  # the predictions of A and of B
    scores: tuple[Scores, Scores]  # of A and of B, on the frames, classes and ranges that both have
    classes: Mapping[str, Difference]  # AP by class
    mean_ap: Difference  # mAP
    nd_score: Difference  # NDS
    worst: WorstFrames  # the frames with most missed and most invented boxes, and those where A and B differ most
    resamples: int  # number of resamples of the frames for the intervals
    notes: tuple[str, ...]  # what was assumed or left out, one line each

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
    part = {"scene": scene, "version": version, "split": split}
    models = [read(path, ground_truth, count_missing, class_map, part) for path in (a, b)]
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
