"""The loop over a sequence: `run` yields predictions, `run_into_folder` also writes them as `bevcli run` does."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from bevcli.frame import Frame, Prediction, Sequence
from bevcli.pipeline.model_loading import Model
from bevcli.pipeline.preprocess import Preprocessor
from bevcli.pipeline.run_files import RunFiles, prepare_folder
from bevcli.pipeline.run_summary import RunSummary
from bevcli.pipeline.runner import Runner, StepOptions
from bevcli.pipeline.tracking import track as track_boxes
from bevcli.recording.options import RecordingOptions
from bevcli.recording.writer import LiveSink


def run(
    model: Model,
    sequence: Sequence,
    *,
    temporal: bool = True,
    track: bool = True,
    attention: bool = False,
    probes: tuple[tuple[float, float], ...] = (),
    cameras: Mapping[str, str] | None = None,
) -> Iterator[tuple[Frame, Prediction]]:
    """Runs a model over a sequence, frame by frame; the BEV map of a frame is the history of the next.

        for frame, prediction in bevcli.run(model, drive):
            print(frame.stamp.index, len(prediction.boxes))

    Frames are read and prepared in the background. Nothing is kept of a frame after it was yielded.

    Args:
        model: of `load_model`.
        sequence: of `open_sequence`.
        temporal: whether the previous BEV map is used.
        track: whether the boxes get identities over time: the columns `instances`, `track_scores` and `duplicates`.
        attention: whether `Prediction.attention` is filled in.
        probes: x, y in metres, bev frame: BEV cells whose sampling points `Prediction.attention` shows. They imply
            `attention`.
        cameras: camera of the rig -> camera of the model whose embedding it takes. Default: the camera of the same
            name, else the one with the nearest viewing direction.

    Raises:
        InputError: a frame cannot be read, a probe lies outside the BEV grid, or a camera is unknown.
    """
    options = StepOptions(model.precision, temporal, ask_attention=attention or bool(probes), probes=tuple(probes))
    runner = Runner(model.prepared, model.device, options)
    steps = runner.run(sequence, range(len(sequence.stamps)), Preprocessor(model.config, cameras))
    predictions = ((frame, prediction) for frame, prediction, _ in steps)
    if not track:
        return predictions
    return ((frame, prediction) for frame, prediction, _ in track_boxes(model.tracker, predictions))


@dataclass(frozen=True)
class RunOptions:
    """How a run is made and what it writes.

    Attributes:
        temporal: whether the previous BEV map is used.
        track: whether boxes get identities over time, and tracks.csv is written.
        cameras: camera of the rig -> camera of the model whose embedding it takes, see `run`.
        recording: what goes into recording.rrd.
        save_bev: folder for each frame's BEV features, None for none.
    """

    temporal: bool = True
    track: bool = True
    cameras: Mapping[str, str] = field(default_factory=dict)
    recording: RecordingOptions = field(default_factory=RecordingOptions)
    save_bev: Path | None = None


def run_into_folder(
    model: Model,
    sequence: Sequence,
    out: Path,
    options: RunOptions | None = None,
    *,
    live: LiveSink | None = None,
    force: bool = False,
    after_frame: Callable[[Frame, Prediction], None] = lambda frame, prediction: None,
) -> RunSummary:
    """Runs a model over a sequence and writes recording, boxes, tracks, maps and summary.json into a folder.

    Every file is complete after each frame. summary.json is written whatever ends the run.

    Args:
        model: of `load_model`.
        sequence: of `open_sequence`.
        out: the output folder, made where it is missing.
        options: default `RunOptions()`.
        live: a viewer that shows the recording while it is written.
        force: replace the files of an earlier run in `out`.
        after_frame: called after each frame has been written.

    Raises:
        InputError: see `run`.
        OutputError: the folder holds something already, or cannot be written.
    """
    options = RunOptions() if options is None else options
    prepare_folder(out, force=force)
    files = RunFiles(out, sequence, model, options.recording, options.save_bev, live, track=options.track)
    summary = RunSummary(model, sequence, options.recording.score, temporal=options.temporal)
    predictions = run(
        model,
        sequence,
        temporal=options.temporal,
        track=options.track,
        attention=options.recording.shows_internals,
        probes=options.recording.probes,
        cameras=options.cameras,
    )
    try:
        with files:
            began = time.perf_counter()
            for frame, prediction in predictions:
                writing_began = time.perf_counter()
                files.write(frame, prediction)
                now = time.perf_counter()
                summary.add(frame, prediction, recording_s=now - writing_began, whole_s=now - began)
                began = now
                after_frame(frame, prediction)
    finally:
        summary.files = files.written()
        summary.write(out)
    return summary
