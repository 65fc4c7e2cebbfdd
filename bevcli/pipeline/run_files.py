"""The files of a run. Each of them is complete after every frame."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from types import TracebackType

from bevcli.errors import OutputError
from bevcli.evaluation.export_csv import CsvWriter
from bevcli.evaluation.submission import SubmissionWriter
from bevcli.frame import Frame, Prediction, Sequence
from bevcli.geometry.boxes import attributes_by_speed
from bevcli.pipeline.bev_files import save_bev
from bevcli.pipeline.model_loading import Model
from bevcli.pipeline.run_summary import SUMMARY
from bevcli.recording.options import RecordingOptions
from bevcli.recording.writer import LiveSink, Recording
from bevcli.sequences.files.boxes_file import BoxesWriter, FrameBoxes
from bevcli.sequences.files.map_folder import write_map

RECORDING, PREDICTIONS, SUBMISSION = "recording.rrd", "predictions.json", "results_nusc.json"
TRACKS, SEGMENTATION = "tracks.csv", "segmentation"


def prepare_folder(out: Path, *, force: bool) -> None:
    """Makes the output folder of a run. With `force` it removes the files of an earlier run. Raises OutputError."""
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is a file (expected a folder to write to)")
    if out.exists() and any(out.iterdir()) and not force:
        raise OutputError(f"{out}: exists already; pass --force to overwrite it, or --out DIR for another folder")
    try:
        out.mkdir(parents=True, exist_ok=True)
        earlier = [out / name for name in (RECORDING, PREDICTIONS, TRACKS, SUBMISSION, SUMMARY)]
        for path in (*earlier, *(out / SEGMENTATION).glob("[0-9]*.png")):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror})") from None


class RunFiles:
    """`with RunFiles(…) as files: files.write(frame, prediction)`: recording, boxes, tracks, maps and BEV features."""

    def __init__(
        self,
        out: Path,
        sequence: Sequence,
        model: Model,
        recording: RecordingOptions,
        bev_folder: Path | None = None,
        live: LiveSink | None = None,
        *,
        track: bool = True,
    ) -> None:
        self._out, self._sequence, self._model, self._bev_folder = out, sequence, model, bev_folder
        self._options, self._live, self._track = recording, live, track
        self._stack = contextlib.ExitStack()
        self._submission: SubmissionWriter | None = None
        self._tracks: CsvWriter | None = None
        self._reference = "world" if sequence.has_ego_motion else "ego"

    def __enter__(self) -> RunFiles:
        out, sequence, model = self._out, self._sequence, self._model
        recording = Recording(out / RECORDING, sequence, model, self._options, self._live)
        extras = {"model": model.name, "untrained": model.untrained, "classes": list(model.config.classes)}
        boxes = BoxesWriter(out / PREDICTIONS, self._reference, extras)
        with self._stack:  # closes what is open if the next one cannot be opened
            self._recording = self._stack.enter_context(recording)
            self._boxes = self._stack.enter_context(boxes)
            if self._track:
                self._tracks = self._stack.enter_context(CsvWriter(out / TRACKS))
            for note in sequence.notes:
                self._recording.event(note, "WARN")
            self._stack = self._stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def write(self, frame: Frame, prediction: Prediction) -> None:
        """Adds a frame to every file."""
        self._recording.log(frame, prediction)
        boxes = frame_boxes(frame, prediction, world=self._sequence.has_ego_motion)
        self._boxes.write(boxes)
        if self._tracks is not None:
            self._tracks.write(_with_identity(boxes), self._reference)
        if frame.sample_token is not None:
            if self._submission is None:
                self._submission = self._stack.enter_context(SubmissionWriter(self._out / SUBMISSION))
            self._submission.write(boxes)
        if prediction.segmentation is not None:
            write_map(self._out / SEGMENTATION, frame.stamp.index, prediction.segmentation)
        if self._bev_folder is not None and prediction.bev is not None:
            facts = {"model": self._model.name, "untrained": self._model.untrained}
            save_bev(self._bev_folder, prediction, facts)

    def written(self) -> tuple[Path, ...]:
        """The files and folders that exist so far."""
        paths = [self._out / name for name in (RECORDING, PREDICTIONS, TRACKS, SUBMISSION, SEGMENTATION)]
        return tuple(path for path in (*paths, self._bev_folder) if path is not None and path.exists())


def frame_boxes(frame: Frame, prediction: Prediction, *, world: bool) -> FrameBoxes:
    """A prediction as predictions.json holds it: all boxes, with attributes, in the world frame or the ego frame."""
    extras: dict[str, object] = {"skipped": True} if prediction.skipped else {}
    if frame.sample_token is not None:
        extras["sample_token"] = frame.sample_token
    boxes = prediction.boxes_world if world else prediction.boxes_ego
    boxes = replace(boxes, attributes=attributes_by_speed(boxes))
    return FrameBoxes(frame.stamp, frame.world_from_ego if world else None, boxes, extras)


def _with_identity(frame: FrameBoxes) -> FrameBoxes:
    """The boxes of a frame that belong to a track."""
    instances = frame.boxes.instances
    return frame if instances is None else replace(frame, boxes=frame.boxes[instances != ""])
