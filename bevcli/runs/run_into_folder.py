"""`run_into_folder`: run a model over a drive and write files, as `bevcli run` does; `run_in_folder`, step by step."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bevcli.errors import BevcliError, OutputError
from bevcli.frame import Drive, Frame, Prediction
from bevcli.inference.load import Model
from bevcli.inference.pipeline import write_behind
from bevcli.model.temporal_model import model_class
from bevcli.recording.writer import LiveSink
from bevcli.rig.sequence_checks import input_errors
from bevcli.runs import RunOptions
from bevcli.runs.files import RunFiles
from bevcli.runs.state import START_ANEW, RunFolder, RunState, run_fingerprint, save_state, saved_state
from bevcli.runs.summary import SUMMARY, Counts, RunSummary
from bevcli.sequences.images import no_image_error


@dataclass(frozen=True)
class FolderRun:
    """A run into a folder.

    Attributes:
        frames: each frame with its prediction, once it is in the files.
        done: number of frames that an interrupted run had finished.
        summary: counts and times so far.
    """

    frames: Iterator[tuple[Frame, Prediction]]
    done: int
    summary: RunSummary


def run_into_folder(
    model: Model,
    sequence: Drive,
    out: Path,
    options: RunOptions | None = None,
    *,
    live: LiveSink | None = None,
    force: bool = False,
    resume: bool = False,
) -> RunSummary:
    """Run a model over a sequence and write recording, boxes, tracks, maps and summary.json into a folder.

    Whatever ends the run: the files hold all finished frames, summary.json is written, and the state is saved, so that
    `resume` can go on. Bad input before the first frame with images leaves no files. The files of a killed process hold
    all finished frames too, predictions.json as predictions.json.partial; it goes on from the last saved state.

    Args:
        model: of `load_model`.
        sequence: of `open_sequence`.
        out: the output folder, made where it is missing. No other run can use it meanwhile.
        options: default `RunOptions()`.
        live: a viewer that shows the recording while it is written.
        force: remove the files that earlier runs wrote into `out`.
        resume: go on with an interrupted run of the same model, options and input; the results then equal those of a
            run without interruption. Where there is none, the run starts at the first frame.

    Raises:
        InputError: see `run`; or not one image of the drive could be read.
        OutputError: the folder holds something already, is in use by another run, cannot be written or was deleted; or
            the run to resume was another one.
    """
    options = RunOptions() if options is None else options
    model = model.in_engine(sequence.rig, sequence, parts="`probes` (`--probe`)" if options.recording.probes else "")
    with run_in_folder(model, sequence, out, options, live=live, force=force, resume=resume) as run:
        for _ in run.frames:
            pass
    return run.summary


@contextlib.contextmanager
def run_in_folder(
    model: Model,
    drive: Drive,
    out: Path,
    options: RunOptions,
    *,
    live: LiveSink | None = None,
    force: bool = False,
    resume: bool = False,
    source: str = "SEQUENCE",
) -> Iterator[FolderRun]:
    """A run of `run_into_folder` that the caller steps:

        with run_in_folder(model, drive, out, options) as run:
            for frame, prediction in run.frames:
                ...  # `break` stops the run: it can be resumed

    model: in its engine. source: the path of the drive, for texts. Other arguments and errors: see `run_into_folder`.
    """
    if force and resume:
        raise OutputError("`force` (`--force`) and `resume` (`--resume`) exclude each other: pass one of them")
    shown = options.recording
    runner = model.runner(replace(options, attention=shown.shows_internals, probes=tuple(shown.probes)))
    with RunFolder(out, force=force, resume=resume) as folder:
        fingerprint = run_fingerprint(model, drive, options) | {"commands": str(runner.commands)}
        state = _state_to_start_from(folder, fingerprint, model, resume)
        done, summary = state.counts.whole.count, RunSummary(model, drive, options, state.counts)
        summary.input_errors = input_errors(drive, source)
        folder.add(out / SUMMARY)
        files = RunFiles(folder, drive, model, options, summary, state, live)
        try:
            with files:
                steps = runner.run(drive, range(done, len(drive.stamps)), state.runner)
                if options.score_without_labels:
                    from bevcli.workshop.trust.estimate import witnessed

                    steps = witnessed(steps, drive)
                with contextlib.closing(write_behind(steps, files.write)) as frames:
                    yield FolderRun(frames, done if state.files else 0, summary)
            if summary.is_complete and len(summary.counts.skipped) == summary.frames:
                raise no_image_error(drive.name, (image[1:] for image in summary.counts.dropped))
        except BaseException as error:
            with contextlib.suppress(OutputError):  # the first error is the one to report
                _close(folder, summary, files, error)
            if isinstance(error, Exception) and not isinstance(error, BevcliError) and 0 < done == summary.frames:
                reason = f"{type(error).__name__}: {' '.join(str(error).split()):.200}"
                message = f"{out}: `resume` (`--resume`): the run cannot go on from its state ({reason}); {START_ANEW}"
                raise OutputError(message) from error
            raise
        summary.write(out, files.written())


def _close(folder: RunFolder, summary: RunSummary, files: RunFiles, error: BaseException) -> None:
    """Writes the summary of a run that an error ended; or removes a run without frames that bad input ended.

    So that it does not stand in the way of the corrected run.
    """
    is_mistake = isinstance(error, BevcliError) and not isinstance(error, OutputError)
    if is_mistake and summary.frames == len(summary.counts.skipped):
        folder.discard()
    else:
        summary.write(folder.path, files.written())


def _state_to_start_from(folder: RunFolder, fingerprint: dict[str, str], model: Model, resume: bool) -> RunState[Any]:
    """The saved state of an interrupted run, or a new one without files; then those of earlier runs are removed."""
    memory = model_class(model.config).memory_type
    state = saved_state(folder, fingerprint, RunState[memory]) if resume else None  # type: ignore[valid-type]
    if resume and state is None and folder.has_files():
        raise OutputError(f"{folder.path}: `resume` (`--resume`): its run saved no state; {START_ANEW}")
    if state is None or state.files is None:
        folder.remove_written()
        state = RunState(fingerprint, None, Counts())
        save_state(folder.state_path, state)
    return state
