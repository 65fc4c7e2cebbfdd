"""The loop over a sequence: `run` yields predictions, `run_into_folder` also writes them as `bevcli run` does."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from bevcli.errors import OutputError
from bevcli.frame import Frame, Prediction, Sequence
from bevcli.pipeline.model_loading import Model
from bevcli.pipeline.preprocess import Preprocessor
from bevcli.pipeline.run_files import RunFiles
from bevcli.pipeline.run_folder import SUMMARY, RunFolder
from bevcli.pipeline.run_state import RunnerState, RunState, StateSaver, open_state, run_facts
from bevcli.pipeline.run_summary import RunSummary
from bevcli.pipeline.runner import Runner, StepOptions
from bevcli.pipeline.state_file import save_state
from bevcli.pipeline.tracking import track as track_boxes
from bevcli.pipeline.tracking import without_identities
from bevcli.pipeline.write_behind import write_behind
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
            With history, those of a UniAD are the model's own.
        attention: whether `Prediction.attention` is filled in.
        probes: x, y in metres, bev frame: BEV cells whose sampling points `Prediction.attention` shows. They imply
            `attention`.
        cameras: camera of the rig -> camera of the model whose embedding it takes. Default: the camera of the same
            name, else the one with the nearest viewing direction.

    Raises:
        InputError: a frame cannot be read, a probe lies outside the BEV grid, or a camera is unknown.
    """
    asked = StepOptions(model.precision, temporal, ask_attention=attention or bool(probes), probes=tuple(probes))
    steps = _steps(model, sequence, asked, cameras, track=track)
    return ((frame, prediction) for frame, prediction, _ in steps)


def _steps(
    model: Model,
    sequence: Sequence,
    options: StepOptions,
    cameras: Mapping[str, str] | None,
    *,
    track: bool,
    start: int = 0,
    state: RunnerState = RunnerState(),
) -> Iterator[tuple[Frame, Prediction, RunnerState]]:
    """The frames from the place `start` on, with what the next frame needs."""
    runner = Runner(model.prepared, model.device, options)
    places = range(start, len(sequence.stamps))
    tracks = state.tracks
    for frame, prediction, bev in runner.run(sequence, places, Preprocessor(model.config, cameras), state.bev):
        tracked = prediction
        if not track:
            tracked = replace(prediction, boxes=without_identities(prediction.boxes))
        elif not runner.tracks:
            ((_, tracked, tracks),) = track_boxes(model.tracker, [(frame, prediction)], tracks)
        yield frame, tracked, RunnerState(bev, tracks)


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
    resume: bool = False,
    after_frame: Callable[[Frame, Prediction], None] = lambda frame, prediction: None,
    resumed: Callable[[int], None] = lambda frames: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> RunSummary:
    """Runs a model over a sequence and writes recording, boxes, tracks, maps and summary.json into a folder.

    Whatever ends the run: the files hold all finished frames, summary.json is written, and the state is saved, so that
    `resume` can go on. The files of a killed process hold all finished frames too, predictions.json as
    predictions.json.partial; its run goes on from the last saved state.

    Args:
        model: of `load_model`.
        sequence: of `open_sequence`.
        out: the output folder, made where it is missing. No other run can use it meanwhile.
        options: default `RunOptions()`.
        live: a viewer that shows the recording while it is written.
        force: remove the files that earlier runs wrote into `out`.
        resume: go on with an interrupted run of the same model, options and input; the files then equal those of a run
            without interruption. Where there is none, the run starts at the first frame.
        after_frame: called after each frame has been written.
        resumed: called once with the number of frames that an interrupted run had finished, if there are any.
        should_stop: asked after each frame; True ends the run.

    Raises:
        InputError: see `run`.
        OutputError: the folder holds something already, is in use by another run, cannot be written or was deleted; or
            the run to resume was another one.
    """
    options = RunOptions() if options is None else options
    if force and resume:
        raise OutputError("--force and --resume exclude each other: pass one of them")
    with RunFolder(out, force=force, resume=resume) as folder:
        facts = run_facts(model, sequence, options)
        state = open_state(folder, facts) if resume else None
        summary = RunSummary(model, sequence, options.recording.score, temporal=options.temporal)
        if state is not None and state.files is not None:
            summary.restore(state.summary)
            resumed(state.frames)
        else:
            folder.remove_written()
            state = RunState(facts, 0, RunnerState(), None, summary.state())
            save_state(folder.state_path, state)
        folder.add(out / SUMMARY)
        files = RunFiles(
            folder, sequence, model, options.recording, options.save_bev, live, track=options.track, resume=state.files
        )
        try:
            _run_from(state, model, sequence, options, folder, files, summary, after_frame, should_stop)
        except BaseException:
            with contextlib.suppress(OutputError):  # the first error is the one to report
                _write_summary(summary, files, out)
            raise
        _write_summary(summary, files, out)
    return summary


def _write_summary(summary: RunSummary, files: RunFiles, out: Path) -> None:
    summary.files = files.written()
    summary.write(out)


def _run_from(
    state: RunState,
    model: Model,
    sequence: Sequence,
    options: RunOptions,
    folder: RunFolder,
    files: RunFiles,
    summary: RunSummary,
    after_frame: Callable[[Frame, Prediction], None],
    should_stop: Callable[[], bool],
) -> None:
    """Runs the frames after a state, writes them, and saves the state."""
    recording = options.recording
    asks = recording.shows_internals
    asked = StepOptions(model.precision, options.temporal, ask_attention=asks, probes=tuple(recording.probes))
    saver = StateSaver(folder.state_path)
    count, runner, is_whole = state.frames, state.runner, True

    def save() -> None:
        parts = files.state()
        if parts is not None:
            done = count == len(sequence.stamps)  # nothing comes after the last frame
            saver.save(RunState(state.facts, count, RunnerState() if done else runner, parts, summary.state()))

    def write(step: tuple[Frame, Prediction, RunnerState]) -> float:
        """The seconds that writing the frame took."""
        nonlocal is_whole
        is_whole, writing_began = False, time.perf_counter()
        files.write(*step[:2])
        return time.perf_counter() - writing_began

    with files:
        try:
            began = time.perf_counter()
            steps = _steps(model, sequence, asked, options.cameras, track=options.track, start=count, state=runner)
            for (frame, prediction, after), recording_s in write_behind(write, steps):
                now = time.perf_counter()
                summary.add(frame, prediction, recording_s=recording_s, whole_s=now - began)
                count, runner, is_whole, began = count + 1, after, True, now
                if saver.is_due(runner):
                    save()
                after_frame(frame, prediction)
                if should_stop():
                    break
        finally:
            if is_whole and count not in (state.frames, saver.saved_frames):
                save()
