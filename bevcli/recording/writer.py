"""Recording: writes frames and predictions into an .rrd file, frame by frame.

The rows of a frame: poses, images, boxes, curves and events; then features, maps, probes and lines on the ground.
"""

from __future__ import annotations

import threading
import uuid
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bevcli.errors import OutputError
from bevcli.frame import BevMap, Frame, FrameStamp, GroundLines, Prediction, result_of
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array, Pose, apply, inverse, rigid
from bevcli.recording import RecordingOptions, entities, log_boxes, log_cameras, log_static
from bevcli.recording.blueprint import recording_blueprint
from bevcli.recording.entities import any_values, components, log
from bevcli.recording.log_cameras import ImageLayer, PosedCamera
from bevcli.recording.log_ground import (
    BevColors,
    BevImages,
    SeenCells,
    future_lines,
    log_flat_image,
    log_ground_lines,
    log_on_ground,
    log_probes,
)
from bevcli.recording.log_static import Recorded, RecordedBoxes, RecordedDrive, RecordedModel
from bevcli.sequences.files.incremental_json import GrowingFile

PosedCameras = tuple[PosedCamera, ...]
FileBoxes = Sequence[Boxes3D | None]  # of each file, in the world frame; None where it lacks the frame
APPLICATION = "bevcli"
FLUSH_TIMEOUT_S = 20.0
ROWS_AT_ONCE = 16  # rerun's threads encode so many while ours makes the next ones, not all of a frame at its end
SPEED_LABEL_M = (1.35, 0.0, 3.2)  # in the ego frame: above the vehicle
BEHIND = rigid((0.0, 0.0, -1e9))  # from the world to a camera without an image: nothing is drawn into it
GROUND_OPACITY = 110  # of 255: boxes, rings and the trajectory stay readable on the map
# Has all columns of tracks, so that the trails of the frame before are cleared.
NO_BOXES = replace(Boxes3D.empty(), scores=np.zeros(0), instances=np.zeros(0, np.str_))


class LiveSink(Protocol):
    """A viewer that follows a recording while it is written, such as `bevcli.viewer.rerun_viewer.LiveView`."""

    def open(self, recording: Path) -> None:
        """Called once, when the file is there."""

    def close(self) -> None:
        """Called once, when the file is whole."""


@dataclass
class RecordingState:
    """What the frames so far leave behind for later ones, also for those of a resumed run."""

    recording_id: str  # rerun's id of the recording
    size: int = 0  # bytes of the file after the last frame
    # (3,) the recording's origin in the sequence's world, metres: the place of the first frame's ego vehicle
    origin: Array | None = None
    scene: str = ""  # of the last frame
    world_from_ego: Pose | None = None  # pose of the last frame in the sequence's world; None before the first one
    colors: BevColors | None = None  # of the BEV features, None where these are not drawn
    tracks: log_boxes.TrackHistory = field(default_factory=log_boxes.TrackHistory)  # the trails
    without_image: list[str] = field(default_factory=list)  # cameras that had no image in the last frame
    has_truth: bool = False  # the last frame had ground truth


@dataclass(frozen=True)
class _Poses:
    """The frames of reference of one frame's boxes."""

    moved: Array  # (4, 4) from the sequence's world into the recording's world
    pose: Pose  # of the vehicle in the sequence's world
    ego_from_bev: Array  # (4, 4)

    @cached_property
    def world_from_bev(self) -> Array:
        """(4, 4) into the recording's world."""
        return self.moved @ self.pose.matrix @ self.ego_from_bev

    def in_bev(self, boxes: Boxes3D) -> Boxes3D:
        """Boxes of the sequence's world in the bev frame."""
        return boxes.transformed(self.moved).transformed(inverse(self.world_from_bev))

    def away(self, boxes: Boxes3D) -> Array:
        """(N,) distances on the ground from the vehicle to boxes of the bev frame, metres."""
        in_ego = boxes.transformed(self.pose.matrix @ self.ego_from_bev).centers[:, :2]
        return np.asarray(np.linalg.norm(in_ego - self.pose.matrix[:2, 3], axis=-1))

    def within(self, boxes: Boxes3D, ranges_m: Mapping[str, float]) -> NDArray[np.bool_]:
        """(N,) bool, the boxes of the bev frame that are nearer than the range of their class."""
        return np.asarray(self.away(boxes) < [ranges_m.get(name, 0.0) for name in boxes.classes.tolist()])

    def labels(self, boxes: Boxes3D, texts: list[str], count: int) -> list[str]:
        """The texts of the boxes nearest to the vehicle, at most `count`; "" for others. boxes: in the bev frame."""
        near = set(np.argsort(self.away(boxes))[:count].tolist())
        return [text if i in near else "" for i, text in enumerate(texts)]


class Recording:
    """Writes a recording: `with Recording(...) as recording: recording.log(frame, prediction)`, frames in order.

    Each frame is on the disk when `log` returns, so a killed run keeps all frames up to then. The file has no index,
    which rerun would keep in memory until the end, some 0.3 MB a frame.

    Args:
        path: the .rrd file to write; an existing one is replaced.
        sequence: the drive, or a `Session`; the rig and the name are taken from it.
        model: the class names, the name and whether it is trained are taken from it; `RecordedBoxes` without a model.
        options: how much is written; the defaults of RecordingOptions if None.
        live: a viewer that follows the recording; None for no viewer.
        resume: `state()` of the recording that was interrupted; the file is cut to its size and goes on from there.

    Raises OutputError when the file cannot be written, and InputError when a mesh cannot be read.
    """

    def __init__(
        self,
        path: str | Path,
        sequence: RecordedDrive,
        model: RecordedModel | RecordedBoxes,
        options: RecordingOptions | None = None,
        live: LiveSink | None = None,
        resume: RecordingState | None = None,
    ) -> None:
        self.path, self._live, self._options = Path(path), live, RecordingOptions() if options is None else options
        self._recorded = recorded = Recorded(sequence, model, self._options)
        self._geo_origin = recorded.drive.facts.geo_origin
        self._resume_at = None if resume is None else resume.size
        self._kept = RecordingState(str(uuid.uuid4())) if resume is None else resume
        # rerun keeps two threads and some MB of every stream that nobody uses any more, until this call.
        threading.Thread(target=rr.bindings.flush_and_cleanup_orphaned_recordings, daemon=True).start()
        batches = rr.ChunkBatcherConfig(flush_num_rows=ROWS_AT_ONCE)
        self._stream = rr.RecordingStream(APPLICATION, recording_id=self._kept.recording_id, batcher_config=batches)
        self._early_events: list[tuple[str, str]] = []  # logged before the first frame
        self._pillars: tuple[Array, NDArray[np.uint32]] | None = None  # of `log_pillars`
        self._seen_cells = SeenCells()
        self._with_meshes = [name for name, settings in recorded.object_classes.items() if settings.mesh]
        as_video, without = self._options.images == "av1", self._kept.without_image
        self._images = log_cameras.CameraImages(self._stream, as_video, without)
        draws_bev = self._options.bev != "none" and self._options.shows_internals
        # Its stamps are predictions.
        self._bev_images = BevImages(self._options.bev, self._kept.colors) if draws_bev else None

    def __enter__(self) -> Recording:
        recorded, path = self._recorded, self._options.vehicle_mesh
        vehicle, of_classes = None, {}
        if path is not None or self._with_meshes:
            from bevcli.workshop.meshes import load_vehicle, read_class_meshes

            vehicle = None if path is None else load_vehicle(path)
            of_classes = read_class_meshes(recorded.object_classes)
        self._bytes = rr.binary_stream(self._stream)
        self.file = GrowingFile(self.path, self._resume_at)
        self._send_layout(follows=self._live is not None)
        if self._live is not None:
            self._live.open(self.path)
        log_static.log_scene(self._stream, recorded.drive.rig, recorded.classes, vehicle, recorded.grid)
        for name, mesh in of_classes.items():
            log_static.log_mesh(self._stream, entities.class_mesh(name), mesh)
        log_static.log_about(self._stream, recorded)
        return self

    def _send_layout(self, *, follows: bool) -> None:
        layout = recording_blueprint(self._recorded, follows=follows)
        self._stream.send_blueprint(layout, make_active=False)
        layout.free()

    def __exit__(self, *error: object) -> None:
        with self.file:
            try:
                if self._bev_images is not None:  # those that wait for later frames
                    self._log_bev_images(self._bev_images.finish())
                for encoder in self._images.encoders.values():
                    encoder.close()
                if self._live is not None:  # who opens the file later sees it from the first frame on
                    self._send_layout(follows=False)
                self._write()
            finally:
                self._stream.disconnect()
                if self._live is not None:
                    self._live.close()

    def state(self) -> RecordingState | None:
        """The state from which a later Recording goes on; None as long as it cannot be resumed.

        BEV colours are fitted on the first two frames, and are part of the state.
        """
        self._kept.colors = None if self._bev_images is None else self._bev_images.colors
        can_resume = self._kept.origin is not None and (self._bev_images is None or self._kept.colors is not None)
        return deepcopy(self._kept) if can_resume else None

    def _write(self) -> None:
        """Append to the file what was logged since the last call. Raises OutputError."""
        try:
            content = self._bytes.read(flush_timeout_sec=FLUSH_TIMEOUT_S) or b""
        except RuntimeError as error:
            raise OutputError(f"{self.path}: the recording cannot be written ({error})") from error
        end = entities.FILE_HEADER
        while end < len(content):  # up to the index, which every call gives anew
            kind, length = entities.MESSAGE_HEADER.unpack_from(content, end)
            if kind == entities.INDEX:
                break
            end += entities.MESSAGE_HEADER.size + length
        self.file.append(memoryview(content)[entities.FILE_HEADER if self.file.size else 0 : end])
        self._kept.size = self.file.size

    def log(self, frame: Frame, predicted: Prediction | FileBoxes) -> None:
        """Writes one frame: images, shown boxes, ground truth, curves, events and the model's internals.

        found: by the model, or without one the boxes of each file, in the world frame; None where it lacks the frame.
        """
        prediction = predicted if isinstance(predicted, Prediction) else None
        stream, is_first = self._stream, self._kept.world_from_ego is None
        if self._kept.origin is None:  # the recording's world frame has its origin at the first frame's ego position
            self._kept.origin = frame.world_from_ego.matrix[:3, 3].copy()
            stream.log(entities.WORLD, rr.AnyValues(origin=self._kept.origin), static=True)
        self._at(frame.stamp)
        moved = rigid(-self._kept.origin)  # from the sequence's world into the recording's world
        if prediction is not None:
            frame_poses = _Poses(moved, prediction.world_from_ego, prediction.ego_from_bev)
        else:
            frame_poses = _Poses(moved, frame.world_from_ego, frame.rig.ego_from_bev)
        self._log_ego(frame, moved)
        poses = [moved @ frame.world_from_ego_at[c.name].matrix @ c.ego_from_camera for c in frame.rig.cameras]
        cameras = tuple(
            PosedCamera(camera, pose, inverse(pose) if camera.name in frame.images else BEHIND)
            for camera, pose in zip(frame.rig.cameras, poses, strict=True)
        )
        for posed in cameras:
            log(stream, entities.camera(posed.camera.name), log_cameras.transform(posed.world_from_camera))
            self._images.log(posed.camera, frame.images.get(posed.camera.name))
        self._log_boxes(frame, predicted, frame_poses, cameras)
        if is_first:
            counted = self._recorded.layers or self._recorded.classes
            lines = rr.SeriesLines(names=list(counted), colors=list(counted.values()))
            stream.log(entities.BOX_CURVES, lines, static=True)
            stream.log(entities.SPEED_CURVE, rr.SeriesLines(names="km/h", colors=entities.EGO_COLOR), static=True)
        if prediction is not None:
            if self._recorded.results:
                self._log_results(prediction, frame_poses, cameras)
            has_detector = self._recorded.config is not None and bool(self._recorded.config.image_classes)
            if has_detector or prediction.image_boxes is not None:
                found_in = prediction.image_boxes or {}
                shown = {name: boxes.scored(self._options.score) for name, boxes in found_in.items()}
                least, classes = self._options.score, self._recorded.classes
                colors = log_boxes.image_box_colors(prediction, frame, shown, least, classes)
                log_cameras.log_image_boxes(stream, cameras, shown, colors)
            self._log_stages(prediction, is_first=is_first)
        elif self._recorded.map_classes:
            self._log_map(frame.ground_truth_map, frame.rig.ego_from_bev)
        self._log_events(frame, predicted)
        if prediction is not None and self._options.shows_internals:
            self._log_internals(frame, prediction, frame_poses.world_from_bev, cameras)
        self._kept.scene, self._kept.world_from_ego = frame.stamp.scene, frame.world_from_ego
        self._write()

    def event(self, text: str, level: str = "INFO") -> None:
        """Writes a line into the event log, at the newest frame; before the first frame, at the first one.

        level: "INFO", "WARN" or "ERROR".
        """
        if self._kept.origin is None:
            self._early_events.append((text, level))
        else:
            self._stream.log(entities.EVENTS, rr.TextLog(text, level=level))

    def _at(self, stamp: FrameStamp) -> None:
        self._stream.set_time(entities.FRAME_TIMELINE, sequence=stamp.index)
        self._stream.set_time(entities.TIME_TIMELINE, timestamp=np.datetime64(stamp.timestamp_ns, "ns"))

    def _log_ego(self, frame: Frame, moved: Array) -> None:
        """Writes the ego pose, the speed (a curve and a label above the vehicle), the way since the frame before.

        moved: (4, 4) from the sequence's world into the recording's world.
        """
        stream, stamp = self._stream, frame.stamp
        pose = moved @ frame.world_from_ego.matrix
        row = any_values(scene=stamp.scene, timestamp_ns=stamp.timestamp_ns, pose=pose.ravel())
        log(stream, entities.EGO, log_cameras.transform(pose) | row)
        if self._recorded.drive.has_ego_motion:
            km_h = 3.6 * float(np.linalg.norm(frame.kinematics.velocity[:2]))
            log(stream, entities.SPEED_CURVE, components(rr.Scalars, scalars=np.array([km_h])))
            label = components(
                rr.Points3D,
                positions=np.array([SPEED_LABEL_M]),
                labels=[f"{km_h:.0f} km/h"],
                colors=entities.EGO_COLOR,
                radii=log_cameras.UNSEEN,
                show_labels=True,
            )
            log(stream, entities.SPEED, label)
        before = self._kept.world_from_ego if self._kept.scene == stamp.scene else None
        if self._geo_origin is not None:
            last = None if before is None else before.translation
            log_boxes.log_ego_on_map(stream, self._geo_origin, frame.world_from_ego.translation, last)
        if before is not None:
            way = np.array([[(moved @ before.matrix)[:3, 3], pose[:3, 3]]])
            line = components(rr.LineStrips3D, strips=way, colors=entities.EGO_COLOR, radii=0.06)
            log(stream, entities.TRAJECTORY, line)

    def _log_boxes(self, frame: Frame, predicted: Prediction | FileBoxes, poses: _Poses, cameras: PosedCameras) -> None:
        """Writes the boxes and the ground truth of a frame."""
        recorded, files = self._recorded, self._recorded.files
        if isinstance(predicted, Prediction):
            sides, grid = [predicted.boxes], predicted.grid
        else:
            sides, grid = [poses.in_bev(boxes) if boxes else NO_BOXES for boxes in predicted], None
        sides = [boxes.shown(self._options.score) for boxes in sides]
        truth = None if frame.ground_truth is None else poses.in_bev(frame.ground_truth)
        truth = None if truth is None else log_boxes.detectable(truth, grid)
        if files is not None and not files.names:  # labels alone are drawn as boxes
            sides, truth = [truth or NO_BOXES], None
        marks = log_boxes.false_and_duplicate(sides[0], None)
        missed = np.zeros(0 if truth is None else len(truth), dtype=bool)
        is_known = isinstance(predicted, Prediction) or all(boxes is not None for boxes in predicted)
        # Random boxes match nothing: a scene all in red would be useless.
        if truth is not None and is_known and not recorded.layers and not recorded.model.untrained:
            marks = self._marks(sides[0], truth, poses)
            missed = ~marks.found & ~log_boxes.other_classes(truth, recorded.classes)
            if frame.images:  # elsewhere no model can find it
                missed &= frame.sees(truth.transformed(poses.pose.matrix @ poses.ego_from_bev))
        if recorded.layers:
            drawn = [self._log_layer(*layer, poses) for layer in zip(recorded.layers.items(), sides, strict=True)]
            none = log_boxes.false_and_duplicate(NO_BOXES, None)
            log_boxes.log_boxes_3d(self._stream, NO_BOXES, np.zeros((0, 8, 3)), none, {}, [])
            counts = list(map(len, sides))
        else:
            drawn = [self._log_shown(frame.stamp, sides[0], marks, poses)]
            counts = [(sides[0].classes == name).sum() for name in recorded.classes]
        if truth is not None or self._kept.has_truth:  # a frame without labels clears those of the one before
            drawn.append(self._log_truth(NO_BOXES if truth is None else truth, missed, poses))
        self._kept.has_truth = truth is not None
        log_cameras.log_boxes_in_images(self._stream, cameras, drawn)
        log(self._stream, entities.BOX_CURVES, components(rr.Scalars, scalars=np.array(counts)))

    def _marks(self, shown: Boxes3D, truth: Boxes3D, poses: _Poses) -> log_boxes.Marks:
        """The marks of boxes, both in the bev frame: of a model all over its grid, of a file where it is scored."""
        files = self._recorded.files
        if files is None:
            return log_boxes.false_and_duplicate(shown, truth)
        return log_boxes.marks_within(shown, truth, *(poses.within(side, files.ranges_m) for side in (shown, truth)))

    def _log_truth(self, truth: Boxes3D, missed: NDArray[np.bool_], poses: _Poses) -> ImageLayer:
        """Writes ground truth (M, bev frame) into the scene and the BEV view; returns its drawing in the images."""
        other = log_boxes.other_classes(truth, self._recorded.classes)
        in_world, colors = truth.transformed(poses.world_from_bev), log_boxes.ground_truth_colors(~missed, other)
        log_boxes.log_ground_truth(self._stream, in_world, truth.corners(), ~missed, colors)
        return ImageLayer("ground_truth", in_world.corners(), colors, width=0.6, order=20)

    def _log_layer(self, layer: tuple[str, Color], shown: Boxes3D, poses: _Poses) -> ImageLayer:
        """Writes the boxes of one of two models, a name and a colour; returns their drawing in the images."""
        (name, color), in_world = layer, shown.transformed(poses.world_from_bev)
        texts = log_cameras.box_labels(shown)
        labels = poses.labels(shown, texts, log_boxes.LABELS_IN_SCENE // 2)
        log_boxes.log_layer(self._stream, name, in_world, shown.corners(), color, labels)
        colors = np.tile(np.array(color, np.uint8), (len(shown), 1))
        return ImageLayer(entities.layer("", name)[1:], in_world.corners(), colors, texts)

    def _log_shown(self, stamp: FrameStamp, shown: Boxes3D, marks: log_boxes.Marks, poses: _Poses) -> ImageLayer:
        """Writes the boxes (N, bev frame) of one model, or labels alone; returns their drawing in the images."""
        stream, classes = self._stream, self._recorded.classes
        in_world, colors = shown.transformed(poses.world_from_bev), log_boxes.box_colors(shown, classes)
        files = self._recorded.files
        is_label = files is not None and not files.names  # the names of labelled objects are long
        corners = in_world.corners()
        texts = log_cameras.box_labels(replace(shown, instances=None) if is_label else shown)
        labels = poses.labels(shown, texts, log_boxes.LABELS_IN_SCENE)
        log_boxes.log_boxes_3d(stream, in_world, corners, marks, classes, labels)
        for name in self._with_meshes:
            log_boxes.log_class_mesh(stream, name, in_world[in_world.classes == name])
        log_boxes.log_boxes_bev(stream, shown, shown.corners(), marks, colors)
        bev_from_world = inverse(poses.world_from_bev)
        log_boxes.log_tracks(stream, self._kept.tracks, in_world, corners, colors, stamp, bev_from_world)
        if self._geo_origin is not None:
            centers = apply(poses.pose.matrix @ poses.ego_from_bev, shown.centers)
            log_boxes.log_boxes_on_map(stream, self._geo_origin, centers, colors if len(shown) else None)
        return ImageLayer("boxes", corners, colors, texts)

    def _log_stages(self, prediction: Prediction, *, is_first: bool) -> None:
        """Writes the seconds of each stage of the model."""
        if is_first:
            stages, bright = list(prediction.stage_seconds), entities.STAGE_COLORS
            colors = [bright[i % len(bright)] for i in range(len(stages))]
            self._stream.log(entities.STAGE_CURVES, rr.SeriesLines(names=stages, colors=colors), static=True)
        seconds = np.array(list(prediction.stage_seconds.values()))
        log(self._stream, entities.STAGE_CURVES, components(rr.Scalars, scalars=seconds))

    def _log_results(self, prediction: Prediction, poses: _Poses, cameras: PosedCameras) -> None:
        """Writes the results and futures of a model that has further results."""
        score, world_from_bev = self._options.score, poses.world_from_bev
        ground = replace(prediction.ground, world_from_ego=Pose.from_matrix(poses.moved @ poses.pose.matrix))
        for cls, names in self._recorded.results.items():
            result = result_of(cls, prediction.results)
            lines = GroundLines() if result is None else result.drawn(ground, names, score)
            log_ground_lines(self._stream, cls.kind, lines, world_from_bev, cameras)
        shown = prediction.boxes.shown(score).transformed(world_from_bev)
        futures = future_lines(shown, self._recorded.classes)
        log_ground_lines(self._stream, entities.FUTURES, futures, world_from_bev, cameras)

    def _log_events(self, frame: Frame, predicted: Prediction | FileBoxes) -> None:
        if self._kept.world_from_ego is None and self._recorded.note in log_static.WARNINGS:
            self.event(log_static.WARNINGS[self._recorded.note], "WARN")
        name = f"frame {frame.stamp.index}"
        while self._early_events:
            self.event(*self._early_events.pop(0))
        if isinstance(predicted, Prediction) and predicted.started_anew:
            scene = f', scene "{frame.stamp.scene}"' if frame.stamp.scene else ""
            self.event(f"{name}: no history: {predicted.started_anew}{scene}")
        for camera, reason in frame.dropped.items():
            self.event(f"{name}: camera {camera} has no image: {reason}", "WARN")
        if isinstance(predicted, Prediction):
            if predicted.failure:
                self.event(f"{name}: {predicted.failure}", "ERROR" if predicted.not_finite else "WARN")
            return
        for file, boxes in zip(self._recorded.files.names if self._recorded.files else (), predicted, strict=True):
            if boxes is None:
                self.event(f"{name}: {file} does not have this frame", "WARN")

    def _log_internals(
        self, frame: Frame, prediction: Prediction, world_from_bev: Array, cameras: PosedCameras
    ) -> None:
        """Writes pillars, segmentation, BEV features, history weights and probes."""
        stream, grid, ego_from_bev = self._stream, prediction.grid, prediction.ego_from_bev
        ranges = grid.x_range_m, grid.y_range_m
        if self._pillars is None:
            all_cells = self._options.level == "full"
            self._pillars = log_static.log_pillars(stream, grid, ego_from_bev, all_cells=all_cells)
        pillars, colors = self._pillars
        points = apply(world_from_bev, pillars)
        for posed in cameras:
            log_cameras.log_pillar_hits(stream, posed, points, colors)
        if prediction.segmentation is not None:
            self._log_map(self._seen_cells.of(prediction.segmentation, frame, grid), ego_from_bev)
        if prediction.failure:
            overlays = [entities.overlay(posed.camera.name, "probes") for posed in cameras]
            self._clear(*entities.OF_THE_INSIDE, *overlays)
        if self._bev_images is not None and prediction.bev is not None:
            features = prediction.bev.detach().float().cpu().numpy().reshape(grid.rows, grid.columns, -1)
            self._log_bev_images(self._bev_images.push(prediction, features))
            self._at(frame.stamp)
        if (attention := prediction.attention) is None:
            return
        if attention.history_weight is None:  # no history was used
            self._clear(entities.BEV_HISTORY)
        else:
            log_flat_image(stream, entities.BEV_HISTORY, entities.colormap(attention.history_weight[::-1]), ranges, -8)
        if attention.probes:
            log_probes(stream, attention.probes, ego_from_bev, grid)
            for posed in cameras:
                name = posed.camera.name
                samples = [probe.cameras[name] for probe in attention.probes if name in probe.cameras]
                log_cameras.log_samples(stream, posed, samples)

    def _log_map(self, ground_map: BevMap | None, ego_from_bev: Array) -> None:
        """Writes a map into the BEV view and on the ground of the scene; None clears that of the frame before."""
        flat, on_ground = entities.BEV_SEGMENTATION, entities.SEGMENTATION_ON_GROUND
        if ground_map is None:
            self._clear(flat, on_ground)
            return
        painted = ground_map.painted(entities.map_colors(ground_map.classes), entities.BACKGROUND)
        of_map = ground_map.x_range_m, ground_map.y_range_m
        log_flat_image(self._stream, flat, painted, of_map, -5)
        log_on_ground(self._stream, on_ground, painted, of_map, ego_from_bev, 255)

    def _clear(self, *of_entities: str) -> None:
        """Clears what entities show of the frame before."""
        for entity in of_entities:
            self._stream.log(entity, rr.Clear(recursive=False))

    def _log_bev_images(self, ready: list[tuple[Prediction, NDArray[np.uint8]]]) -> None:
        for prediction, image in ready:
            self._at(prediction.stamp)
            ranges = prediction.grid.x_range_m, prediction.grid.y_range_m
            log_flat_image(self._stream, entities.BEV_FEATURES, image, ranges, -10)
            ground = entities.BEV_ON_GROUND
            log_on_ground(self._stream, ground, image, ranges, prediction.ego_from_bev, GROUND_OPACITY)
