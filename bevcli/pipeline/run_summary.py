"""What a run did: summary.json for machines, a short table for the person at the terminal."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from statistics import median
from typing import TYPE_CHECKING

from bevcli import __version__
from bevcli.cli.progress import duration
from bevcli.frame import Frame, Prediction
from bevcli.pipeline.camera_assignment import assign_cameras
from bevcli.pipeline.run_files import PREDICTIONS, RECORDING, SEGMENTATION, SUBMISSION, SUMMARY

if TYPE_CHECKING:
    from bevcli.pipeline.run_job import Job


class RunSummary:
    """Counts and times; no frame is kept."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._seconds: dict[str, list[float]] = defaultdict(list)
        self._whole: list[float] = []
        self._boxes: Counter[str] = Counter()
        self._dropped: list[dict[str, object]] = []
        self._skipped: list[int] = []
        self._started_anew: list[dict[str, object]] = []
        self._embeddings: dict[str, str] = {}

    def add(self, frame: Frame, prediction: Prediction, recording_s: float, whole_s: float) -> None:
        """Count a frame. whole_s: since the frame before was done; recording_s: the part spent on writing."""
        if not self._embeddings:
            assignment = assign_cameras(frame.rig, self._job.loaded.model.config.cameras, self._job.chosen_cameras)
            self._embeddings = dict(zip(assignment.cameras, assignment.embeddings, strict=True))
        self._whole.append(whole_s)
        for stage, seconds in {**prediction.stage_seconds, "recording": recording_s}.items():
            self._seconds[stage].append(seconds)
        scores = prediction.boxes.scores
        if scores is not None:
            self._boxes.update(prediction.boxes.classes[scores >= self._job.recording.score].tolist())
        index = frame.stamp.index
        self._dropped += [{"frame": index, "camera": name, "reason": why} for name, why in frame.dropped.items()]
        if prediction.skipped:
            self._skipped.append(index)
        if prediction.started_anew:
            self._started_anew.append({"frame": index, "reason": prediction.started_anew})

    def as_data(self) -> dict[str, object]:
        """What summary.json holds."""
        job, config = self._job, self._job.loaded.model.config
        return {
            "bevcli_version": __version__,
            "sequence": job.drive.name,
            "model": config.name,
            "weights": None if job.loaded.weights is None else str(job.loaded.weights),
            "untrained": job.loaded.untrained,
            "device": job.device.type,
            "precision": job.step.precision,
            "temporal": job.step.temporal,
            "frames": len(self._whole),
            "frames_asked_for": len(job.drive.stamps),
            "score": job.recording.score,
            "boxes": sum(self._boxes.values()),
            "boxes_by_class": dict(self._boxes),
            "frames_per_second": self._rate(),
            "stage_ms": {stage: round(1000 * median(s), 3) for stage, s in self._seconds.items()},
            "camera_embeddings": self._embeddings,
            "dropped_pictures": self._dropped,
            "skipped_frames": self._skipped,
            "started_anew": self._started_anew,
            "notes": list(job.drive.notes),
            "files": self._files(),
        }

    def write(self) -> None:
        """Writes summary.json, whatever the run came to."""
        (self._job.out / SUMMARY).write_text(json.dumps(self.as_data(), indent=1) + "\n")

    def table(self) -> str:
        """The last words of a run."""
        guessed = [f"{name} as {given}" for name, given in self._embeddings.items() if name != given]
        stages = ", ".join(f"{stage} {1000 * median(s):.0f} ms" for stage, s in self._seconds.items())
        rows = [
            ("frames", f"{len(self._whole)} in {duration(sum(self._whole))}, {self._rate():.2f} per second"),
            ("boxes", f"{sum(self._boxes.values())} with a score of {self._job.recording.score:g} or more"),
            ("stages", f"{stages} (medians)"),
        ]
        if guessed:
            rows.append(("cameras", f"{', '.join(guessed)} (embeddings; --camera changes them)"))
        if self._dropped:
            rows.append(("dropped", f"{len(self._dropped)} images, {len(self._skipped)} frames without any"))
        if self._job.loaded.untrained:
            rows.append(("weights", "UNTRAINED: random, the boxes mean nothing"))
        rows += [("written", path) for path in self._files()]
        return "\n".join(f"{name:<8} {text}" for name, text in rows)

    def _rate(self) -> float:
        return len(self._whole) / sum(self._whole) if self._whole else 0.0

    def _files(self) -> list[str]:
        written = [self._job.out / name for name in (RECORDING, PREDICTIONS, SUBMISSION, SEGMENTATION)]
        found = [path for path in written if path.exists()] + [self._job.out / SUMMARY]
        return [str(path) for path in (*found, *([self._job.save_bev] if self._job.save_bev else []))]
