"""The frames with most missed and most invented boxes, of one model or of two, and those where two differ most."""

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.boxes import ScoredBoxes
from bevcli.sequences.files.boxes_file import FrameBoxes
from bevcli.sequences.format import is_drive
from bevcli.workshop.formats import is_nuscenes_root
from bevcli.workshop.scores.detection import ClassMatches
from bevcli.workshop.scores.inputs import Compared
from bevcli.workshop.scores.tables import Table

MODELS = ("A", "B")


class Outcome(NamedTuple):
    """One class above the score threshold with the largest F1: ground truth found and missed, and false positives."""

    found: ScoredBoxes
    missed: ScoredBoxes
    false: ScoredBoxes


def best_outcome(matches: ClassMatches, row: int) -> Outcome:
    """Cut a class at the score with the largest F1. row: index of the matching distance."""
    is_match = matches.matched[row] >= 0
    f1 = 2 * np.cumsum(is_match) / (np.arange(1, len(is_match) + 1) + len(matches.ground_truth))
    kept = np.arange(len(is_match)) < (int(f1.argmax()) + 1 if is_match.any() else 0)
    is_matched = np.zeros(len(matches.ground_truth), dtype=bool)
    is_matched[matches.matched[row][kept & is_match]] = True
    truth = matches.ground_truth
    return Outcome(truth[is_matched], truth[~is_matched], matches.predictions[kept & ~is_match])


@dataclass(frozen=True)
class WorstFrames:
    """The worst of F frames, for M models, which are one or two."""

    frames: tuple[FrameBoxes, ...]  # of the ground truth
    boxes: NDArray[np.int64]  # (F,), number of ground truths that are scored
    missed: NDArray[np.int64]  # (M, F), number of ground truths that a model does not find
    invented: NDArray[np.int64]  # (M, F), number of its false positives
    count: int  # the largest number of frames in a list
    distance_m: float  # the matching distance
    command: tuple[str, ...] = ()  # the words of `bevcli viz` with the boxes; empty if the ground truth is not a drive
    scene_starts: Mapping[str, int] = field(default_factory=dict)  # first frame by scene, if frames count by scene
    notes: tuple[str, ...] = ()

    @property
    def lists(self) -> dict[str, list[int]]:
        """The worst frames first, as indices, by "missed" and "invented"; of two "a_missed" and so on, "difference"."""
        if len(self.missed) == 1:
            return {"missed": self._largest(self.missed[0]), "invented": self._largest(self.invented[0])}
        lists = {
            f"{model.lower()}_{mistake}": self._largest(counts[index])
            for index, model in enumerate(MODELS)
            for mistake, counts in (("missed", self.missed), ("invented", self.invented))
        }
        mistakes = self.missed + self.invented
        return {"difference": self._largest(abs(mistakes[0] - mistakes[1])), **lists}

    def _largest(self, counts: NDArray[np.int64]) -> list[int]:
        """The indices of the largest counts above 0; of equal ones the earlier first."""
        order = np.argsort(-counts, kind="stable")[: self.count]
        return [int(index) for index in order if counts[index] > 0]

    @property
    def view(self) -> str | None:
        """The command that shows the worst frame: where two differ most, or with most missed boxes."""
        first = next((indices[0] for indices in self.lists.values() if indices), None)
        if first is None or not self.command:
            return None
        stamp = self.frames[first].stamp
        if stamp.scene not in self.scene_starts:
            return shlex.join((*self.command, "--frame", str(stamp.index)))
        index = stamp.index - self.scene_starts[stamp.scene]
        return shlex.join((*self.command, "--scene", stamp.scene, "--frame", str(index)))

    def to_dict(self) -> dict[str, Any]:
        """The lists as dicts for JSON, and the command."""
        lists = {name: [self._entry(index) for index in indices] for name, indices in self.lists.items()}
        return {"worst_frames": {**lists, "view": self.view}}

    def _entry(self, index: int) -> dict[str, Any]:
        frame = self.frames[index]
        token = {"sample_token": frame.extras["sample_token"]} if "sample_token" in frame.extras else {}
        counts = dict(zip(self._columns(), self._counts(index), strict=True))
        return {
            "frame": frame.stamp.index,
            "scene": frame.stamp.scene,
            "timestamp_ns": frame.stamp.timestamp_ns,
            **token,
            "ground_truth_boxes": int(self.boxes[index]),
            **{name.lower().replace(" ", "_"): count for name, count in counts.items()},
        }

    def _columns(self) -> list[str]:
        models = ("",) if len(self.missed) == 1 else tuple(f"{model} " for model in MODELS)
        return [f"{model}{mistake}" for model in models for mistake in ("missed", "invented")]

    def _counts(self, index: int) -> list[int]:
        pairs = zip(self.missed[:, index].tolist(), self.invented[:, index].tolist(), strict=True)
        return [count for pair in pairs for count in pair]

    def tables(self) -> Iterable[Table]:
        """One table of all lists."""
        rows: list[list[str | int]] = []
        several = len({frame.stamp.scene for frame in self.frames}) > 1
        for name, indices in self.lists.items():
            *model, mistake = name.split("_")  # such as "a_missed"
            heading = " ".join([*map(str.upper, model), "most", mistake])
            heading = "largest difference" if mistake == "difference" else heading
            for rank, index in enumerate(indices):
                stamp = self.frames[index].stamp
                frame = f"{stamp.scene} frame {stamp.index}" if several else f"frame {stamp.index}"
                counts = (int(self.boxes[index]), *self._counts(index))
                rows.append(["" if rank else heading, frame, *counts])
        below = f"\n(scores from the largest F1 of each class at {self.distance_m:g} m on)"
        yield Table("worst frames", ("worst frames", "", "boxes", *self._columns()), rows, left=(0, 1), below=below)


def find_worst_frames(models: Sequence[Compared], count: int) -> WorstFrames:
    """The worst frames of one model or two, whose boxes are scored. Two have the same frames."""
    missed, invented, boxes = [], [], np.zeros(0, np.int64)
    truth, starts = models[0].truth, dict[str, int]()
    # Of a nuScenes root frames count from 0 in the scene that is opened; without it, all scenes are shown.
    if truth is not None and "scene" not in models[0].selection and is_nuscenes_root(truth.path):
        for frame in truth.boxes.frames:
            starts.setdefault(frame.stamp.scene, frame.stamp.index)
    for model in models:
        assert model.detection is not None
        config, frame_count = model.detection.config, model.detection.frame_count
        outcomes = [best_outcome(matches, config.error_row) for matches in model.detection.matches]
        missed.append(_by_frame([outcome.missed for outcome in outcomes], frame_count))
        invented.append(_by_frame([outcome.false for outcome in outcomes], frame_count))
        boxes = _by_frame([match.ground_truth for match in model.detection.matches], frame_count)
    return WorstFrames(
        models[0].pairs.ground_truth,
        boxes,
        np.stack(missed),
        np.stack(invented),
        count,
        config.error_distance_m,
        _command(models),
        starts,
    )


def _by_frame(parts: Sequence[ScoredBoxes], frame_count: int) -> NDArray[np.int64]:
    """(F,), number of boxes."""
    return np.bincount(np.concatenate([boxes.frames for boxes in parts]), minlength=frame_count)


def _command(models: Sequence[Compared]) -> tuple[str, ...]:
    """The words of `bevcli viz` for the boxes on their drive; none if the ground truth is not in a drive."""
    truth, files = models[0].truth, [model.predictions.path for model in models if model.predictions is not None]
    if truth is None or len(files) < len(models):
        return ()
    drive = truth.path.parent if truth.path.name == "ground_truth.json" else truth.path
    if not is_drive(drive):
        return ()
    boxes = [word for file in files for word in ("--boxes", str(file))]
    selection = [word for name, value in models[0].selection.items() for word in (f"--{name}", value)]
    return ("bevcli", "viz", str(drive), *boxes, *selection)
