"""The temporal run: frame by frame, with the memory of the model, the tracks of the boxes and the driver's commands."""

import contextlib
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from bevcli.errors import InputError
from bevcli.frame import BevMap, Drive, Frame, FrameResult, FrameStamp, NewStart, Prediction, StartReason
from bevcli.geometry.boxes import Boxes3D
from bevcli.inference import StepOptions
from bevcli.inference.attention import AttentionProbe, attention_view, probe_cells
from bevcli.inference.box_memory import BoxMemory, remember
from bevcli.inference.pipeline import StageClock, image_uploader, origin, read_ahead, read_back
from bevcli.inference.preprocess import Preprocessor, camera_boxes
from bevcli.inference.tracking import TrackerConfig, TrackerState, track, without_identities
from bevcli.model.config import ImageConfig, ModelConfig
from bevcli.model.network import Network
from bevcli.model.road_slopes import FollowedPoints
from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.temporal_model import TemporalModel
from bevcli.parsing.documents import read_json

Memory = TypeVar("Memory")
# Commands of the driver, such as "straight": each chooses one of the paths that a model plans. Index of a frame and the
# command from it on, by rising index, until the next one.
Commands = tuple[tuple[int, str], ...]
AHEAD_BYTES = 1 << 29  # of network inputs that are prepared ahead of a GPU
MOST_THREADS = 4  # that prepare frames for a GPU


@dataclass(frozen=True)
class RunnerState(Generic[Memory]):
    """The state of a run between two frames.

    Attributes:
        memory: of the model, None for nothing; the runner only passes it on.
        stamp: of the frame; None where the next frame starts anew.
        tracks: of the tracker; None before the first frame or without tracks.
        boxes: that are remembered; None before the first frame, and where the model remembers none.
    """

    memory: Memory | None = None
    stamp: FrameStamp | None = None
    tracks: TrackerState | None = None
    boxes: BoxMemory | None = None


@dataclass(frozen=True)
class BegunStep:
    """A step that the device may still be computing, see `Runner.begin`."""

    prepared: PreparedFrame  # the frame
    marks: list[tuple[str, Any]]  # of the clock, so far
    upcoming: Sequence[PreparedFrame]  # the frames after it that the model sees
    start: RunnerState[Any]  # the state before the frame, without history where it starts anew
    started_anew: NewStart | None  # the reason for it, None where it does not
    after: RunnerState[Any]  # the state after the frame where its numbers are finite, without tracks and boxes
    # waits for the outputs, see `read_back`; None for a frame without images
    read: Callable[[], tuple[ModelOutputs, bool]] | None = None
    probe: AttentionProbe | None = None  # of the attention, where it was asked for


class Runner:
    """Runs a model on a device, step by step. The state is an argument and a result; the runner keeps none.

    Attributes:
        tracker: gives boxes their identities, where no model with history gives its own; None for no identities.
        commands: of the driver, for a model that plans.
        preprocess: makes the network's input of a frame.
        prepare: does so and puts its images on the device.
    """

    def __init__(
        self,
        model: TemporalModel,
        device: torch.device,
        options: StepOptions | None = None,
        *,
        tracker: TrackerConfig | None = None,
        pixels: bool = False,
        untrained: bool = False,
    ) -> None:
        """To make in the thread that runs the model.

        Args:
            model: ready for inference.
            device: where it runs.
            options: of all steps.
            tracker: used if the options ask for tracks.
            pixels: the model is an exported file, see `PreparedFrame.pixels`.
            untrained: the weights are random, which `Prediction.plot` says.

        Raises InputError for a probe outside the BEV grid, and for an unknown camera or command.
        """
        self.model = model.to(device).eval()
        self.config = model.config
        self.device = device
        self.options = options = StepOptions() if options is None else options
        self.tracker = tracker if options.track else None
        self.commands = read_commands(options.command, self.config)
        self.clock = StageClock(model, device, model.stages)
        self.preprocess = Preprocessor(self.config, options.cameras, pixels=pixels)
        self.prepare: Callable[[Frame], PreparedFrame] = self.preprocess
        if device.type == "cuda":
            upload_images = image_uploader(device)
            self.prepare = lambda frame: upload_images(self.preprocess(frame))
        self._untrained = untrained
        # The boxes have the identities of the model's own tracks.
        self._tracks = self.tracker is not None and options.temporal and self.config.has_tracks
        self._probed: Tensor | None = None
        if (options.attention or options.probes) and isinstance(model, Network):
            self._probed = probe_cells(options.probes, self.config.bev_grid).to(device)

    @property
    def overlap(self) -> int:
        """1 where `run` launches the next frame before it waits for a frame: a CUDA GPU computes while the CPU decodes.

        0 on other devices, and where this gains nothing, because more is read of the device than the outputs.
        """
        reads_more = self.options.attention or self.options.probes or self.model.waits_within_step
        return int(self.device.type == "cuda" and not reads_more)

    def step(
        self, state: RunnerState[Any] | None, prepared: PreparedFrame, upcoming: Sequence[PreparedFrame] = ()
    ) -> tuple[RunnerState[Any], Prediction]:
        """The state and the prediction after one frame.

        A frame without any image returns the state unchanged, so that the next alignment by ego-motion spans both
        frames. Where the model's numbers stop being finite, the prediction has no boxes and names the place, and the
        next frame starts anew.

        Args:
            state: the result of the step before; None at the start.
            prepared: the frame, preprocessed.
            upcoming: the frames after it, for a model that looks ahead. Those after the end of the scene, after a gap
                or without images are not used.
        """
        state = state or RunnerState()
        return self.finish(self.begin(state, prepared, upcoming), state)

    def begin(
        self, state: RunnerState[Any], prepared: PreparedFrame, upcoming: Sequence[PreparedFrame] = ()
    ) -> BegunStep:
        """Launches a step, most of which a GPU computes later. Arguments: see `step`; tracks and boxes are not used."""
        frame = prepared.frame
        started_anew = self._new_start(state.stamp, frame.stamp)
        if started_anew:
            state = self._restarted(state)
        if not frame.images:
            return BegunStep(prepared, self.clock.marks, (), state, started_anew, state)
        probe = None
        if self._probed is not None:
            probe = AttentionProbe(self.model, self.config.encoder.layers - 1, self._probed)
        later = self._usable(prepared, upcoming)
        autocast = torch.autocast(self.device.type, enabled=False)  # the parts of a model have precisions of their own
        with torch.inference_mode(), autocast, self.clock, probe or contextlib.nullcontext():
            outputs, memory = self.model.step(prepared, state.memory, later)
            read = read_back(outputs, prepared.images)
        after = RunnerState(memory, frame.stamp)
        return BegunStep(prepared, self.clock.marks, later, state, started_anew, after, read, probe)

    def finish(self, begun: BegunStep, before: RunnerState[Any]) -> tuple[RunnerState[Any], Prediction]:
        """Waits for a step; returns what `step` does. before: the state whose tracks and boxes are those before it."""
        prepared, start, probe = begun.prepared, begun.start, begun.probe
        if begun.read is None:
            prediction = self._prediction(prepared, begun.started_anew, skipped=True)
            return replace(start, tracks=before.tracks, boxes=before.boxes), prediction
        with torch.inference_mode():
            last_layers, is_finite = begun.read()
            if is_finite:
                after, fields = begun.after, self._decoded(last_layers, begun)
                fields["bev"] = last_layers.bev[0] if last_layers.bev.shape[1] else None
                if last_layers.image_boxes is not None:
                    fields["image_boxes"] = camera_boxes(last_layers.image_boxes, prepared, self.config.image)
                fields["attention"] = None if probe is None else attention_view(probe, prepared, self.config)
                fields["stage_seconds"] = self.clock.read()
            else:
                with torch.autocast(self.device.type, enabled=False), probe or contextlib.nullcontext():
                    part = origin(self.model, lambda: self.model.step(prepared, start.memory, begun.upcoming))
                after, fields = self._restarted(start), {"not_finite": part}
        prediction = self._prediction(prepared, begun.started_anew, **fields)
        tracks, boxes, decoder = before.tracks, None, self.config.decoder
        if decoder.remember_s and self.options.temporal and not prediction.not_finite:
            known = None if begun.started_anew else before.boxes
            boxes, prediction = remember(known, prepared.frame, prediction, decoder)
        if not self.options.unseen and len(prediction.boxes):
            world = prediction.boxes_world
            unseen = ~prepared.frame.sees(world)
            prediction = replace(prediction, boxes=replace(prediction.boxes, unseen=unseen))
            vars(prediction)["boxes_world"] = replace(world, unseen=unseen)  # the cached property
        if self.tracker is not None and not self._tracks:
            tracks, prediction = track(self.tracker, tracks, prediction)
        return replace(after, tracks=tracks, boxes=boxes), prediction

    def _decoded(self, last_layers: ModelOutputs, begun: BegunStep) -> dict[str, Any]:
        """The fields of a prediction that are decoded from the outputs of the last layers, on the CPU."""
        self.clock.waited(begun.marks)
        boxes, segmentation, results = Boxes3D.empty(), None, []
        for decoded in self.model.decode(last_layers):
            if isinstance(decoded, Boxes3D):
                boxes = without_identities(decoded) if self.config.has_tracks and not self._tracks else decoded
                self.clock.mark("box_decoding")
            elif isinstance(decoded, BevMap):
                segmentation = decoded
                self.clock.mark("map_merging")
            else:
                results.append(decoded)
        shown = with_command(tuple(results), self.commands, begun.prepared.frame.stamp.index)
        return {"boxes": boxes, "results": shown, "segmentation": segmentation}

    def frames(self, drive: Drive, indices: Sequence[int]) -> Iterator[tuple[PreparedFrame, tuple[PreparedFrame, ...]]]:
        """Yields `prepared` and `upcoming` of `step` for these frames of a drive, read and prepared in advance.

        A model that looks ahead sees the later ones of these frames.
        """
        ahead = self.config.later_frames if self.options.temporal else 0
        depth, threads = 2, 1
        if self.device.type == "cuda":
            depth, threads = frames_ahead(self.config.image, len(drive.rig.cameras), os.cpu_count() or 1)
            source = read_ahead(self.prepare, indices, depth, threads, load=drive.load)
        else:  # the processor is busy with the model: one thread for both keeps up
            source = read_ahead(lambda index: self.prepare(drive.load(index)), indices)
        if self.config.levels and self.options.temporal:
            source = read_ahead(with_points, pairwise(chain((None,), source)), depth, threads)
        waiting = deque(islice(source, ahead + 1))
        while waiting:
            prepared = waiting.popleft()
            yield prepared, tuple(waiting)
            waiting.extend(islice(source, 1))

    def run(
        self, drive: Drive, indices: Sequence[int] | None = None, state: RunnerState[Any] | None = None
    ) -> Iterator[tuple[Frame, Prediction, RunnerState[Any]]]:
        """Yields frame, prediction and state after each of these frames of a drive; None: all of them.

        The next frame may be launched before a frame is finished, see `overlap`; its errors are raised afterwards.
        """
        indices = range(len(drive.stamps)) if indices is None else indices
        state, frames = state or RunnerState(), self.frames(drive, indices)
        if self.overlap:
            yield from self._overlapped(frames, state)
            return
        for prepared, upcoming in frames:
            state, prediction = self.finish(self.begin(state, prepared, upcoming), state)
            yield prepared.frame, prediction, state

    def _overlapped(
        self, frames: Iterator[tuple[PreparedFrame, tuple[PreparedFrame, ...]]], state: RunnerState[Any]
    ) -> Iterator[tuple[Frame, Prediction, RunnerState[Any]]]:
        """As `run`. Each frame but the first is launched before the frame before it is finished."""
        begun: BegunStep | None = None
        is_last = False
        while not is_last:
            following, error = None, None
            try:
                if (frame := next(frames, None)) is not None:
                    following = self.begin(begun.after if begun else state, *frame)
            except Exception as raised:  # after the frame before it
                error = raised
            if begun is not None:
                state, prediction = self.finish(begun, state)
                yield begun.prepared.frame, prediction, state
                if following is not None and prediction.not_finite:  # it was begun with a history that is not finite
                    following = self.begin(state, following.prepared, following.upcoming)
            if error is not None:
                raise error
            begun, is_last = following, following is None

    def _restarted(self, state: RunnerState[Any]) -> RunnerState[Any]:
        """The state before a frame without history: what the model keeps over scenes, and the tracks."""
        is_kept = self.options.temporal and state.memory is not None
        return replace(state, memory=self.model.restarted(state.memory) if is_kept else None, stamp=None)

    def _new_start(self, before: FrameStamp | None, stamp: FrameStamp) -> NewStart | None:
        if not self.options.temporal:
            return NewStart(StartReason.HISTORY_OFF)
        if not self.config.uses_history:
            return NewStart(StartReason.NO_HISTORY)
        if before is None:
            return NewStart(StartReason.FIRST_FRAME)
        if stamp.scene != before.scene:
            return NewStart(StartReason.NEW_SCENE)
        seconds = (stamp.timestamp_ns - before.timestamp_ns) / 1e9
        return None if 0 < seconds <= self.config.max_gap_s else NewStart(StartReason.GAP, seconds)

    def _usable(self, prepared: PreparedFrame, upcoming: Sequence[PreparedFrame]) -> list[PreparedFrame]:
        """The upcoming frames with images that continue the frame's scene without a gap."""
        usable: list[PreparedFrame] = []
        stamp = prepared.frame.stamp
        for later in upcoming[: self.config.later_frames]:
            if not later.frame.images:
                continue
            if self._new_start(stamp, later.frame.stamp):
                break
            usable.append(later)
            stamp = later.frame.stamp
        return usable

    def _prediction(self, prepared: PreparedFrame, started_anew: NewStart | None, **fields: Any) -> Prediction:
        """The prediction for a frame. fields: those that the model computed; by default it has no boxes."""
        frame, assignment = prepared.frame, prepared.assignment
        return Prediction(
            stamp=frame.stamp,
            ego_from_bev=frame.rig.ego_from_bev,
            world_from_ego=frame.world_from_ego,
            grid=self.config.bev_grid,
            started_anew=started_anew,
            camera_embeddings=dict(zip(assignment.cameras, assignment.embeddings, strict=True)),
            object_classes=self.config.object_classes,
            frame=frame,
            untrained=self._untrained,
            **{"boxes": Boxes3D.empty(), "bev": None, **fields},
        )


def with_points(frames: tuple[PreparedFrame | None, PreparedFrame]) -> PreparedFrame:
    """The second of two frames, with the points that were followed from the first one."""
    before, prepared = frames
    if before is None or before.grey is None or prepared.grey is None:
        return prepared
    poses = before.frame.world_from_ego, prepared.frame.world_from_ego
    return replace(prepared, points=FollowedPoints.follow(before.grey, poses[0], prepared.grey, poses[1]))


def frames_ahead(image: ImageConfig, cameras: int, cores: int) -> tuple[int, int]:
    """How many frames are prepared ahead of a GPU, and in how many threads.

    Each of the frames holds its network input; together these take at most AHEAD_BYTES, but are never less than two.
    Where points are followed in them, as many are ahead once more.
    A quarter of the cores prepares images; the others decode images, or record.
    """
    width, height = image.padded_size
    affordable = AHEAD_BYTES // (cameras * 3 * width * height * 4)
    threads = max(1, min(MOST_THREADS, cores // 4))
    return max(2, min(threads + 2, affordable)), threads


def with_command(results: tuple[FrameResult, ...], commands: Commands, frame: int) -> tuple[FrameResult, ...]:
    """The results, plans with the command at a frame, "" for none."""
    command = next((command for first, command in reversed(commands) if first <= frame), "")
    return tuple(result.with_command(command) for result in results)


def read_commands(command: str | None, config: ModelConfig) -> Commands:
    """The commands of the option `command`: one name, or a JSON file {"0": "straight", "40": "left"} by frame index.

    None: no command. Raises InputError for a model that does not plan, an unknown command, or a wrong file.
    """
    if command is None:
        return ()
    path = Path(command)
    if path.suffix != ".json":
        return one_command(command, config)
    names = _known(command, config)
    commands = read_json(path)
    if not isinstance(commands, dict) or not commands:
        raise InputError(f'{path}: is not a file of commands (expected {{"0": "{names[0]}"}}, by frame index)')
    for frame, name in commands.items():
        if not (frame.isascii() and frame.isdigit() and len(frame) < 10) or name not in names:
            expected = f"expected {', '.join(names)}, by frame index"
            raise InputError(f'{path}: "{frame}": {name!r:.40}: is no command ({expected})')
    return tuple(sorted((int(frame), name) for frame, name in commands.items()))


def one_command(command: str, config: ModelConfig) -> Commands:
    """A command by its name, for all frames. Raises InputError for a model that does not plan, or another name."""
    names = _known(command, config)
    if command not in names:
        raise InputError(f"`command={command}` (`--command`): is unknown (expected {', '.join(names)} or a FILE.json)")
    return ((0, command),)


def _known(command: str, config: ModelConfig) -> tuple[str, ...]:
    commands = next((names for kind, names in config.results.items() if kind.takes_command), ())
    if not commands:
        raise InputError(f"`command={command}` (`--command`): {config.name} plans no path: leave out the option")
    return commands
