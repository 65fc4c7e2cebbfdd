"""`estimate_score`: how good the boxes of a model are likely to be on a drive without ground truth.

`estimate_of_boxes` takes the boxes of a run that is done.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.config import settings_of_table
from bevcli.findings import Finding, errors_of
from bevcli.frame import Drive
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.matching import DetectionConfig
from bevcli.inference.load import Model
from bevcli.parsing.documents import parse_toml
from bevcli.printing import aligned, number
from bevcli.sequences.files.boxes_file import FrameBoxes, read_boxes
from bevcli.workshop.scores.evaluate import finite
from bevcli.workshop.trust.faults import find_faults, frame_boxes
from bevcli.workshop.trust.figures import Figures, figures_of, scores_of, within
from bevcli.workshop.trust.fit import Fit

SHOWN = 0.3  # the tables count boxes with this score or more
NO_FIT = (
    "these weights have no fit of figures to a true NDS: compare the figures with those of a drive on which the "
    "weights are known to work (`reference` (`--reference DIR`))"
)

FAULTY = "scores stay high under the faults below: the true NDS is likely to be lower than estimated"


@dataclass(frozen=True)
class Part:
    """Some boxes of a drive: those of a class, those that a camera sees, or those at some distances.

    Attributes:
        boxes: number of boxes a frame with a score of 0.3 or more.
        score: their mean score, 0 to 1; NaN without boxes.
        precision: the expected share of them that are within 2 m of an object of their class; NaN without boxes or fit.
    """

    boxes: float
    score: float
    precision: float


@dataclass(frozen=True)
class EstimatedScore:
    """The score that a model is likely to have on a drive without ground truth.

    Attributes:
        nd_score: estimated NDS, 0 to 1; None for weights whose figures were never compared with a true NDS, and for a
            drive that is too short.
        low: lower end of the interval that holds the true NDS of 9 of 10 drives; None without `nd_score`.
        high: its upper end.
        figures: what it was made of.
        by_class: class of the model -> its boxes.
        by_camera: camera -> the boxes whose centres it sees. A box may be seen by several cameras.
        by_distance: "0-10 m" and so on -> the boxes at these distances from the ego frame's origin.
        notes: why there is no NDS, or why the interval may not hold.
        findings: faults that show without labels.
    """

    nd_score: float | None
    low: float | None
    high: float | None
    figures: Figures
    by_class: Mapping[str, Part]
    by_camera: Mapping[str, Part]
    by_distance: Mapping[str, Part]
    notes: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """For JSON; numbers that are not known are null."""
        return dict(finite(asdict(self)))

    @property
    def line(self) -> str:
        """The score on one line."""
        if self.nd_score is None:
            return "estimated NDS -"
        return f"estimated NDS {self.nd_score:.2f}, between {self.low:.2f} and {self.high:.2f} in 9 of 10 drives"

    def with_faults(self, findings: tuple[Finding, ...]) -> "EstimatedScore":
        """The score with the faults that show, and a note where they make it worse than estimated."""
        is_worse = self.nd_score is not None and errors_of(findings)
        return replace(self, findings=findings, notes=(*self.notes, FAULTY) if is_worse else self.notes)

    def table(self, reference: "EstimatedScore | None" = None) -> str:
        """The score, its figures and the tables as text. reference: of another drive, whose figures stand beside."""
        sides = [asdict(side.figures) for side in (self, reference) if side is not None]
        figures = [("made of", "this drive", "reference")[: 1 + len(sides)]]
        figures += [(name.replace("_", " "), *(number(side[name]) for side in sides)) for name in sides[0]]
        rows = [self.line, aligned(figures)]
        for title, parts in (("class", self.by_class), ("camera", self.by_camera), ("distance", self.by_distance)):
            cells = [(title, "boxes a frame", "mean score", "expected precision")]
            cells += [(name, f"{p.boxes:.1f}", number(p.score, 2), number(p.precision, 2)) for name, p in parts.items()]
            rows.append(aligned(cells))
        notes = [f"note: {note}" for note in self.notes]
        found = [f"{finding.severity}: {finding.line}" for finding in self.findings]
        return "\n\n".join([*rows, *filter(None, ["\n".join([*notes, *found])])])


def estimate_score(
    model: Model, drive: Drive, *, temporal: bool = True, after_frame: Callable[[], None] = lambda: None
) -> EstimatedScore:
    """The score that a model is likely to have on a drive, which needs no ground truth, and faults that show.

        estimated = bevcli.estimate_score(model, bevcli.open_sequence("my_drive"))
        print(estimated.nd_score, estimated.low, estimated.high)

    Args:
        model: of `load_model`.
        drive: of `open_sequence`.
        temporal: use the frames before.
        after_frame: called after each frame.

    Raises InputError where a frame cannot be read.
    """
    frames = frame_boxes(model, drive, temporal=temporal, after_frame=after_frame)
    return estimate_of_boxes(model, frames, drive.rig).with_faults(find_faults(model, drive))


def as_document(scores: Sequence[tuple[str, EstimatedScore]], reference: EstimatedScore | None) -> dict[str, Any]:
    """The scores of drives with their names, for JSON: the mean as "estimated", and each of them in its "drives"."""
    of_all: dict[str, Any] = {"nd_score": None, "low": None, "high": None}
    if all(score.nd_score is not None for _, score in scores):
        of_all = {key: float(np.mean([getattr(score, key) for _, score in scores])) for key in of_all}
    drives = [{"name": name, **score.to_dict()} for name, score in scores]
    return {"estimated": {**of_all, "drives": drives, "reference": reference and reference.to_dict()}}


def estimate_of_run(model: Model, folder: Path, rig: CameraRig) -> EstimatedScore:
    """The score from the predictions.json in the folder of a run. Raises InputError where it cannot be read."""
    file = read_boxes(folder / "predictions.json")
    frames = [replace(frame, boxes=file.in_ego(frame)) for frame in file.frames]
    return estimate_of_boxes(model, frames, rig)


def estimate_of_boxes(model: Model, frames: Sequence[FrameBoxes], rig: CameraRig) -> EstimatedScore:
    """The score from the boxes of a run, all of them, in the ego frame. rig: of the drive."""
    range_m = model.config.bev_grid.nearest_side_m
    figures, fit = figures_of(frames, rig, range_m), fits().get(model.weights_hash)
    nd_score = None if fit is None else fit.nd_score(figures)
    low = high = None
    notes = [NO_FIT] if fit is None else []
    if fit is not None and nd_score is None:
        notes.append(
            f"no NDS: {figures.frames} frames (expected {fit.least_frames} or more that follow each other, with poses)"
        )
    elif fit is not None and nd_score is not None:
        low, high = max(0.0, nd_score - fit.half_width), min(1.0, nd_score + fit.half_width)
        notes += [
            f"{name.replace('_', ' ')} is {getattr(figures, name):.3g}, outside the drives that the estimate was "
            f"fitted on ({fit.lowest[name]:.3g} to {fit.highest[name]:.3g}): the interval may not hold"
            for name in fit.outside(figures)
        ]
    parts = _Parts(frames, range_m, fit)
    ranges = DetectionConfig.of(model.config.object_classes).cut_at(range_m).range_bins_m
    return EstimatedScore(
        nd_score,
        low,
        high,
        figures,
        {name: parts.of(parts.boxes.classes == name) for name in model.config.classes},
        {camera.name: parts.of(camera.sees(parts.boxes.centers)) for camera in rig.cameras},
        {f"{a:g}-{b:g} m": parts.of((parts.distances >= a) & (parts.distances < b)) for a, b in ranges},
        tuple(notes),
    )


class _Parts:
    """The boxes of all frames that are shown, and the expected precision of some of them."""

    def __init__(self, frames: Sequence[FrameBoxes], range_m: float, fit: Fit | None) -> None:
        self.boxes = Boxes3D.concatenate([within(frame.boxes, range_m).scored(SHOWN) for frame in frames])
        self.distances = np.linalg.norm(self.boxes.centers[:, :2], axis=1)
        self._frames = max(1, len(frames))
        self._right = None if fit is None else fit.right(self.boxes)

    def of(self, chosen: Any) -> Part:
        """chosen: (N,) bool, of the boxes."""
        count = int(chosen.sum())
        score = float(scores_of(self.boxes)[chosen].mean()) if count else np.nan
        precision = float(self._right[chosen].mean()) if count and self._right is not None else np.nan
        return Part(count / self._frames, score, precision)


@cache
def fits() -> dict[str, Fit]:
    """The fits of the package, by the hash of the weights."""
    folder = resources.files("bevcli").joinpath("workshop", "trust", "fits")
    files = [file for file in folder.iterdir() if file.name.endswith(".toml")]
    tables = [(parse_toml(file.read_text(encoding="utf-8"), file.name), file.name) for file in files]
    return {fit.weights_hash: fit for fit in (settings_of_table(table, "fit", Fit, name) for table, name in tables)}
