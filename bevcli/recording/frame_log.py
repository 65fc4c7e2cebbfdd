"""The rows of each frame: poses, images, boxes, curves and events; then features, maps, probes, lines on the ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import BevMap, Frame, FrameStamp, GroundLines, Prediction, Probe, result_of
from bevcli.geometry.bev_grid import BevGrid, rectangle
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array, Pose, apply, inverse, rigid
from bevcli.recording import entities, log_boxes, log_cameras, log_static
from bevcli.recording.components import any_values, components, line_strips, log, rgb_format, ui_points
from bevcli.recording.log_cameras import ImageLayer, PosedCamera
from bevcli.recording.seen_map import SeenCells

Features = NDArray[np.float32]
PosedCameras = tuple[PosedCamera, ...]
FileBoxes = Sequence[Boxes3D | None]  # of each file, in the world frame; None where it lacks the frame
Ranges = tuple[tuple[float, float], tuple[float, float]]  # of x and of y, bev frame, metres
SPEED_LABEL_M = (1.35, 0.0, 3.2)  # in the ego frame: above the vehicle
FITTED_ON = 2  # frames
CELLS_FOR_FIT = 4000  # of each frame, evenly spaced
PERCENTILES = (1.0, 99.0)  # become the darkest and the brightest colour
GROUND_OPACITY = 110  # of 255: boxes, rings and the trajectory stay readable on the map
PROBE_COLOR: Color = (255, 80, 220)
BELOW_GROUND_M = 0.06  # the map is drawn below the ground, so that it does not flicker with the range rings
FUTURES_OPACITY, FUTURES_WIDTH = 230, 1.0  # of 255; points of the user interface
# Has all columns of tracks, so that the trails of the frame before are cleared.
NO_BOXES = replace(Boxes3D.empty(), scores=np.zeros(0), instances=np.zeros(0, np.str_))
ABOVE_GROUND = (0, 0, 0.04)  # metres, so that lines do not flicker with what lies on the ground


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
    tracks: log_boxes.TrackHistory = field(default_factory=log_boxes.TrackHistory)


@dataclass(frozen=True)
class _Place:
    """The frames of reference of one frame's boxes.

    Attributes:
        moved: (4, 4) from the sequence's world into the recording's world.
        pose: of the vehicle in the sequence's world.
        ego_from_bev: (4, 4).
    """

    moved: Array
    pose: Pose
    ego_from_bev: Array

    @property
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


class FrameLog:
    """Logs frames into a stream of rerun, in order. resume: the state from which the log goes on."""

    def __init__(self, stream: rr.RecordingStream, recorded: log_static.Recorded, resume: FrameLogState | None) -> None:
        self._stream, self._recorded = stream, recorded
        self._options, self._geo_origin = recorded.options, recorded.drive.facts.geo_origin
        self._kept = FrameLogState() if resume is None else deepcopy(resume)
        self._early_events: list[tuple[str, str]] = []  # logged before the first frame
        self._pillars: tuple[Array, NDArray[np.uint32]] | None = None  # of `log_pillars`
        self._seen_cells = SeenCells()
        self._with_meshes = [name for name, settings in recorded.object_classes.items() if settings.mesh]
        self._images = log_cameras.CameraImages(stream, self._options.images == "av1")
        draws_bev = self._options.bev != "none" and self._options.shows_internals
        # Its stamps are predictions.
        self._bev_images = BevImages(self._options.bev, self._kept.colors) if draws_bev else None

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
        """Logs what waits for later frames, and ends the video streams."""
        if self._bev_images is not None:
            self._log_bev_images(self._bev_images.finish())
        for encoder in self._images.encoders.values():
            encoder.close()

    def log(self, frame: Frame, found: Prediction | FileBoxes) -> None:
        """See `Recording.log`."""
        prediction = found if isinstance(found, Prediction) else None
        stream, is_first = self._stream, self._kept.world_from_ego is None
        if self._kept.origin is None:  # the recording's world frame has its origin at the first frame's ego position
            self._kept.origin = frame.world_from_ego.matrix[:3, 3].copy()
            stream.log(entities.WORLD, rr.AnyValues(origin=self._kept.origin), static=True)
        self._at(frame.stamp)
        moved = rigid(-self._kept.origin)  # from the sequence's world into the recording's world
        self._log_ego(frame, moved)
        poses = [moved @ frame.world_from_ego_at[c.name].matrix @ c.ego_from_camera for c in frame.rig.cameras]
        cameras = tuple(
            PosedCamera(camera, pose, inverse(pose)) for camera, pose in zip(frame.rig.cameras, poses, strict=True)
        )
        for posed in cameras:
            name = posed.camera.name
            log(stream, entities.camera(name), log_cameras.transform(posed.world_from_camera))
            self._images.log(name, frame.images.get(name))
        self._log_boxes(frame, found, moved, cameras)
        if is_first:
            counted = self._recorded.layers or self._recorded.classes
            lines = rr.SeriesLines(names=list(counted), colors=list(counted.values()))
            stream.log(entities.BOX_CURVES, lines, static=True)
            stream.log(entities.SPEED_CURVE, rr.SeriesLines(names="km/h", colors=entities.EGO_COLOR), static=True)
        if prediction is not None:
            if self._recorded.results:
                self._log_results(prediction, moved, cameras)
            self._log_stages(prediction, is_first=is_first)
        elif self._recorded.map_classes:
            self._log_map(frame.ground_truth_map, frame.rig.ego_from_bev)
        self._log_events(frame, found)
        if prediction is not None and self._options.shows_internals:
            self._log_internals(frame, prediction, moved, cameras)
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

    def _log_ego(self, frame: Frame, moved: Array) -> None:
        """Writes the ego pose, the speed (a curve and a label above the vehicle), the way since the frame before.

        moved: (4, 4) from the sequence's world into the recording's world.
        """
        stream, stamp = self._stream, frame.stamp
        pose = moved @ frame.world_from_ego.matrix
        facts = any_values(scene=stamp.scene, timestamp_ns=stamp.timestamp_ns, pose=pose.ravel())
        log(stream, entities.EGO, log_cameras.transform(pose) | facts)
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

    def _log_boxes(self, frame: Frame, found: Prediction | FileBoxes, moved: Array, cameras: PosedCameras) -> None:
        """Writes the boxes and the ground truth of a frame."""
        recorded, files = self._recorded, self._recorded.files
        if isinstance(found, Prediction):
            place = _Place(moved, found.world_from_ego, found.ego_from_bev)
            sides, grid = [found.boxes], found.grid
        else:
            place = _Place(moved, frame.world_from_ego, frame.rig.ego_from_bev)
            sides, grid = [place.in_bev(boxes) if boxes else NO_BOXES for boxes in found], None
        sides = [boxes.scored(self._options.score) for boxes in sides]
        truth = None if frame.ground_truth is None else place.in_bev(frame.ground_truth)
        truth = None if truth is None else log_boxes.detectable(truth, grid)
        if files is not None and not files.names:  # labels alone are drawn as boxes
            sides, truth = [truth or NO_BOXES], None
        marks = log_boxes.false_and_duplicate(sides[0], None)
        missed = np.zeros(0 if truth is None else len(truth), dtype=bool)
        is_known = isinstance(found, Prediction) or all(boxes is not None for boxes in found)
        # Random boxes match nothing: a scene all in red would be useless.
        if truth is not None and is_known and not recorded.layers and not recorded.model.untrained:
            marks = self._marks(sides[0], truth, place)
            missed = ~marks.found & ~log_boxes.other_classes(truth, recorded.classes)
        if recorded.layers:
            drawn = [self._log_layer(*layer, place) for layer in zip(recorded.layers.items(), sides, strict=True)]
            none = log_boxes.false_and_duplicate(NO_BOXES, None)
            log_boxes.log_boxes_3d(self._stream, NO_BOXES, np.zeros((0, 8, 3)), none, {}, [])
            counts = list(map(len, sides))
        else:
            drawn = [self._log_shown(frame.stamp, sides[0], marks, place)]
            counts = [(sides[0].classes == name).sum() for name in recorded.classes]
        if truth is not None:
            drawn.append(self._log_truth(truth, missed, place))
        log_cameras.log_boxes_in_images(self._stream, cameras, drawn)
        log(self._stream, entities.BOX_CURVES, components(rr.Scalars, scalars=np.array(counts)))

    def _marks(self, shown: Boxes3D, truth: Boxes3D, place: _Place) -> log_boxes.Marks:
        """The marks of boxes, both in the bev frame: of a model all over its grid, of a file where it is scored."""
        files = self._recorded.files
        if files is None:
            return log_boxes.false_and_duplicate(shown, truth)
        return log_boxes.marks_within(shown, truth, *(place.within(side, files.ranges_m) for side in (shown, truth)))

    def _log_truth(self, truth: Boxes3D, missed: NDArray[np.bool_], place: _Place) -> ImageLayer:
        """Writes ground truth (M, bev frame) into the scene and the BEV view; returns its drawing in the images."""
        other = log_boxes.other_classes(truth, self._recorded.classes)
        in_world, colors = truth.transformed(place.world_from_bev), log_boxes.ground_truth_colors(~missed, other)
        log_boxes.log_ground_truth(self._stream, in_world, truth.corners(), ~missed, colors)
        return ImageLayer("ground_truth", in_world.corners(), colors, width=0.6, order=20)

    def _log_layer(self, layer: tuple[str, Color], shown: Boxes3D, place: _Place) -> ImageLayer:
        """Writes the boxes of one of two models, a name and a colour; returns their drawing in the images."""
        (name, color), in_world = layer, shown.transformed(place.world_from_bev)
        texts = log_cameras.box_labels(shown)
        labels = place.labels(shown, texts, log_boxes.LABELS_IN_SCENE // 2)
        log_boxes.log_layer(self._stream, name, in_world, shown.corners(), color, labels)
        colors = np.tile(np.array(color, np.uint8), (len(shown), 1))
        return ImageLayer(entities.layer("", name)[1:], in_world.corners(), colors, texts)

    def _log_shown(self, stamp: FrameStamp, shown: Boxes3D, marks: log_boxes.Marks, place: _Place) -> ImageLayer:
        """Writes the boxes (N, bev frame) of one model, or labels alone; returns their drawing in the images."""
        stream, classes = self._stream, self._recorded.classes
        in_world, colors = shown.transformed(place.world_from_bev), log_boxes.box_colors(shown, classes)
        files = self._recorded.files
        is_label = files is not None and not files.names  # the names of labelled objects are long
        corners, texts = (
            in_world.corners(),
            log_cameras.box_labels(replace(shown, instances=None) if is_label else shown),
        )
        labels = place.labels(shown, texts, log_boxes.LABELS_IN_SCENE)
        log_boxes.log_boxes_3d(stream, in_world, corners, marks, classes, labels)
        for name in self._with_meshes:
            log_boxes.log_class_mesh(stream, name, in_world[in_world.classes == name])
        log_boxes.log_boxes_bev(stream, shown, shown.corners(), marks, colors)
        bev_from_world = inverse(place.world_from_bev)
        log_boxes.log_tracks(stream, self._kept.tracks, in_world, corners, colors, stamp, bev_from_world)
        if self._geo_origin is not None:
            centers = apply(place.pose.matrix @ place.ego_from_bev, shown.centers)
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

    def _log_results(self, prediction: Prediction, moved: Array, cameras: PosedCameras) -> None:
        """Writes the results and futures of a model that has further results."""
        score, moved_from_ego = self._options.score, moved @ prediction.world_from_ego.matrix
        world_from_bev = moved_from_ego @ prediction.ego_from_bev
        ground = replace(prediction.ground, world_from_ego=Pose.from_matrix(moved_from_ego))
        for kind, names in self._recorded.results.items():
            result = result_of(kind, prediction.results)
            lines = GroundLines() if result is None else result.drawn(ground, names, score)
            log_ground_lines(self._stream, kind.kind, lines, world_from_bev, cameras)
        shown = prediction.boxes.scored(score).transformed(world_from_bev)
        futures = future_lines(shown, self._recorded.classes)
        log_ground_lines(self._stream, entities.FUTURES, futures, world_from_bev, cameras)

    def _log_events(self, frame: Frame, found: Prediction | FileBoxes) -> None:
        if self._kept.world_from_ego is None and self._recorded.note in log_static.WARNINGS:
            self.event(log_static.WARNINGS[self._recorded.note], "WARN")
        where = f"frame {frame.stamp.index}"
        while self._early_events:
            self.event(*self._early_events.pop(0))
        if isinstance(found, Prediction) and found.started_anew:
            scene = f', scene "{frame.stamp.scene}"' if frame.stamp.scene else ""
            self.event(f"{where}: no history: {found.started_anew}{scene}")
        for camera, reason in frame.dropped.items():
            self.event(f"{where}: camera {camera} has no image: {reason}", "WARN")
        if isinstance(found, Prediction):
            if found.failure:
                self.event(f"{where}: {found.failure}", "ERROR" if found.not_finite else "WARN")
            return
        for name, boxes in zip(self._recorded.files.names if self._recorded.files else (), found, strict=True):
            if boxes is None:
                self.event(f"{where}: {name} does not have this frame", "WARN")

    def _log_internals(self, frame: Frame, prediction: Prediction, moved: Array, cameras: PosedCameras) -> None:
        """Writes pillars, segmentation, BEV features, history weights and probes."""
        stream, grid, ego_from_bev = self._stream, prediction.grid, prediction.ego_from_bev
        ranges = grid.x_range_m, grid.y_range_m
        if self._pillars is None:
            all_cells = self._options.level == "full"
            self._pillars = log_static.log_pillars(stream, grid, ego_from_bev, all_cells=all_cells)
        pillars, colors = self._pillars
        points = apply(moved @ prediction.world_from_ego.matrix @ ego_from_bev, pillars)
        for posed in cameras:
            if posed.camera.name in frame.images:
                log_cameras.log_pillar_hits(stream, posed, points, colors)
        if prediction.segmentation is not None:
            self._log_map(self._seen_cells.of(prediction.segmentation, frame, grid), ego_from_bev)
        if self._bev_images is not None and prediction.bev is not None:
            features = prediction.bev.detach().float().cpu().numpy().reshape(grid.rows, grid.columns, -1)
            self._log_bev_images(self._bev_images.push(prediction, features))
            self._at(frame.stamp)
        if (attention := prediction.attention) is None:
            return
        if attention.history_weight is None:  # no history was used
            stream.log(entities.BEV_HISTORY, rr.Clear(recursive=False))
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
            for entity in (flat, on_ground):
                self._stream.log(entity, rr.Clear(recursive=False))
            return
        painted = ground_map.painted(entities.map_colors(ground_map.classes), entities.BACKGROUND)
        of_map = ground_map.x_range_m, ground_map.y_range_m
        log_flat_image(self._stream, flat, painted, of_map, -5)
        log_on_ground(self._stream, on_ground, painted, of_map, ego_from_bev, 255)

    def _log_bev_images(self, ready: list[tuple[Prediction, NDArray[np.uint8]]]) -> None:
        for prediction, image in ready:
            self._at(prediction.stamp)
            ranges = prediction.grid.x_range_m, prediction.grid.y_range_m
            log_flat_image(self._stream, entities.BEV_FEATURES, image, ranges, -10)
            ground = entities.BEV_ON_GROUND
            log_on_ground(self._stream, ground, image, ranges, prediction.ego_from_bev, GROUND_OPACITY)


@dataclass(frozen=True)
class BevColors:
    """A fixed mapping from features to colours.

    Attributes:
        mean: (C,) subtracted from the features.
        basis: (C, K) projection, K 1 or 3; None takes the norm of the features (K 1).
        low: (K,) values that become 0.
        high: (K,) values that become 1.
    """

    mean: Features
    basis: Features | None
    low: Array
    high: Array

    def paint(self, features: Features) -> NDArray[np.uint8]:
        """Features (..., C) -> (..., 3) uint8 RGB."""
        values = _values(features, self.mean, self.basis)
        shares = np.clip((values - self.low) / np.maximum(self.high - self.low, 1e-9), 0, 1)
        if shares.shape[-1] == 1:
            return entities.colormap(shares[..., 0], "inferno")
        return (shares * 255).astype(np.uint8)


def fit_colors(kind: str, features: Features) -> BevColors:
    """Fits colours to features (cells, C). kind: "norm", "pca" or "channel:K".

    Raises InputError when the features have no channel K.
    """
    channels = features.shape[-1]
    mean: Features = np.zeros(channels, np.float32)
    basis: Features | None = None
    if kind == "pca":
        mean = features.mean(0)
        centered = features - mean
        basis = np.linalg.eigh(centered.T @ centered)[1][:, :-4:-1]  # the three largest, largest first
        signs = np.sign(basis[np.abs(basis).argmax(0), np.arange(basis.shape[1])])
        # The sign of an eigenvector is arbitrary: make its largest entry positive.
        basis = basis * np.where(signs == 0, 1, signs).astype(np.float32)
    elif kind.startswith("channel:"):
        chosen = int(kind.partition(":")[2])
        if chosen >= channels:
            raise InputError(f"`bev={kind}`: the BEV map has channels 0 to {channels - 1}")
        basis = np.eye(channels, dtype=np.float32)[:, chosen : chosen + 1]
    low, high = np.percentile(_values(features, mean, basis), PERCENTILES, axis=0)
    return BevColors(mean, basis, low, high)


@dataclass
class BevImages:
    """Takes the features of each frame; returns the images that are ready, each with the stamp of its frame.

    Attributes:
        kind: see `fit_colors`.
        colors: fitted on the first frames, None before. Setting them continues an interrupted recording.
        waiting: stamps and features of the frames whose images are not returned yet.
    """

    kind: str
    colors: BevColors | None = None
    waiting: list[tuple[Any, Features]] = field(default_factory=list)

    def push(self, stamp: Any, features: Features) -> list[tuple[Any, NDArray[np.uint8]]]:
        """Adds a frame; returns the images that are ready.

        features: (rows, columns, C); the first row has the smallest y. The images are (rows, columns, 3) uint8 RGB;
        their first row has the largest y.
        """
        self.waiting.append((stamp, features))
        return [] if self.colors is None and len(self.waiting) < FITTED_ON else self.finish()

    def finish(self) -> list[tuple[Any, NDArray[np.uint8]]]:
        """The images that are not returned yet: that of the first frame, where there was no second one."""
        if not self.waiting:
            return []
        if self.colors is None:
            cells = [features.reshape(-1, features.shape[-1]) for _, features in self.waiting]
            thinned = [of_frame[:: max(1, len(of_frame) // CELLS_FOR_FIT)] for of_frame in cells]
            self.colors = fit_colors(self.kind, np.concatenate(thinned))
        colors = self.colors
        ready = [(stamp, np.ascontiguousarray(colors.paint(features)[::-1])) for stamp, features in self.waiting]
        self.waiting = []
        return ready


def _values(features: Features, mean: Features, basis: Features | None) -> Features:
    if basis is None:
        return np.asarray(np.linalg.norm(features, axis=-1, keepdims=True), dtype=np.float32)
    return np.asarray((features - mean) @ basis, dtype=np.float32)


def log_flat_image(
    stream: rr.RecordingStream, entity: str, image: NDArray[np.uint8], ranges: Ranges, draw_order: float
) -> None:
    """Writes an image of the ground into the BEV view.

    image: (rows, columns, 3) RGB; the first row has the largest y.
    """
    (rows, columns, _), ((left, right), (low, high)) = image.shape, ranges
    cell = ((right - left) / columns, (high - low) / rows, 1.0)
    placed = components(rr.Transform3D, translation=(left, -high, 0), scale=cell)
    pixels = components(rr.Image, buffer=image.reshape(-1), format=rgb_format(columns, rows), draw_order=draw_order)
    log(stream, entity, pixels | placed)


def log_on_ground(
    stream: rr.RecordingStream, entity: str, image: NDArray[np.uint8], ranges: Ranges, ego_from_bev: Array, opacity: int
) -> None:
    """Writes an image of the ground, as in `log_flat_image`, as a rectangle in the scene."""
    corners = apply(ego_from_bev, rectangle(*ranges))
    corners[:, 2] = -BELOW_GROUND_M
    quad = components(
        rr.Mesh3D,
        vertex_positions=corners,
        triangle_indices=((0, 1, 2), (0, 2, 3)),
        vertex_texcoords=((0, 1), (1, 1), (1, 0), (0, 0)),
        albedo_texture_buffer=image.reshape(-1),
        albedo_texture_format=rgb_format(image.shape[1], image.shape[0]),
        albedo_factor=(255, 255, 255, opacity),
    )
    log(stream, entity, quad)


def log_probes(stream: rr.RecordingStream, probes: Sequence[Probe], ego_from_bev: Array, grid: BevGrid) -> None:
    """Marks the probed cells: with a dot in the BEV view, and with a pillar in the scene."""
    centers = np.array([probe.cell_center for probe in probes])
    dots = components(rr.Points2D, positions=centers * (1, -1), colors=PROBE_COLOR, radii=ui_points(5.0), draw_order=50)
    log(stream, entities.BEV_PROBES, dots)
    low, high = grid.pillar_heights()[[0, -1]]
    ends = np.stack([np.column_stack([centers, np.full(len(centers), z)]) for z in (low, high)], axis=1)
    strips = apply(ego_from_bev, ends).astype(np.float32)
    stream.log(entities.PROBES, rr.LineStrips3D(strips, colors=PROBE_COLOR, radii=0.05))


def future_lines(boxes: Boxes3D, classes: Mapping[str, Color]) -> GroundLines:
    """The futures of boxes in the recording's world: colours by class, opaque by score of the mode, faded in time."""
    if boxes.futures is None or not len(boxes):
        return GroundLines()
    feet = boxes.centers[:, 2] - boxes.sizes_lwh[:, 2] / 2
    places = np.concatenate([np.broadcast_to(boxes.centers[:, None, None, :2], (*boxes.futures.shape[:2], 1, 2)),
                             boxes.futures[..., 1:]], axis=2)  # (N, M, T + 1, 2)  # fmt: skip
    heights = np.broadcast_to(feet[:, None, None, None], (*places.shape[:3], 1))
    steps = np.concatenate([places, heights], axis=-1)
    modes = np.ones(boxes.futures.shape[:2]) if boxes.future_scores is None else boxes.future_scores
    share = modes / np.maximum(modes.max(1, keepdims=True), 1e-9)  # (N, M)
    fading = np.linspace(1, 0.25, boxes.futures.shape[2])
    strips, colors, of_class = [], [], log_boxes.box_colors(boxes, classes)
    for box, mode, step in np.ndindex(*boxes.futures.shape[:3]):
        piece = steps[box, mode, step : step + 2]
        if np.isfinite(piece).all():
            strips.append(piece)
            colors.append((*map(int, of_class[box][:3]), round(FUTURES_OPACITY * fading[step] * share[box, mode])))
    return GroundLines(strips, colors, FUTURES_WIDTH)


def log_ground_lines(
    stream: rr.RecordingStream, kind: str, lines: GroundLines, world_from_bev: Array, cameras: Sequence[PosedCamera]
) -> None:
    """Writes lines in the recording's world; without any, those of the frame before are cleared.

    kind: last part of their entities.
    """
    colors = np.array(lines.colors, np.uint8) if len(lines.colors) else None
    radii = ui_points(lines.width)
    points, lengths = np.concatenate([np.zeros((0, 3)), *lines.strips]), list(map(len, lines.strips))
    in_space = line_strips(points + ABOVE_GROUND, lengths)
    solid = components(rr.LineStrips3D, strips=in_space, colors=colors, radii=radii)
    log(stream, f"{entities.WORLD}/{kind}", solid)
    flat = line_strips(apply(inverse(world_from_bev), points)[:, :2] * (1, -1), lengths)
    from_above = components(rr.LineStrips2D, strips=flat, colors=colors, radii=radii, draw_order=24)
    log(stream, f"{entities.BEV}/{kind}", from_above)
    pieces = [np.stack([strip[:-1], strip[1:]], axis=1) for strip in lines.strips]
    ends = np.concatenate([np.zeros((0, 2, 3)), *pieces])
    owners = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    of_cameras = np.concatenate([apply(posed.camera_from_world, ends) for posed in cameras])
    counts = np.full(len(cameras), len(ends))
    parts = log_cameras.cut_to_images(of_cameras, np.tile(owners, len(cameras)), counts, cameras)
    own_colors = np.array(lines.colors, dtype=np.uint8).reshape(-1, 4)
    for posed, visible in zip(cameras, parts, strict=True):
        own = own_colors[visible.owners]
        strips = components(rr.LineStrips2D, strips=visible.segments, colors=own, radii=radii, draw_order=15)
        log(stream, entities.overlay(posed.camera.name, kind), strips)
