"""What a recording says about each frame: poses, images, boxes, lines, curves, events, and the model's internals."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field, replace

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bevcli.frame import Frame, FrameStamp, GroundLines, Prediction, result_of
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, Pose, apply, inverse, rigid
from bevcli.recording import entities, log_bev, log_boxes, log_cameras, log_static
from bevcli.recording.colors import EGO_COLOR
from bevcli.recording.components import any_values, components
from bevcli.recording.log_bev import BevColors, BevImages, future_lines, log_ground_lines
from bevcli.recording.log_boxes import TrackHistory, log_tracks
from bevcli.recording.log_cameras import CameraImages, PosedCamera, box_labels
from bevcli.recording.log_static import WARNINGS, Recorded
from bevcli.recording.meshes import log_class_meshes

PosedCameras = tuple[PosedCamera, ...]


@dataclass
class FrameLogState:
    """What the frames so far leave behind for later ones.

    Attributes:
        origin: (3,) the recording's origin in the sequence's world, metres: the place of the first frame's ego vehicle.
        scene: of the last frame.
        world_from_ego: pose of the last frame in the sequence's world; None before the first one.
        colors: of the BEV features, None where these are not drawn.
        tracks: the trails.
    """

    origin: Array | None = None
    scene: str = ""
    world_from_ego: Pose | None = None
    colors: BevColors | None = None
    tracks: TrackHistory = field(default_factory=TrackHistory)


class FrameLog:
    """Logs frames into a stream of rerun, in order. resume: the state from which the log goes on."""

    def __init__(self, stream: rr.RecordingStream, recorded: Recorded, resume: FrameLogState | None) -> None:
        self._stream, self._recorded = stream, recorded
        self._options, self._geo_origin = recorded.options, recorded.drive.facts.geo_origin
        self._kept = FrameLogState() if resume is None else deepcopy(resume)
        self._early_events: list[tuple[str, str]] = []  # logged before the first frame
        self._pillars: tuple[Array, NDArray[np.uint32]] | None = None  # of `log_pillars`
        self._object_classes = recorded.model.config.object_classes
        self._images = CameraImages(stream, as_video=self._options.images == "av1")
        draws_bev = self._options.bev != "none" and self._options.shows_internals
        self._bev_images = BevImages(self._options.bev) if draws_bev else None  # stamps: (FrameStamp, Prediction)
        if self._bev_images is not None:
            self._bev_images.colors = self._kept.colors

    def state(self) -> FrameLogState | None:
        """The state from which a later log goes on; None as long as it cannot be resumed.

        BEV colours are fitted on the first two frames, and are part of the state.
        """
        if self._bev_images is not None:
            self._kept.colors = self._bev_images.colors
            if self._kept.colors is None:
                return None
        return None if self._kept.origin is None else deepcopy(self._kept)

    def finish(self) -> None:
        """Logs what waits for later frames."""
        if self._bev_images is not None:
            self._log_bev_images(self._bev_images.finish())
        self._images.close()

    def log(self, frame: Frame, prediction: Prediction) -> None:
        """Logs one frame: images, shown boxes, ground truth, curves, events and the model's internals."""
        self._log_ego(frame)
        cameras = self._log_cameras(frame)
        self._log_boxes(frame, prediction, cameras)
        self._log_results(prediction, cameras)
        if self._kept.world_from_ego is None:
            log_static.log_curve_names(self._stream, prediction.stage_seconds, self._recorded.classes)
        seconds = np.array(list(prediction.stage_seconds.values()))
        self._stream.log(entities.STAGE_CURVES, components(rr.Scalars, scalars=seconds))
        self._log_frame_events(frame, prediction)
        if self._options.shows_internals:
            self._log_internals(frame, prediction, cameras)
        self._kept.scene, self._kept.world_from_ego = frame.stamp.scene, frame.world_from_ego

    def event(self, text: str, level: str = "INFO") -> None:
        """See `Recording.event`."""
        if self._kept.origin is None:
            self._early_events.append((text, level))
        else:
            self._stream.log(entities.EVENTS, rr.TextLog(text, level=level))

    def _at(self, stamp: FrameStamp) -> None:
        self._stream.set_time(entities.FRAME_TIMELINE, sequence=stamp.index)
        self._stream.set_time(entities.TIME_TIMELINE, timestamp=np.datetime64(stamp.timestamp_ns, "ns"))

    def _log_ego(self, frame: Frame) -> None:
        """Writes the ego pose. The recording's world frame has its origin at the first frame's ego position."""
        if self._kept.origin is None:
            self._kept.origin = frame.world_from_ego.matrix[:3, 3].copy()
            self._stream.log(entities.WORLD, rr.AnyValues(origin=self._kept.origin), static=True)
        self._at(frame.stamp)
        pose = self._moved_to_origin(frame.world_from_ego.matrix)
        self._stream.log(
            entities.EGO,
            log_cameras.transform(pose),
            any_values(scene=frame.stamp.scene, timestamp_ns=frame.stamp.timestamp_ns, pose=pose.ravel()),
        )
        if self._recorded.drive.has_ego_motion:
            log_static.log_speed(self._stream, float(np.linalg.norm(frame.kinematics.velocity[:2])))
        before = self._kept.world_from_ego if self._kept.scene == frame.stamp.scene else None
        if self._geo_origin is not None:
            last = None if before is None else before.translation
            log_boxes.log_ego_on_map(self._stream, self._geo_origin, frame.world_from_ego.translation, last)
        if before is not None:
            poses = (before, frame.world_from_ego)
            piece = np.array([[self._moved_to_origin(pose.matrix)[:3, 3] for pose in poses]])
            self._stream.log(
                entities.TRAJECTORY, components(rr.LineStrips3D, strips=piece, colors=EGO_COLOR, radii=0.06)
            )

    def _moved_to_origin(self, world_from_a: Array) -> Array:
        """world_from_a (4, 4) of the sequence's world -> of the recording's world."""
        assert self._kept.origin is not None
        return rigid(-self._kept.origin) @ world_from_a

    def _world_from_bev(self, prediction: Prediction) -> Array:
        return self._moved_to_origin(prediction.world_from_ego.matrix) @ prediction.ego_from_bev

    def _log_cameras(self, frame: Frame) -> PosedCameras:
        cameras = tuple(
            PosedCamera(c, self._moved_to_origin(frame.world_from_ego_at[c.name].matrix) @ c.ego_from_camera)
            for c in frame.rig.cameras
        )
        for posed in cameras:
            self._stream.log(entities.camera(posed.name), log_cameras.transform(posed.world_from_camera))
            self._images.log(posed.name, frame.images.get(posed.name))
        return cameras

    def _log_boxes(self, frame: Frame, prediction: Prediction, cameras: PosedCameras) -> None:
        stream, names = self._stream, self._recorded.classes
        shown = prediction.boxes.scored(self._options.score)
        world_from_bev = self._world_from_bev(prediction)
        in_world = shown.transformed(world_from_bev)
        marks = log_boxes.false_and_duplicate(shown, None)
        if frame.ground_truth is not None:
            in_recording = frame.ground_truth.transformed(self._moved_to_origin(np.eye(4)))
            truth = log_boxes.detectable(in_recording.transformed(inverse(world_from_bev)), prediction.grid)
            found = np.ones(len(truth), dtype=bool)
            if not self._recorded.model.untrained:  # random boxes match nothing: a scene all in red would be useless
                marks = log_boxes.false_and_duplicate(shown, truth)
                found = marks.found | log_boxes.other_classes(truth, names)
            self._log_ground_truth(truth, found, world_from_bev, cameras)
        ego_xy = self._moved_to_origin(prediction.world_from_ego.matrix)[:2, 3]
        log_boxes.log_boxes_3d(stream, in_world, marks, names, ego_xy)
        log_class_meshes(stream, in_world, self._object_classes)
        log_boxes.log_boxes_bev(stream, shown, marks, names)
        log_tracks(stream, self._kept.tracks, in_world, frame.stamp, inverse(world_from_bev), names)
        if self._geo_origin is not None:
            in_sequence = shown.transformed(prediction.world_from_ego.matrix @ prediction.ego_from_bev)
            log_boxes.log_boxes_on_map(stream, self._geo_origin, in_sequence, names)
        colors, texts = log_boxes.box_colors(shown, names), box_labels(shown)
        log_cameras.log_boxes_in_images(stream, cameras, in_world, colors, texts)
        counts = np.array([(shown.classes == name).sum() for name in names])
        stream.log(entities.BOX_CURVES, components(rr.Scalars, scalars=counts))

    def _log_results(self, prediction: Prediction, cameras: PosedCameras) -> None:
        """Writes the results and futures of a model that has further results."""
        kinds = self._recorded.model.config.results
        if not kinds:
            return
        world_from_bev, score = self._world_from_bev(prediction), self._options.score
        moved = Pose.from_matrix(self._moved_to_origin(prediction.world_from_ego.matrix))
        ground = replace(prediction.ground, world_from_ego=moved)
        shown = prediction.boxes.scored(score).transformed(world_from_bev)
        for kind, names in kinds.items():
            result = result_of(kind, prediction.results)
            lines = GroundLines() if result is None else result.drawn(ground, names, score)
            log_ground_lines(self._stream, kind.kind, lines, world_from_bev, cameras)
        futures = future_lines(shown, self._recorded.classes)
        log_ground_lines(self._stream, entities.FUTURES, futures, world_from_bev, cameras)

    def _log_ground_truth(
        self, truth: Boxes3D, found: np.ndarray, world_from_bev: Array, cameras: PosedCameras
    ) -> None:
        in_world = truth.transformed(world_from_bev)
        colors = log_boxes.ground_truth_colors(found, log_boxes.other_classes(truth, self._recorded.classes))
        log_boxes.log_ground_truth(self._stream, in_world, truth, found, colors)
        log_cameras.log_ground_truth_in_images(self._stream, cameras, in_world, colors)

    def _log_frame_events(self, frame: Frame, prediction: Prediction) -> None:
        if self._kept.world_from_ego is None and self._recorded.note in WARNINGS:
            self.event(WARNINGS[self._recorded.note], "WARN")
        where = f"frame {frame.stamp.index}"
        while self._early_events:
            self.event(*self._early_events.pop(0))
        if prediction.started_anew:
            scene = f', scene "{frame.stamp.scene}"' if frame.stamp.scene else ""
            self.event(f"{where}: no history: {prediction.started_anew}{scene}")
        for camera, reason in frame.dropped.items():
            self.event(f"{where}: camera {camera} has no image: {reason}", "WARN")
        if prediction.failure:
            self.event(f"{where}: {prediction.failure}", "ERROR" if prediction.not_finite else "WARN")

    def _log_internals(self, frame: Frame, prediction: Prediction, cameras: PosedCameras) -> None:
        self._log_pillars(frame, prediction, cameras)
        if prediction.segmentation is not None:
            log_bev.log_segmentation(self._stream, prediction.segmentation, prediction.ego_from_bev)
        if self._bev_images is not None and prediction.bev is not None:
            grid = prediction.grid
            features = prediction.bev.detach().float().cpu().numpy().reshape(grid.rows, grid.columns, -1)
            self._log_bev_images(self._bev_images.push((frame.stamp, prediction), features))
            self._at(frame.stamp)
        if (attention := prediction.attention) is None:
            return
        log_bev.log_history(self._stream, attention.history_weight, prediction.grid)
        log_bev.log_probes(self._stream, attention.probes, prediction.ego_from_bev, prediction.grid)
        for posed in cameras if attention.probes else ():
            samples = [p.cameras[posed.name] for p in attention.probes if posed.name in p.cameras]
            log_cameras.log_samples(self._stream, posed, samples)

    def _log_bev_images(self, ready: list[tuple[tuple[FrameStamp, Prediction], np.ndarray]]) -> None:
        for (stamp, prediction), image in ready:
            self._at(stamp)
            log_bev.log_features(self._stream, image, prediction.grid, prediction.ego_from_bev)

    def _log_pillars(self, frame: Frame, prediction: Prediction, cameras: PosedCameras) -> None:
        if self._pillars is None:
            grid, all_cells = prediction.grid, self._options.level == "full"
            self._pillars = log_static.log_pillars(self._stream, grid, prediction.ego_from_bev, all_cells=all_cells)
        pillars, colors = self._pillars
        points = apply(self._world_from_bev(prediction), pillars)
        for posed in cameras:
            if posed.name in frame.images:
                log_cameras.log_pillar_hits(self._stream, posed, points, colors)
