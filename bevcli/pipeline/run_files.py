"""The files of a run. Each of them holds all finished frames, whatever ends the run."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType

from bevcli.errors import OutputError
from bevcli.evaluation.export_csv import CsvWriter
from bevcli.evaluation.submission import SubmissionWriter
from bevcli.frame import Frame, Prediction, Sequence
from bevcli.geometry.boxes import attributes_by_speed
from bevcli.pipeline.bev_files import save_bev
from bevcli.pipeline.model_loading import Model
from bevcli.pipeline.run_folder import RunFolder
from bevcli.recording.options import RecordingOptions
from bevcli.recording.writer import LiveSink, Recording, RecordingState
from bevcli.sequences.files.boxes_file import BoxesWriter, FrameBoxes
from bevcli.sequences.files.map_folder import map_path, write_map
from bevcli.viewer.recording_file import restore_index

RECORDING, PREDICTIONS, SUBMISSION = "recording.rrd", "predictions.json", "results_nusc.json"
TRACKS, SEGMENTATION = "tracks.csv", "segmentation"


@dataclass(frozen=True)
class FilesState:
    """What the files of an interrupted run need to go on.

    Attributes:
        recording: of recording.rrd.
        predictions: bytes of predictions.json.
        tracks: bytes of tracks.csv, None without one.
        submission: bytes of results_nusc.json, None without one.
    """

    recording: RecordingState
    predictions: int
    tracks: int | None
    submission: int | None


class RunFiles:
    """`with RunFiles(…) as files: files.write(frame, prediction)`: recording, boxes, tracks, maps and BEV features."""

    def __init__(
        self,
        folder: RunFolder,
        sequence: Sequence,
        model: Model,
        recording: RecordingOptions,
        bev_folder: Path | None = None,
        live: LiveSink | None = None,
        *,
        track: bool = True,
        resume: FilesState | None = None,
    ) -> None:
        self._folder, self._out, self._resume = folder, folder.path, resume
        self._sequence, self._model, self._bev_folder = sequence, model, bev_folder
        self._options, self._live, self._track = recording, live, track
        self._stack = contextlib.ExitStack()
        self._submission: SubmissionWriter | None = None
        self._tracks: CsvWriter | None = None
        self._reference = "world" if sequence.has_ego_motion else "ego"

    def __enter__(self) -> RunFiles:
        out, sequence, model, resume = self._out, self._sequence, self._model, self._resume
        for name in (RECORDING, PREDICTIONS, *((TRACKS,) if self._track else ())):
            self._folder.add(out / name)
        past = None if resume is None else resume.recording
        recording = Recording(out / RECORDING, sequence, model, self._options, self._live, past)
        extras = {
            "model": model.name,
            "untrained": model.untrained,
            "classes": list(model.config.classes),
            "range_m": model.config.bev_grid.nearest_side_m,
        }
        boxes_at, tracks_at = (None, None) if resume is None else (resume.predictions, resume.tracks)
        boxes = BoxesWriter(out / PREDICTIONS, self._reference, extras, resume_at=boxes_at)
        with self._stack:  # closes what is open if the next one cannot be opened
            self._recording = self._stack.enter_context(recording)
            self._boxes = self._stack.enter_context(boxes)
            if self._track:
                self._tracks = self._stack.enter_context(CsvWriter(out / TRACKS, tracks_at))
            if resume is not None and resume.submission is not None:
                self._open_submission(resume.submission)
            for note in sequence.notes if resume is None else ():
                self._recording.event(note, "WARN")
            self._stack = self._stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)
        if self._resume is not None:
            restore_index(self._out / RECORDING)

    def write(self, frame: Frame, prediction: Prediction) -> None:
        """Adds a frame to every file."""
        if prediction.segmentation is not None:
            maps = self._out / SEGMENTATION
            self._folder.add(map_path(maps, frame.stamp.index))
            write_map(maps, frame.stamp.index, prediction.segmentation)
        if self._bev_folder is not None and prediction.bev is not None:
            facts = {"model": self._model.name, "untrained": self._model.untrained}
            save_bev(self._bev_folder, prediction, facts)
        self._recording.log(frame, prediction)
        boxes = frame_boxes(frame, prediction, world=self._sequence.has_ego_motion)
        if self._tracks is not None:
            self._tracks.write(_with_identity(boxes), self._reference)
        if frame.sample_token is not None:
            (self._submission or self._open_submission()).write(boxes)
        self._boxes.write(boxes)  # last: a frame in predictions.json is in the other files too
        self._check_that_files_exist()

    def state(self) -> FilesState | None:
        """What later RunFiles need to go on after the last frame; None as long as they cannot."""
        recording = self._recording.state()
        if recording is None:
            return None
        tracks, submission = (None if file is None else file.file.size for file in (self._tracks, self._submission))
        return FilesState(recording, self._boxes.file.size, tracks, submission)

    def _open_submission(self, resume_at: int | None = None) -> SubmissionWriter:
        self._folder.add(self._out / SUBMISSION)
        self._submission = self._stack.enter_context(SubmissionWriter(self._out / SUBMISSION, resume_at))
        return self._submission

    def _check_that_files_exist(self) -> None:
        deleted = self._recording.is_deleted() or self._boxes.file.is_deleted()
        if deleted or (self._tracks is not None and self._tracks.file.is_deleted()):
            raise OutputError(f"{self._out}: the files of this run were deleted while it was writing them")

    def written(self) -> tuple[Path, ...]:
        """The files and folders that exist so far."""
        paths = [self._out / name for name in (RECORDING, PREDICTIONS, TRACKS, SUBMISSION, SEGMENTATION)]
        return tuple(path for path in (*paths, self._bev_folder) if path is not None and path.exists())


def frame_boxes(frame: Frame, prediction: Prediction, *, world: bool) -> FrameBoxes:
    """A prediction as predictions.json holds it: all boxes, with attributes, in the world frame or the ego frame."""
    extras: dict[str, object] = {"skipped": True} if prediction.skipped else {}
    if prediction.not_finite:
        extras["not_finite"] = prediction.not_finite
    if frame.sample_token is not None:
        extras["sample_token"] = frame.sample_token
    boxes = prediction.boxes_world if world else prediction.boxes_ego
    boxes = replace(boxes, attributes=attributes_by_speed(boxes))
    return FrameBoxes(frame.stamp, frame.world_from_ego if world else None, boxes, extras)


def _with_identity(frame: FrameBoxes) -> FrameBoxes:
    """The boxes of a frame that belong to a track."""
    instances = frame.boxes.instances
    return frame if instances is None else replace(frame, boxes=frame.boxes[instances != ""])
