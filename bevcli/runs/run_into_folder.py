"""`run_into_folder`: run a model over a drive and write files, as `bevcli run` does; `run_in_folder`, step by step."""

import contextlib
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from bevcli.config import as_table
from bevcli.errors import BevcliError, OutputError
from bevcli.frame import Drive, Frame, FrameResult, Prediction, result_of
from bevcli.geometry.boxes import attributes_by_speed
from bevcli.geometry.transforms import Pose
from bevcli.inference.load import Model
from bevcli.inference.pipeline import write_behind
from bevcli.inference.runner import RunnerState
from bevcli.model.temporal_model import model_class
from bevcli.model.upload import tensors_in
from bevcli.recording.writer import LiveSink, Recording
from bevcli.rig.sequence_checks import input_errors
from bevcli.runs import RunOptions
from bevcli.runs.state import START_ANEW, FilesState, RunFolder, RunState, run_fingerprint, save_state, saved_state
from bevcli.runs.summary import SUMMARY, Counts, RunSummary
from bevcli.sequences.files.boxes_file import BoxesWriter, FrameBoxes
from bevcli.sequences.files.boxes_table import CsvWriter, ImageBoxesWriter
from bevcli.sequences.files.calibration_file import CALIBRATION, write_calibration
from bevcli.sequences.files.incremental_json import GrowingFile
from bevcli.sequences.files.json_fields import pose_to_json
from bevcli.sequences.files.map_folder import map_path, write_map
from bevcli.sequences.images import no_image_error
from bevcli.writing import partial_path, whole_file, write_whole

if TYPE_CHECKING:
    from bevcli.workshop.formats.nuscenes_output import SubmissionWriter


RECORDING, PREDICTIONS, SUBMISSION = "recording.rrd", "predictions.json", "results_nusc.json"
TRACKS, IMAGE_BOXES, SEGMENTATION = "tracks.csv", "image_boxes.csv", "segmentation"
SHARE = 0.02  # of the run's time that saving may take
ASSUMED_BYTES_PER_S, ASSUMED_S = 3e8, 0.002  # how long it takes
Growing = TypeVar("Growing", bound=GrowingFile)


class RunFiles:
    """`with RunFiles(…) as files: files.write(step)`: recording, boxes, tracks, maps, BEV features, further results.

    A frame that is written is counted, and the state is saved as often as SHARE of the run's time allows. The end of
    the block, whatever causes it, saves the state after the last whole frame. predictions.json states at every moment
    which frames the other files hold too: it gets a frame last, and is removed or cut first.
    """

    def __init__(
        self,
        folder: RunFolder,
        drive: Drive,
        model: Model,
        options: RunOptions,
        summary: RunSummary,
        state: RunState[Any],
        live: LiveSink | None = None,
    ) -> None:
        """state: from which the files go on. Raises OutputError where files of an interrupted run were changed."""
        self._folder, self._out, self._resume, self._fingerprint = folder, folder.path, state.files, state.fingerprint
        self._drive, self._model, self._options, self._live = drive, model, options, live
        self._summary = summary
        self._began = self._frame_began = time.perf_counter()
        self._saving_s = 0.0
        self._after: RunnerState[Any] | None = None  # the state after a whole frame that is not saved yet
        self._stack = contextlib.ExitStack()
        self._files: dict[str, GrowingFile] = {}  # those that are open, beside the recording
        self._submission: SubmissionWriter | None = None  # of nuScenes drives
        self._tracks: CsvWriter | None = None
        self._image_boxes: ImageBoxesWriter | None = None  # of models with a detector, or of the witness
        self._reference = "world" if drive.has_ego_motion else "ego"
        self._results: dict[type[FrameResult], Any] = {}  # type of results -> what its `writer` made
        self._map_frames = list(state.files.map_frames) if state.files else []
        self._bev_frames = list(state.files.bev_frames) if state.files else []
        if state.files is not None:
            self._check_files(state.files)

    def __enter__(self) -> "RunFiles":
        out, drive, model, resume = self._out, self._drive, self._model, self._resume
        for name in (PREDICTIONS, RECORDING, *((TRACKS,) if self._options.track else ())):
            self._folder.add(out / name)
        past = None if resume is None else resume.recording
        recording = Recording(out / RECORDING, drive, model, self._options.recording, self._live, past)
        config, grid = model.config, model.config.bev_grid
        settings = as_table(config)["class_settings"]  # of classes of the model's own
        extras = {
            "model": model.name,
            "untrained": model.untrained,
            "classes": list(config.classes),
            **({"class_settings": settings} if settings else {}),
            "range_m": grid.nearest_side_m,
            **({"ego_motion": "measured"} if drive.facts.motion_measured else {}),
            **({"x_range_m": list(grid.x_range_m), "y_range_m": list(grid.y_range_m)} if config.results else {}),
        }
        with self._stack:  # closes what is open if the next one cannot be opened
            self._boxes = self._open(PREDICTIONS, BoxesWriter, frame_of_reference=self._reference, extras=extras)
            self._recording = self._stack.enter_context(recording)
            if self._options.track:
                self._tracks = self._open(TRACKS, CsvWriter)
            if config.image_classes or self._options.score_without_labels:
                self._image_boxes = self._open(IMAGE_BOXES, ImageBoxesWriter)
            for result, names in config.results.items():
                about = {"frame_of_reference": self._reference, "extras": {**extras, "classes": list(names)}}
                self._results[result] = self._open(result.file_name, result.writer, **about)
            if resume is not None and SUBMISSION in resume.sizes:
                self._submission = self._open_submission()
            if len({stamp.scene for stamp in drive.stamps}) == 1:  # scenes may have rigs of their own
                self._folder.add(out / CALIBRATION)
                write_calibration(out / CALIBRATION, drive.rig, drive.facts, regular=True)
            for note in drive.notes if resume is None else ():
                self._recording.event(note, "WARN")
            self._stack = self._stack.pop_all()
        return self

    def __exit__(self, *raised: Any) -> None:
        try:
            if self._after is not None:
                self._save(self._after)
        finally:
            self._stack.__exit__(*raised)

    def write(self, step: tuple[Frame, Prediction, RunnerState[Any]]) -> tuple[Frame, Prediction]:
        """Add a frame to every file, and count it. step: of `Runner.run`."""
        frame, prediction, after = step
        self._after, began = None, time.perf_counter()
        self._write(frame, prediction)
        now = time.perf_counter()
        self._summary.add(frame, prediction, recording_s=now - began, whole_s=now - self._frame_began)
        self._after, self._frame_began = after, now
        saving_s = ASSUMED_S + sum(tensor.nbytes for _, tensor in tensors_in(after)) / ASSUMED_BYTES_PER_S
        if self._saving_s + saving_s <= SHARE * (now - self._began):
            self._save(after)
        return frame, prediction

    def _save(self, after: RunnerState[Any]) -> None:
        """Save the state after the last frame, if the files can go on from there. Raises OutputError."""
        recording, began = self._recording.state(), time.perf_counter()
        if recording is None:
            return
        sizes = {name: file.size for name, file in self._files.items()}
        files = FilesState(recording, sizes, self._map_frames, self._bev_frames)
        kept = RunnerState() if self._summary.is_complete else after  # nothing comes after the last frame
        save_state(self._folder.state_path, RunState(self._fingerprint, files, self._summary.counts, kept))
        self._after = None
        self._saving_s += time.perf_counter() - began

    def _write(self, frame: Frame, prediction: Prediction) -> None:
        if prediction.segmentation is not None:
            maps = self._out / SEGMENTATION
            self._folder.add(map_path(maps, frame.stamp.index))
            write_map(maps, frame.stamp.index, prediction.segmentation)
            self._map_frames.append(frame.stamp.index)
        if self._options.save_bev is not None and prediction.bev is not None:
            _save_bev(self._options.save_bev, prediction, self._model)
            self._bev_frames.append(frame.stamp.index)
        self._recording.log(frame, prediction)
        extras: dict[str, object] = {"skipped": True} if prediction.skipped else {}
        if prediction.not_finite:
            extras["not_finite"] = prediction.not_finite
        if prediction.results:
            extras["ego_from_bev"] = pose_to_json(Pose.from_matrix(prediction.ego_from_bev))
        if frame.sample_token is not None:
            extras["sample_token"] = frame.sample_token
        in_world = self._drive.has_ego_motion  # boxes are in the world frame, or else in the ego frame
        boxes = prediction.boxes_world if in_world else prediction.boxes_ego
        boxes = replace(boxes, attributes=attributes_by_speed(boxes, self._model.config.object_classes))
        of_frame = FrameBoxes(frame.stamp, frame.world_from_ego if in_world else None, boxes, extras)
        if self._tracks is not None:
            instances = boxes.instances
            tracked = of_frame if instances is None else replace(of_frame, boxes=boxes[instances != ""])
            self._tracks.write(tracked, self._reference)
        if self._image_boxes is not None:
            self._image_boxes.write(frame.stamp, prediction.image_boxes or {})
        if frame.sample_token is not None:
            self._submission = self._submission or self._open_submission()
            self._submission.write(of_frame)
        ground = prediction.ground if in_world else replace(prediction.ground, world_from_ego=None)
        for result, writer in self._results.items():
            writer.write(ground, result_of(result, prediction.results))
        self._boxes.write(of_frame)  # last
        if any(file.is_deleted() for file in (self._recording.file, *self._files.values())):
            raise OutputError(f"{self._out}: the files of this run were deleted while it was writing them")

    def _check_files(self, resume: FilesState) -> None:
        """Raises OutputError where a file of the finished frames is missing, or shorter than it was."""
        for name, size in {RECORDING: resume.recording.size, **resume.sizes}.items():
            unfinished = partial_path(self._out / name)
            _check_size(unfinished if unfinished.exists() else self._out / name, size)
        for index in resume.map_frames:
            _check_size(map_path(self._out / SEGMENTATION, index), 1)
        for index in resume.bev_frames:
            assert self._options.save_bev is not None
            for ending in ("npy", "json"):
                _check_size(self._options.save_bev / f"{index:06d}.{ending}", 1)

    def _open(self, name: str, writer: type[Growing], **how: Any) -> Growing:
        """Open a file that grows; of a resumed run, where it ended. writer: takes its path, `resume_at` and `how`."""
        self._folder.add(self._out / name)
        resume_at = None if self._resume is None else self._resume.sizes.get(name)
        file = writer(self._out / name, resume_at=resume_at, **how)
        self._files[name] = self._stack.enter_context(file)
        return file

    def _open_submission(self) -> "SubmissionWriter":
        from bevcli.workshop.formats.nuscenes_output import SubmissionWriter  # nuScenes drives only

        return self._open(SUBMISSION, SubmissionWriter)

    def written(self) -> tuple[Path, ...]:
        """The files and folders that exist so far."""
        tables = (TRACKS, IMAGE_BOXES, SUBMISSION, SEGMENTATION, CALIBRATION)
        paths = [self._out / name for name in (RECORDING, PREDICTIONS, *tables)]
        paths += [self._out / result.file_name for result in self._results]
        return tuple(path for path in (*paths, self._options.save_bev) if path is not None and path.exists())


def _check_size(path: Path, size: int) -> None:
    size_now = path.stat().st_size if path.is_file() else 0
    if size_now < size:
        raise OutputError(
            f"{path}: `resume` (`--resume`): was cut or removed since the interruption (expected {size} bytes or more, "
            f"found {size_now}): pass `force=True` (`--force`) to start anew"
        )


def _save_bev(folder: Path, prediction: Prediction, model: Model) -> None:
    """Write a frame's BEV features: NNNNNN.npy, (rows, columns, C) float16, and NNNNNN.json, which describes it.

    Rows run from the smallest y, columns from the smallest x, both in the bev frame.

    folder: made if missing. Raises OutputError.
    """
    assert prediction.bev is not None
    grid = prediction.grid
    features = prediction.bev.float().cpu().numpy().reshape(grid.rows, grid.columns, -1).astype(np.float16)
    facts = {
        "format": "bevcli-bev/1",
        "frame": prediction.stamp.index,
        "scene": prediction.stamp.scene,
        "timestamp_ns": prediction.stamp.timestamp_ns,
        "shape": list(features.shape),
        "axes": "rows from the smallest y, columns from the smallest x, channels; bev frame",
        "x_range_m": list(grid.x_range_m),
        "y_range_m": list(grid.y_range_m),
        "ego_from_bev": pose_to_json(Pose.from_matrix(prediction.ego_from_bev)),
        "world_from_ego": pose_to_json(prediction.world_from_ego),
        "model": model.name,
        "untrained": model.untrained,
    }
    name = f"{prediction.stamp.index:06d}"
    with whole_file(folder / f"{name}.npy", parents=True, regular=True) as unfinished:
        np.save(unfinished, features)
    write_whole(folder / f"{name}.json", f"{json.dumps(facts, indent=1)}\n".encode(), regular=True)


@dataclass(frozen=True)
class FolderRun:
    """A run into a folder."""

    frames: Iterator[tuple[Frame, Prediction]]  # each frame with its prediction, once it is in the files
    done: int  # number of frames that an interrupted run had finished
    summary: RunSummary  # counts and times so far


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

                    steps = ((frame, witnessed(frame, one, drive), after) for frame, one, after in steps)
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
