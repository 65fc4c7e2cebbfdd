"""Fit the estimated score of `bevcli validate` to rendered drives with ground truth, and print how exact it is.

    python tests/tools/fit_estimate.py collect rows --first 1001000 --count 48        # runs the model; one file a drive
    python tests/tools/fit_estimate.py collect rows --first 1002000 --count 24 --check
    python tests/tools/fit_estimate.py fit rows bevcli/workshop/trust/fits/demo.toml  # seconds

A drive has a random rig. It is run as rendered and under six random conditions of `bevcli stress`. Drives that were
collected with --check are not fitted, nor are the corruptions of HELD_OUT.
"""

import argparse
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from bevcli.config import as_toml
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.matching import DetectionConfig
from bevcli.geometry.transforms import Array
from bevcli.inference.load import Model, load_model
from bevcli.inference.run import run
from bevcli.sequences.files.boxes_file import FrameBoxes
from bevcli.sequences.view import select
from bevcli.workshop.robustness.conditions import CLEAN, CORRUPTIONS, Condition
from bevcli.workshop.scores.detection import evaluate_detections
from bevcli.workshop.synth.drives import RenderedDrives
from bevcli.workshop.training.job import rig_for_drives
from bevcli.workshop.training.validation import boxes_ego
from bevcli.workshop.trust.estimate import SHOWN
from bevcli.workshop.trust.figures import figures_of, scores_of, within
from bevcli.workshop.trust.fit import Fit

HELD_OUT = ("defocus_blur", "low_contrast", "impulse_noise", "jpeg", "saturation")
USED = ("class_certainty", "certainty", "persistence")
FRAMES, CONDITIONS = 12, 6  # of a drive
OFTEN = 3  # drives under a condition, of whose estimates the mean is compared
PENALTY = 1.0  # of ridge regression, for standardised figures
COVERED = 0.9  # share of drives whose NDS the interval holds
LEAST_SCORE = 0.05  # of boxes that the expected precision is fitted on


@dataclass(frozen=True)
class Row:
    """A drive under a condition.

    Attributes:
        drive: its seed.
        condition: the corruption, or "clean".
        severity: of the corruption.
        check: whether the drive is not fitted.
        runs: predicted boxes in the ego frame, of each draw of the corruption.
        truths: true boxes in the ego frame, a list for each run.
        rigs: of each run.
        nd_score: over all runs.
    """

    drive: int
    condition: str
    severity: str
    check: bool
    runs: list[list[FrameBoxes]]
    truths: list[list[Boxes3D]]
    rigs: list[CameraRig]
    nd_score: float


def collect(model: Model, seed: int, cache: Path, *, check: bool) -> Iterator[Row]:
    """The rows of a drive."""
    metrics = DetectionConfig.of(model.config.object_classes).cut_at(model.config.bev_grid.nearest_side_m)
    drives = RenderedDrives([seed], cache, model.config, rig_for_drives("random", model.name))
    drive, random = select(drives.open(0), range(FRAMES)), np.random.default_rng(seed)
    chosen = [CORRUPTIONS[index] for index in random.permutation(len(CORRUPTIONS))[:CONDITIONS]]
    conditions = [Condition(CLEAN, "")]
    conditions += [Condition(each, list(each.levels)[random.integers(len(each.levels))]) for each in chosen]
    for condition in conditions:
        row = Row(seed, condition.name, condition.severity, check, [], [], [], 0.0)
        scored = []
        for sequence in condition.sequences(drive, seed, "black"):
            steps = list(run(model, sequence, track=False))
            pairs = [boxes_ego(f, f.ground_truth, p, metrics.classes) for f, p in steps if f.ground_truth is not None]
            boxes = [FrameBoxes(f.stamp, f.world_from_ego, p.boxes_ego) for f, p in steps]
            row.runs.append(boxes)
            row.truths.append([truth for _, truth in pairs])
            row.rigs.append(steps[0][0].rig)
            scored += pairs
        table = evaluate_detections(*map(list, zip(*scored, strict=True)), metrics).overall
        yield Row(**vars(row) | {"nd_score": table.of_classes_with_ground_truth().nd_score})


def figures(row: Row, range_m: float) -> Array:
    """(K,) the figures of USED, the mean over the draws of the corruption."""
    found = [figures_of(*each, range_m) for each in zip(row.runs, row.rigs, strict=True)]
    return np.mean([[getattr(each, name) for name in USED] for each in found], axis=0)


def regression(table: Array, scores: Array, drives: Array) -> tuple[float, Array]:
    """Intercept and weights of ridge regression. table: (R, K). scores, drives: (R,).

    The weights are those of the differences within drives: which rare objects stand in a drive changes its NDS by 0.1
    under all conditions, and no figure shows it.
    """
    within_drives, changes = table.copy(), scores.copy()
    for drive in set(drives.tolist()):
        within_drives[drives == drive] -= table[drives == drive].mean(axis=0)
        changes[drives == drive] -= scores[drives == drive].mean()
    scale = within_drives.std(axis=0)
    standard = within_drives / scale
    weights = np.linalg.solve(standard.T @ standard + PENALTY * np.eye(len(scale)), standard.T @ changes) / scale
    return float(scores.mean() - table.mean(axis=0) @ weights), weights


def left_out(table: Array, scores: Array, drives: Array, fitted: Array) -> Array:
    """(R,) the estimate of each row by a fit to the rows `fitted` (R,) bool of the other drives."""
    estimates = np.zeros(len(scores))
    for drive in set(drives.tolist()):
        others = (drives != drive) & fitted
        intercept, weights = regression(table[others], scores[others], drives[others])
        estimates[drives == drive] = intercept + table[drives == drive] @ weights
    return np.clip(estimates, 0, 1)


def half_width(errors: Array) -> float:
    """Of the interval of split conformal prediction, from the errors of drives that were left out."""
    rank = min(len(errors), int(np.ceil((len(errors) + 1) * COVERED)))
    return float(np.sort(np.abs(errors))[rank - 1])


def is_right(boxes: Boxes3D, truth: Boxes3D) -> Array:
    """(N,) 1 for a box within 2 m of a true object of its class that no better box has taken."""
    off_m = np.linalg.norm(boxes.centers[:, None, :2] - truth.centers[:, :2], axis=2)
    off_m[boxes.classes[:, None] != truth.classes] = np.inf
    right = np.zeros(len(boxes))
    for index in np.argsort(-scores_of(boxes)) if len(truth) else ():
        nearest = int(off_m[index].argmin())
        if off_m[index, nearest] < 2:
            right[index], off_m[:, nearest] = 1, np.inf
    return right


def boxes_of(row: Row, range_m: float, least: float) -> tuple[Boxes3D, Array]:
    """All boxes of a row with a score of at least `least`, and whether each is right."""
    found = [
        (within(frame.boxes, range_m).scored(least), within(truth, range_m))
        for frames, truths in zip(row.runs, row.truths, strict=True)
        for frame, truth in zip(frames, truths, strict=True)
    ]
    return Boxes3D.concatenate(boxes for boxes, _ in found), np.concatenate([is_right(*pair) for pair in found])


def precision(rows: Sequence[Row], classes: Sequence[str], range_m: float) -> Array:
    """Logistic regression of whether a box is right: the weight of its score (log odds), and those of its class."""
    inputs, right = [], []
    for row in rows:
        boxes, of_row = boxes_of(row, range_m, LEAST_SCORE)
        scores = np.clip(scores_of(boxes), 0.01, 0.99)
        of_class = boxes.classes[:, None] == np.array(classes)
        inputs.append(np.c_[np.log(scores / (1 - scores)), of_class])
        right.append(of_row)
    table, target = np.concatenate(inputs), np.concatenate(right)
    weights = np.zeros(table.shape[1])
    for _ in range(20):  # Newton's method
        expected = 1 / (1 + np.exp(-table @ weights))
        slope = table.T @ (target - expected) - weights
        curvature = (table * (expected * (1 - expected))[:, None]).T @ table + np.eye(len(weights))
        weights += np.linalg.solve(curvature, slope)
    return weights


def fitted(rows: Sequence[Row], table: Array, model: Model) -> Fit:
    """The fit to some rows. table: (R, K) their figures."""
    scores, drives = scores_and_drives(rows)
    errors = left_out(table, scores, drives, np.ones(len(rows), dtype=bool)) - scores
    intercept, weights = regression(table, scores, drives)
    slope, *of_class = precision(rows, model.config.classes, model.config.bev_grid.nearest_side_m).round(4).tolist()
    return Fit(
        weights_hash=model.weights_hash,
        drives=len(set(drives.tolist())),
        conditions=len(rows),
        least_frames=FRAMES // 2,
        intercept=round(intercept, 5),
        weights=dict(zip(USED, weights.round(5).tolist(), strict=True)),
        lowest=dict(zip(USED, table.min(axis=0).round(4).tolist(), strict=True)),
        highest=dict(zip(USED, table.max(axis=0).round(4).tolist(), strict=True)),
        half_width=round(half_width(errors), 4),
        precision_slope=slope,
        precision=dict(zip(model.config.classes, of_class, strict=True)),
    )


def scores_and_drives(rows: Sequence[Row]) -> tuple[Array, Array]:
    """(R,) the true NDS of each row, and (R,) its drive."""
    return np.array([row.nd_score for row in rows]), np.array([row.drive for row in rows])


def agreement(estimates: Array, scores: Array) -> str:
    """Spearman's correlation and the median error."""
    return f"{spearmanr(estimates, scores)[0]:.2f}, {np.median(np.abs(estimates - scores)):.3f}"


def accuracy(name: str, rows: Sequence[Row], estimates: Array, fit: Fit, range_m: float) -> str:
    """A line of the table: how exact the estimates of some rows are."""
    scores, drives = scores_and_drives(rows)
    names = np.array([row.condition for row in rows])
    changed = [i for i, drive in enumerate(drives) if names[i] != "clean" and "clean" in names[drives == drive]]
    clean = [int(np.flatnonzero((drives == drives[i]) & (names == "clean"))[0]) for i in changed]
    changes = [values[changed] - values[clean] for values in (estimates, scores)]
    kinds = np.array([f"{rows[i].condition} {rows[i].severity}" for i in changed])
    often = [each for each, count in zip(*np.unique(kinds, return_counts=True), strict=True) if count >= OFTEN]
    means = [np.array([values[kinds == each].mean() for each in often]) for values in changes]
    off = []
    for row in rows:
        boxes, right = boxes_of(row, range_m, SHOWN)
        if len(boxes) >= 30:
            off.append(abs(float(fit.right(boxes).mean() - right.mean())))
    covered = 100 * np.mean(np.abs(estimates - scores) <= fit.half_width)
    cells = [name, len(set(drives.tolist())), len(rows), agreement(estimates, scores), f"{covered:.0f} %"]
    cells += [agreement(*changes), f"{agreement(*means)} ({len(often)})", f"{np.median(off):.2f}"]
    return f"| {' | '.join(map(str, cells))} |"


def report(rows: Sequence[Row], table: Array, fit: Fit, range_m: float) -> str:
    """The table of docs/trust.md. table: (R, K) the figures of the rows."""
    scores, drives = scores_and_drives(rows)
    check = np.array([row.check for row in rows])
    held_out = np.array([row.condition in HELD_OUT for row in rows])
    estimates = left_out(table, scores, drives, ~check & ~held_out)
    lines = [
        "| drives | number | conditions | NDS: Spearman, median error | in the interval | change against the drive as "
        "rendered | the same, mean of each condition (number) | expected precision: median error |",
        "|---|---|---|---|---|---|---|---|",
    ]
    clean = np.array([row.condition == "clean" for row in rows])
    for name, chosen in (
        ("fitted drives, each estimated by the others", ~check),
        ("of them, corruptions of no fit", ~check & (held_out | clean)),
        ("other rigs and streets", check),
        ("of them, corruptions of no fit", check & (held_out | clean)),
    ):
        if chosen.any():
            some = [row for row, is_chosen in zip(rows, chosen, strict=True) if is_chosen]
            lines.append(accuracy(name, some, estimates[chosen], fit, range_m))
    return "\n".join(lines)


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("act", choices=["collect", "fit"])
    parser.add_argument("rows", type=Path, help="folder with one file a drive")
    parser.add_argument("out", type=Path, nargs="?", help="of fit: the TOML file")
    parser.add_argument("--model", default="demo")
    parser.add_argument("--cache", type=Path, default=Path("runs/drives"))
    parser.add_argument("--first", type=int, default=1_001_000)
    parser.add_argument("--count", type=int, default=1)
    parser.add_argument("--check", action="store_true")
    given = parser.parse_args()
    model = load_model(given.model)
    if given.act == "collect":
        given.rows.mkdir(parents=True, exist_ok=True)
        for seed in range(given.first, given.first + given.count):
            found = list(collect(model, seed, given.cache, check=given.check))
            (given.rows / f"{seed}.pkl").write_bytes(pickle.dumps(found))
            print(seed, *(f"{row.condition} {row.severity} {row.nd_score:.3f}" for row in found), sep=", ", flush=True)
        return
    range_m = model.config.bev_grid.nearest_side_m
    rows = [row for path in sorted(given.rows.glob("*.pkl")) for row in pickle.loads(path.read_bytes())]
    table = np.array([figures(row, range_m) for row in rows])
    chosen = np.array([not row.check and row.condition not in HELD_OUT for row in rows])
    fit = fitted([row for row, is_chosen in zip(rows, chosen, strict=True) if is_chosen], table[chosen], model)
    if given.out is not None:
        given.out.write_text(
            "# Written by tests/tools/fit_estimate.py\n\n" + as_toml({"fit": vars(fit)}).lstrip(), encoding="utf-8"
        )
    print(report(rows, table, fit, range_m))


if __name__ == "__main__":
    main()
