"""RunSummary: what a run did, as summary.json and as a short table."""

from __future__ import annotations

import contextlib
import json
import os
from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bevcli import __version__
from bevcli.duration import duration
from bevcli.errors import OutputError
from bevcli.frame import Frame, Prediction, Sequence
from bevcli.pipeline.medians import RunningMedian
from bevcli.pipeline.model_loading import Model
from bevcli.pipeline.run_folder import SUMMARY

_COUNTS = ("seconds", "whole", "boxes", "tracks", "dropped", "skipped", "started_anew", "embeddings")


class RunSummary:
    """Counts and times of a run. It keeps no frame.

    Attributes:
        files: the files that the run wrote, summary.json excluded.
    """

    def __init__(self, model: Model, sequence: Sequence, score: float, *, temporal: bool) -> None:
        self.files: tuple[Path, ...] = ()
        self._model, self._sequence, self._score, self._temporal = model, sequence, score, temporal
        self._seconds: dict[str, RunningMedian] = defaultdict(RunningMedian)
        self._whole = RunningMedian()
        self._boxes: Counter[str] = Counter()
        self._tracks: dict[str, str] | None = None  # identity -> class
        self._dropped: list[dict[str, object]] = []
        self._skipped: list[int] = []
        self._not_finite: list[dict[str, object]] = []
        self._started_anew: list[dict[str, object]] = []
        self._embeddings: dict[str, str] = {}

    def add(self, frame: Frame, prediction: Prediction, recording_s: float, whole_s: float) -> None:
        """Counts a frame.

        Args:
            frame: the frame.
            prediction: its prediction.
            recording_s: seconds spent on writing.
            whole_s: seconds since the frame before was done.
        """
        self._embeddings = self._embeddings or dict(prediction.camera_embeddings)
        self._whole.add(whole_s)
        for stage, seconds in {**prediction.stage_seconds, "recording": recording_s}.items():
            self._seconds[stage].add(seconds)
        scores = prediction.boxes.scores
        if scores is not None:
            shown = prediction.boxes[scores >= self._score]
            self._boxes.update(shown.classes.tolist())
            if shown.instances is not None:
                owners = zip(shown.instances.tolist(), shown.classes.tolist(), strict=True)
                self._tracks = self._tracks or {}
                self._tracks.update({instance: name for instance, name in owners if instance})
        index = frame.stamp.index
        self._dropped += [{"frame": index, "camera": name, "reason": why} for name, why in frame.dropped.items()]
        if prediction.skipped:
            self._skipped.append(index)
        if prediction.not_finite:
            self._not_finite.append({"frame": index, "where": prediction.not_finite})
        if prediction.started_anew:
            self._started_anew.append({"frame": index, "reason": prediction.started_anew})

    @property
    def frames(self) -> int:
        """The number of frames that are done."""
        return self._whole.count

    @property
    def is_complete(self) -> bool:
        """Whether all frames are done."""
        return self.frames == len(self._sequence.stamps)

    def state(self) -> dict[str, Any]:
        """What `restore` needs to count on."""
        return {name: getattr(self, f"_{name}") for name in _COUNTS}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Goes on from the `state` of the summary of an interrupted run."""
        for name in _COUNTS:
            setattr(self, f"_{name}", state[name])
        self._boxes = Counter(self._boxes)
        self._seconds = defaultdict(RunningMedian, self._seconds)

    def to_dict(self) -> dict[str, object]:
        """The contents of summary.json."""
        model = self._model
        return {
            "bevcli_version": __version__,
            "sequence": self._sequence.name,
            "model": model.name,
            "weights": None if model.weights is None else str(model.weights),
            "untrained": model.untrained,
            "device": model.device.type,
            "precision": model.precision,
            "temporal": self._temporal,
            "frames": self._whole.count,
            "frames_asked_for": len(self._sequence.stamps),
            "score": self._score,
            "boxes": sum(self._boxes.values()),
            "boxes_by_class": dict(self._boxes),
            "tracks": None if self._tracks is None else len(self._tracks),
            "tracks_by_class": dict(Counter((self._tracks or {}).values())),
            "frames_per_second": self._rate(),
            "stage_ms": {stage: round(1000 * s.value(), 3) for stage, s in self._seconds.items()},
            "camera_embeddings": self._embeddings,
            "dropped_pictures": self._dropped,
            "skipped_frames": self._skipped,
            "not_finite_frames": self._not_finite,
            "started_anew": self._started_anew,
            "notes": [*self._sequence.notes, *self._model.rig_notes(self._sequence.rig)],
            "files": [str(path) for path in self.files],
        }

    def write(self, folder: Path) -> None:
        """Writes summary.json into a folder, and adds it to `files`. Raises OutputError."""
        path = folder / SUMMARY
        fresh = path.with_name(SUMMARY + ".new")
        self.files = (*self.files, path)
        try:
            fresh.write_text(json.dumps(self.to_dict(), indent=1) + "\n")
            os.replace(fresh, path)
        except OSError as error:
            with contextlib.suppress(OSError):
                fresh.unlink()
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from None

    def table(self) -> str:
        """The summary as a few aligned lines."""
        guessed = [f"{name} as {given}" for name, given in self._embeddings.items() if name != given]
        stages = ", ".join(f"{stage} {1000 * s.value():.0f} ms" for stage, s in self._seconds.items())
        rows = [
            ("frames", f"{self._whole.count} in {duration(self._whole.total_s)}, {self._rate():.2f} per second"),
            ("boxes", f"{sum(self._boxes.values())} with a score of {self._score:g} or more"),
            ("stages", f"{stages} (medians)"),
        ]
        if self._tracks is not None:
            rows.insert(2, ("tracks", f"{len(self._tracks)} objects have such boxes"))
        if guessed:
            rows.append(("cameras", f"{', '.join(guessed)} (embeddings; --camera changes them)"))
        if self._dropped:
            rows.append(("dropped", f"{len(self._dropped)} images, {len(self._skipped)} frames without any"))
        if self._not_finite:
            first = self._not_finite[0]
            rows.append(("failed", f"{len(self._not_finite)} frames: NaN or infinity, first in {first['where']}"))
        if self._model.untrained:
            rows.append(("weights", "UNTRAINED: random weights, the boxes are meaningless"))
        rows += [("rig", note) for note in self._model.rig_notes(self._sequence.rig)]
        rows += [("written", str(path)) for path in self.files]
        return "\n".join(f"{name:<8} {text}" for name, text in rows)

    def _rate(self) -> float:
        return self._whole.count / self._whole.total_s if self._whole.count else 0.0
