"""Recording: writes frames and predictions into an .rrd file, frame by frame."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import rerun as rr

from bevcli.errors import OutputError, WaitError
from bevcli.frame import DriveFacts, Frame, FrameStamp, Prediction
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.object_classes import hex_of_color
from bevcli.geometry.transforms import Array, Pose, apply, inverse, rigid
from bevcli.recording import entities, log_bev, log_boxes, log_cameras, log_static
from bevcli.recording.blueprint import LayoutFacts, recording_blueprint
from bevcli.recording.class_meshes import log_class_meshes, read_class_meshes
from bevcli.recording.colors import EGO_COLOR, Color, class_colors
from bevcli.recording.ground_lines import future_lines, result_lines
from bevcli.recording.layout import Layout
from bevcli.recording.log_bev import BevColors, BevImages
from bevcli.recording.log_cameras import PosedCamera, VideoImages
from bevcli.recording.log_ground import log_ground_lines
from bevcli.recording.log_tracks import TrackHistory, TrackLog
from bevcli.recording.options import RecordingOptions
from bevcli.recording.rrd_file import RrdFile
from bevcli.recording.vehicle import load_vehicle

if TYPE_CHECKING:
    from bevcli.model.config import ModelConfig

APPLICATION = "bevcli"
FLUSH_TIMEOUT_S = 20.0
INDEXED_FRAMES = 200  # a longer recording has no index, see `rrd_file`
UNTRAINED = "untrained weights"
FROM_RENDERED = "trained on renderings"
WARNINGS = {
    UNTRAINED: "The weights are UNTRAINED: boxes and maps are meaningless.",
    FROM_RENDERED: "The weights were trained on rendered streets; these images are not rendered.",
}
PosedCameras = tuple[PosedCamera, ...]


class RecordedModel(Protocol):
    """The facts about a model that go into a recording."""

    @property
    def config(self) -> ModelConfig:
        """The model's configuration; its name and its classes are written."""

    @property
    def untrained(self) -> bool:
        """True for random weights. Then titles, events and the page "About" say so."""

    @property
    def bundled(self) -> bool:
        """True for the weights of the package. Titles and events say so where the drive is not a rendered one."""


class RecordedDrive(Protocol):
    """The facts about a drive that go into a recording: those of a `Sequence`, or of a `Session`."""

    name: str
    rig: CameraRig
    has_ego_motion: bool
    facts: DriveFacts

    @property
    def stamps(self) -> tuple[FrameStamp, ...]:
        """The frames that are known in advance; their rate is written."""


class LiveSink(Protocol):
    """A viewer that follows a recording while it is written, such as `bevcli.viewer.web.LiveView`."""

    def open(self, recording: Path) -> None:
        """Called once, when the file is there."""

    def close(self) -> None:
        """Called once, when the file is whole."""


@dataclass(frozen=True)
class LastFrame:
    """The frame that was written last. `world_from_ego`: its pose in the sequence's world."""

    scene: str
    world_from_ego: Pose


@dataclass(frozen=True)
class RecordingState:
    """The state of a recording after a frame, from which a later one goes on.

    Attributes:
        recording_id: rerun's id of the recording.
        size: bytes of the file that are kept.
        origin: (3,) the recording's origin in the sequence's world, metres.
        last: the last frame.
        colors: of the BEV features, None where these are not drawn.
        tracks: the trails.
    """

    recording_id: str
    size: int
    origin: Array
    last: LastFrame | None
    colors: BevColors | None
    tracks: TrackHistory


class Recording:
    """Writes a recording: `with Recording(...) as recording: recording.log(frame, prediction)`, frames in order.

    Each frame is on the disk when `log` returns, so a killed run keeps all frames up to then.

    Args:
        path: the .rrd file to write; an existing one is replaced.
        sequence: the drive, or a `Session`; the rig and the name are taken from it.
        model: the class names, the name and whether it is trained are taken from it.
        options: how much is written; the defaults of RecordingOptions if None.
        live: a viewer that follows the recording; None for no viewer.
        resume: `state()` of the recording that was interrupted; the file is cut to its size and goes on from there.

    Raises OutputError when the file cannot be written, and InputError when a mesh cannot be read.
    """

    def __init__(
        self,
        path: str | Path,
        sequence: RecordedDrive,
        model: RecordedModel,
        options: RecordingOptions | None = None,
        live: LiveSink | None = None,
        resume: RecordingState | None = None,
    ) -> None:
        self.path, self.rig, self.untrained = Path(path), sequence.rig, model.untrained
        self.title = f"{sequence.name} · {model.config.name}"
        self.note = weights_note(model, sequence)
        self.classes = class_colors(model.config.object_classes.values())
        self._config, self._geo_origin = model.config, sequence.facts.geo_origin
        self._rate_hz, self._has_ego_motion = frame_rate_hz(sequence.stamps), sequence.has_ego_motion
        self.options = RecordingOptions() if options is None else options
        recording_id = str(uuid.uuid4()) if resume is None else resume.recording_id
        # rerun keeps two threads and some MB of every stream that nobody uses any more, until this call. It may wait
        # for a sink that hangs.
        threading.Thread(target=rr.bindings.flush_and_cleanup_orphaned_recordings, daemon=True).start()
        self._stream = rr.RecordingStream(APPLICATION, recording_id=recording_id)
        self._recording_id, self._resume = recording_id, resume
        self._file: RrdFile | None = None
        self._live = live
        self._origin: Array | None = None  # (3,) position of the first frame's ego vehicle in the world
        self._last: LastFrame | None = None
        self._frames = 0
        self._early_events: list[tuple[str, str]] = []  # logged before the first frame
        self._pillars: Array | None = None
        self._tracks = TrackLog(self._stream, self.classes)
        self._video = VideoImages(self._stream) if self.options.images == "av1" else None
        self._bev_images: BevImages[tuple[FrameStamp, Prediction]] | None = None
        if self.options.bev != "none" and self.options.shows_internals:
            self._bev_images = BevImages(self.options.bev)

    def __enter__(self) -> Recording:
        mesh, grid = self.options.vehicle_mesh, self._config.bev_grid
        vehicle = None if mesh is None else load_vehicle(mesh)
        meshes = read_class_meshes(self._config.object_classes)
        map_classes = self._config.map_classes if self.options.shows_internals else ()
        lines = log_static.line_entries(self._config)
        legend = log_static.legend_entries(self.classes, map_classes, lines)
        facts = LayoutFacts(
            note=self.note,
            probes=bool(self.options.probes),
            segmentation=bool(map_classes),
            rate_hz=self._rate_hz,
            on_earth=self._geo_origin is not None,
            legend_entries=len(legend),
            grid=grid,
        )
        self._layout = recording_blueprint(self.rig, facts)
        self._file = RrdFile(self.path, None if self._resume is None else self._resume.size)
        follows = replace(facts, follows=self._live is not None)
        self._connect(self._file, recording_blueprint(self.rig, follows))
        if self._live is not None:
            self._live.open(self.path)
        log_static.log_scene(self._stream, self.rig, self.classes, vehicle, grid)
        for name, of_class in meshes.items():
            log_static.log_mesh(self._stream, entities.class_mesh(name), of_class)
        self._with_mesh = tuple(meshes)
        self._log_about(map_classes, lines)
        log_static.log_legend(self._stream, legend)
        if self._resume is not None:
            self._origin, self._last = self._resume.origin, self._resume.last
            self._tracks.go_on_from(self._resume.tracks)
            if self._bev_images is not None:
                self._bev_images.colors = self._resume.colors
        return self

    def _log_about(self, map_classes: tuple[str, ...], lines: Sequence[tuple[str, Color]]) -> None:
        """Writes the page "About", and the facts of the run that readers of the file need."""
        of_map: dict[str, Any] = {"map_classes": list(map_classes)} if map_classes else {}
        if lines:
            names, colors = zip(*lines, strict=True)
            of_map |= {"line_names": list(names), "line_colors": list(map(hex_of_color, colors))}
        facts = rr.AnyValues(
            title=self.title,
            untrained=self.untrained,
            note=self.note,
            score=self.options.score,
            class_names=list(self.classes),
            class_colors=list(map(hex_of_color, self.classes.values())),
            camera_names=list(self.rig.names),
            **of_map,
        )
        text = log_static.about_text(self.title, self.rig, self.options, untrained=self.untrained)
        self._stream.log(entities.RUN, rr.TextDocument(text, media_type="text/markdown"), facts, static=True)

    def _connect(self, file: RrdFile, layout: Layout | None) -> None:
        """Makes rerun write a new stream into the file. Raises OutputError."""
        try:
            self._stream.set_sinks(file.sink(), default_blueprint=layout)
        except RuntimeError as error:
            raise OutputError(f"{self.path}: the recording cannot be written ({error})") from error
        finally:
            file.opened()
            if layout is not None:
                layout.free()

    def __exit__(self, *error: object) -> None:
        assert self._file is not None
        try:
            if self._bev_images is not None:
                self._log_bev_images(self._bev_images.finish())
            if self._video is not None:
                self._video.close()
            if self._live is not None:  # who opens the file later sees it from the first frame on
                self._stream.send_blueprint(self._layout, make_active=False)
                self._layout.free()
            self._flush()
        finally:
            self._disconnect()
            self._file.close()
            if self._live is not None:
                self._live.close()

    def state(self) -> RecordingState | None:
        """The state from which a later Recording goes on; None as long as it cannot be resumed.

        BEV colours are fitted on the first two frames, and are part of the state.
        """
        colors = None if self._bev_images is None else self._bev_images.colors
        if self._origin is None or self._file is None or (self._bev_images is not None and colors is None):
            return None
        tracks = self._tracks.state()
        return RecordingState(self._recording_id, self._file.size, self._origin, self._last, colors, tracks)

    def is_deleted(self) -> bool:
        """True if somebody has deleted the file that is being written."""
        return self._file is not None and self._file.is_deleted()

    def log(self, frame: Frame, prediction: Prediction) -> None:
        """Writes one frame: images, shown boxes, ground truth, curves, events and the model's internals."""
        self._log_ego(frame)
        cameras = self._log_cameras(frame)
        self._log_boxes(frame, prediction, cameras)
        self._log_results(prediction, cameras)
        if self._last is None:
            log_static.log_curve_names(self._stream, prediction.stage_seconds, self.classes)
        self._stream.log(entities.STAGE_CURVES, rr.Scalars(list(prediction.stage_seconds.values())))
        self._log_frame_events(frame, prediction)
        if self.options.shows_internals:
            self._log_internals(frame, prediction, cameras)
        self._last = LastFrame(frame.stamp.scene, frame.world_from_ego)
        self._flush()
        self._frames += 1
        # A new stream frees the index of the one before.
        if self._frames % INDEXED_FRAMES == 0:
            assert self._file is not None
            self._connect(self._file, None)

    def event(self, text: str, level: str = "INFO") -> None:
        """Writes a line into the event log, at the newest frame; before the first frame, at the first one.

        level: "INFO", "WARN" or "ERROR".
        """
        if self._origin is None:
            self._early_events.append((text, level))
        else:
            self._stream.log(entities.EVENTS, rr.TextLog(text, level=level))

    def _disconnect(self) -> None:
        """Closes rerun's sinks, within FLUSH_TIMEOUT_S: rerun itself waits without a limit."""
        closing = threading.Thread(target=self._stream.disconnect, name="close-recording", daemon=True)
        closing.start()
        closing.join(FLUSH_TIMEOUT_S)
        if closing.is_alive():
            raise WaitError(f"{self.path}: the recording could not be closed within {FLUSH_TIMEOUT_S:.0f} s")

    def _at(self, stamp: FrameStamp) -> None:
        self._stream.set_time(entities.FRAME_TIMELINE, sequence=stamp.index)
        self._stream.set_time(entities.TIME_TIMELINE, timestamp=np.datetime64(stamp.timestamp_ns, "ns"))

    def _flush(self) -> None:
        assert self._file is not None
        try:
            self._stream.flush(timeout_sec=FLUSH_TIMEOUT_S)
            self._file.sync()
        except (RuntimeError, ValueError, TimeoutError) as error:
            raise OutputError(f"{self.path}: the recording cannot be written ({error})") from error

    def _log_ego(self, frame: Frame) -> None:
        """Writes the ego pose. The recording's world frame has its origin at the first frame's ego position."""
        if self._origin is None:
            self._origin = frame.world_from_ego.matrix[:3, 3].copy()
            self._stream.log(entities.WORLD, rr.AnyValues(origin=self._origin), static=True)
        self._at(frame.stamp)
        pose = self._moved_to_origin(frame.world_from_ego.matrix)
        self._stream.log(
            entities.EGO,
            _transform(pose),
            rr.AnyValues(scene=frame.stamp.scene, timestamp_ns=frame.stamp.timestamp_ns, pose=pose.ravel()),
        )
        if self._has_ego_motion:
            log_static.log_speed(self._stream, float(np.linalg.norm(frame.kinematics.velocity[:2])))
        before = self._last if self._last is not None and self._last.scene == frame.stamp.scene else None
        if self._geo_origin is not None:
            last = None if before is None else before.world_from_ego.translation
            log_boxes.log_ego_on_map(self._stream, self._geo_origin, frame.world_from_ego.translation, last)
        if before is not None:
            poses = (before.world_from_ego, frame.world_from_ego)
            piece = [self._moved_to_origin(pose.matrix)[:3, 3] for pose in poses]
            self._stream.log(entities.TRAJECTORY, rr.LineStrips3D([piece], colors=EGO_COLOR, radii=0.06))

    def _moved_to_origin(self, world_from_a: Array) -> Array:
        """world_from_a (4, 4) of the sequence's world -> of the recording's world."""
        assert self._origin is not None
        return rigid(-self._origin) @ world_from_a

    def _world_from_bev(self, prediction: Prediction) -> Array:
        return self._moved_to_origin(prediction.world_from_ego.matrix) @ prediction.ego_from_bev

    def _log_cameras(self, frame: Frame) -> PosedCameras:
        cameras = tuple(
            PosedCamera(c, self._moved_to_origin(frame.world_from_ego_at[c.name].matrix) @ c.ego_from_camera)
            for c in frame.rig.cameras
        )
        for posed in cameras:
            self._stream.log(entities.camera(posed.name), _transform(posed.world_from_camera))
            image = frame.images.get(posed.name)
            if self._video is None:
                log_cameras.log_image(self._stream, posed, image)
            else:
                self._video.log(posed, image)
        return cameras

    def _log_boxes(self, frame: Frame, prediction: Prediction, cameras: PosedCameras) -> None:
        shown = prediction.boxes.scored(self.options.score)
        world_from_bev = self._world_from_bev(prediction)
        in_world = shown.transformed(world_from_bev)
        marks = log_boxes.false_and_duplicate(shown, None)
        if frame.ground_truth is not None:
            in_recording = frame.ground_truth.transformed(self._moved_to_origin(np.eye(4)))
            truth = log_boxes.detectable(in_recording.transformed(inverse(world_from_bev)), prediction.grid)
            found = np.ones(len(truth), dtype=bool)
            if not self.untrained:  # random boxes match nothing: a scene all in red would be useless
                marks = log_boxes.false_and_duplicate(shown, truth)
                found = marks.found | log_boxes.other_classes(truth, self.classes)
            self._log_ground_truth(truth, found, world_from_bev, cameras)
        stream, names = self._stream, self.classes
        ego_xy = self._moved_to_origin(prediction.world_from_ego.matrix)[:2, 3]
        log_boxes.log_boxes_3d(stream, in_world, marks, names, ego_xy)
        log_class_meshes(stream, in_world, self._with_mesh)
        log_boxes.log_boxes_bev(stream, shown, marks, names)
        self._tracks.log(in_world, frame.stamp, inverse(world_from_bev))
        if self._geo_origin is not None:
            in_sequence = shown.transformed(prediction.world_from_ego.matrix @ prediction.ego_from_bev)
            log_boxes.log_boxes_on_map(stream, self._geo_origin, in_sequence, names)
        for posed in cameras:
            log_cameras.log_boxes_in_image(stream, posed, in_world, names)
        counts = [float((shown.classes == name).sum()) for name in names]
        stream.log(entities.BOX_CURVES, rr.Scalars(counts))

    def _log_results(self, prediction: Prediction, cameras: PosedCameras) -> None:
        """Writes lines of the map, futures and planned paths of a model that has further results."""
        if not self._config.results:
            return
        world_from_bev, score = self._world_from_bev(prediction), self.options.score
        moved = Pose.from_matrix(self._moved_to_origin(prediction.world_from_ego.matrix))
        ground = replace(prediction.ground, world_from_ego=moved)
        shown = prediction.boxes.scored(score).transformed(world_from_bev)
        of_results = result_lines(prediction.results, ground, self._config.results, score)
        for lines in (*of_results, future_lines(shown, self.classes)):
            log_ground_lines(self._stream, lines, world_from_bev, cameras)

    def _log_ground_truth(
        self, truth: Boxes3D, found: np.ndarray, world_from_bev: Array, cameras: PosedCameras
    ) -> None:
        in_world = truth.transformed(world_from_bev)
        colors = log_boxes.ground_truth_colors(found, log_boxes.other_classes(truth, self.classes))
        log_boxes.log_ground_truth_3d(self._stream, in_world, found, colors)
        log_boxes.log_ground_truth_bev(self._stream, truth, found, colors)
        for posed in cameras:
            log_cameras.log_ground_truth_in_image(self._stream, posed, in_world, colors)

    def _log_frame_events(self, frame: Frame, prediction: Prediction) -> None:
        if self._last is None and self.note in WARNINGS:
            self.event(WARNINGS[self.note], "WARN")
        where = f"frame {frame.stamp.index}"
        while self._early_events:
            self.event(*self._early_events.pop(0))
        if prediction.started_anew:
            scene = f', scene "{frame.stamp.scene}"' if frame.stamp.scene else ""
            self.event(f"{where}: no history: {prediction.started_anew}{scene}")
        for camera, reason in frame.dropped.items():
            self.event(f"{where}: camera {camera} has no image: {reason}", "WARN")
        if prediction.skipped:
            self.event(f"{where}: no camera has an image; the model was not run", "WARN")
        if prediction.not_finite:
            self.event(f"{where}: NaN or infinity in {prediction.not_finite}; no boxes, the state was reset", "ERROR")

    def _log_internals(self, frame: Frame, prediction: Prediction, cameras: PosedCameras) -> None:
        self._log_pillars(frame, prediction, cameras)
        if prediction.segmentation is not None:
            log_bev.log_segmentation(self._stream, prediction.segmentation, prediction.ego_from_bev)
        if self._bev_images is not None and prediction.bev is not None:
            grid = prediction.grid
            features = prediction.bev.detach().float().cpu().numpy().reshape(grid.rows, grid.columns, -1)
            self._log_bev_images(self._bev_images.push((frame.stamp, prediction), features))
            self._at(frame.stamp)
        self._log_attention(prediction, cameras)

    def _log_bev_images(self, ready: list[tuple[tuple[FrameStamp, Prediction], np.ndarray]]) -> None:
        for (stamp, prediction), image in ready:
            self._at(stamp)
            log_bev.log_features(self._stream, image, prediction.grid, prediction.ego_from_bev)

    def _log_pillars(self, frame: Frame, prediction: Prediction, cameras: PosedCameras) -> None:
        if self._pillars is None:
            self._pillars = log_static.drawn_pillars(prediction.grid, all_cells=self.options.level == "full")
            log_static.log_pillars(self._stream, prediction.grid, prediction.ego_from_bev, self._pillars)
        colors = log_static.pillar_colors(prediction.grid, len(self._pillars))
        points = apply(self._world_from_bev(prediction), self._pillars.reshape(-1, 3))
        for posed in cameras:
            if posed.name in frame.images:
                log_cameras.log_pillar_hits(self._stream, posed, points, colors)

    def _log_attention(self, prediction: Prediction, cameras: PosedCameras) -> None:
        attention = prediction.attention
        if attention is None:
            return
        log_bev.log_history(self._stream, attention.history_weight, prediction.grid)
        log_bev.log_probes(self._stream, attention.probes, prediction.ego_from_bev, prediction.grid)
        for posed in cameras if attention.probes else ():
            samples = [p.cameras[posed.name] for p in attention.probes if posed.name in p.cameras]
            log_cameras.log_samples(self._stream, posed, samples)


def _transform(parent_from_entity: Array) -> rr.Transform3D:
    return rr.Transform3D(translation=parent_from_entity[:3, 3], mat3x3=parent_from_entity[:3, :3])


def weights_note(model: RecordedModel, sequence: RecordedDrive) -> str:
    """A note on the weights for the titles of the views, "" for none: a key of WARNINGS."""
    if model.untrained:
        return UNTRAINED
    return FROM_RENDERED if model.bundled and not sequence.facts.rendered else ""


def frame_rate_hz(stamps: tuple[FrameStamp, ...]) -> float:
    """Frames per second: 1 / the median time between frames; 2 where there are less than two frames."""
    steps = np.diff([stamp.timestamp_ns for stamp in stamps])
    steps = steps[steps > 0]
    return float(1e9 / np.median(steps)) if len(steps) else 2.0
