"""The loop over a sequence: `run` yields predictions."""

from collections.abc import Iterator, Mapping, Sequence as Items
from dataclasses import dataclass, replace

from bevcli.frame import Frame, Prediction, Sequence
from bevcli.inference.commands import read_commands
from bevcli.inference.in_engine import in_engine
from bevcli.inference.load import Model
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import BevState, Runner, StepOptions
from bevcli.inference.tracking import TrackerState, track as track_boxes, without_identities
from bevcli.model.step import PreparedFrame


@dataclass(frozen=True)
class RunnerState:
    """The state between two frames.

    Attributes:
        bev: of the model, None before the first frame.
        tracks: of the tracker, None before the first frame or without tracks.
    """

    bev: BevState | None = None
    tracks: TrackerState | None = None


class Steps:
    """From prepared frames to boxes with identities, step by step. The state is an argument and a result.

    Attributes:
        runner: steps the model.
        prepare: makes a frame the input of `step`; may be called in another thread.
    """

    def __init__(
        self, model: Model, options: StepOptions, cameras: Mapping[str, str] | None = None, *, track: bool = True
    ) -> None:
        """See `run` for the arguments."""
        self.runner = Runner(model.prepared, model.device, options)
        self.prepare = self.runner.preparation(Preprocessor(model.config, cameras))
        self._tracker, self._track = model.tracker, track

    def step(
        self, state: RunnerState, prepared: PreparedFrame, upcoming: Items[PreparedFrame] = ()
    ) -> tuple[RunnerState, Prediction]:
        """The state and the prediction after one frame. upcoming: see `Runner.step`."""
        bev, prediction = self.runner.step(state.bev, prepared, upcoming)
        tracks = state.tracks
        if not self._track:
            prediction = replace(prediction, boxes=without_identities(prediction.boxes))
        elif not self.runner.tracks:
            ((_, prediction, tracks),) = track_boxes(self._tracker, [(prepared.frame, prediction)], tracks)
        return RunnerState(bev, tracks), prediction


def run(
    model: Model,
    sequence: Sequence,
    *,
    temporal: bool = True,
    track: bool = True,
    attention: bool = False,
    probes: tuple[tuple[float, float], ...] = (),
    cameras: Mapping[str, str] | None = None,
    command: str | None = None,
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
        command: of the driver, which chooses one of the planned paths, such as "straight"; or a FILE.json.

    Raises:
        InputError: a frame cannot be read, a probe lies outside the BEV grid, a camera or a command is unknown, or the
            attention of an exported file is asked for.
    """
    model = in_engine(model, sequence.rig, sequence, parts="attention and probes" if attention or probes else "")
    asked = StepOptions(
        model.precision,
        temporal,
        ask_attention=attention or bool(probes),
        probes=tuple(probes),
        commands=read_commands(command, model.config),
    )
    steps = run_steps(model, sequence, asked, cameras, track=track)
    return ((frame, prediction) for frame, prediction, _ in steps)


def run_steps(
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
    steps = Steps(model, options, cameras, track=track)
    places = range(start, len(sequence.stamps))
    for prepared, upcoming in steps.runner.frames(sequence, places, steps.prepare):
        state, prediction = steps.step(state, prepared, upcoming)
        yield prepared.frame, prediction, state
