"""The files of a run: each is whole after every frame."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from bevcli.errors import OutputError
from bevcli.evaluation.submission import SubmissionWriter
from bevcli.frame import Frame, Prediction
from bevcli.geometry.attributes import attributes_by_speed
from bevcli.pipeline.bev_files import save_bev
from bevcli.recording.writer import Recording
from bevcli.sequences.files.boxes_file import BoxesWriter, FrameBoxes
from bevcli.sequences.files.map_file import write_map

if TYPE_CHECKING:
    from bevcli.pipeline.run_job import Job

RECORDING, PREDICTIONS, SUBMISSION = "recording.rrd", "predictions.json", "results_nusc.json"
SUMMARY, SEGMENTATION = "summary.json", "segmentation"


def prepare_folder(out: Path, *, force: bool) -> None:
    """Makes the output folder; an earlier run's files are removed only if the user says so. Raises OutputError."""
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is a file (expected a folder to write to)")
    if out.exists() and any(out.iterdir()) and not force:
        raise OutputError(f"{out}: exists already; say --force to overwrite it, or --out DIR for another folder")
    try:
        out.mkdir(parents=True, exist_ok=True)
        earlier = [out / name for name in (RECORDING, PREDICTIONS, SUBMISSION, SUMMARY)]
        for path in (*earlier, *(out / SEGMENTATION).glob("[0-9]*.png")):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror})") from None


class RunFiles:
    """`with RunFiles(job) as files: files.write(frame, prediction)`: recording, boxes, maps, BEV features."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._stack = contextlib.ExitStack()
        self._submission: SubmissionWriter | None = None

    def __enter__(self) -> RunFiles:
        job, config = self._job, self._job.loaded.model.config
        recording = Recording(job.out / RECORDING, job.drive, job.loaded, job.recording, job.live)
        extras = {"model": config.name, "untrained": job.loaded.untrained, "classes": list(config.classes)}
        boxes = BoxesWriter(job.out / PREDICTIONS, "world" if job.drive.has_ego_motion else "ego", extras)
        with self._stack:  # what is open is closed again where the next cannot be opened
            self._recording = self._stack.enter_context(recording)
            self._boxes = self._stack.enter_context(boxes)
            for note in job.drive.notes:
                self._recording.event(note, "WARN")
            self._stack = self._stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def write(self, frame: Frame, prediction: Prediction) -> None:
        """Adds a frame to every file."""
        job = self._job
        self._recording.log(frame, prediction)
        boxes = frame_boxes(frame, prediction, world=job.drive.has_ego_motion)
        self._boxes.write(boxes)
        if frame.sample_token is not None:
            if self._submission is None:
                self._submission = self._stack.enter_context(SubmissionWriter(job.out / SUBMISSION))
            self._submission.write(boxes)
        if prediction.segmentation is not None:
            write_map(job.out / SEGMENTATION, frame.stamp.index, prediction.segmentation)
        if job.save_bev is not None and prediction.bev is not None:
            facts = {"model": job.loaded.model.config.name, "untrained": job.loaded.untrained}
            save_bev(job.save_bev, prediction, facts)


def frame_boxes(frame: Frame, prediction: Prediction, *, world: bool) -> FrameBoxes:
    """A prediction as the boxes file holds it: all boxes, with attributes, in the world or the ego frame."""
    extras: dict[str, object] = {"skipped": True} if prediction.skipped else {}
    if frame.sample_token is not None:
        extras["sample_token"] = frame.sample_token
    boxes = prediction.boxes_world if world else prediction.boxes_ego
    boxes = replace(boxes, attributes=attributes_by_speed(boxes))
    return FrameBoxes(frame.stamp, frame.world_from_ego if world else None, boxes, extras)
