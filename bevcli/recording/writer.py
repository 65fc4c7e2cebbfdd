"""Recording: writes what the model saw and said, frame by frame, into a file that survives a crash."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

import numpy as np
import rerun as rr

from bevcli.errors import OutputError
from bevcli.frame import Frame, FrameStamp, Prediction
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Array, inverse, rigid
from bevcli.recording import entities, log_bev, log_boxes, log_cameras, static_scene
from bevcli.recording.about import about_text
from bevcli.recording.bev_images import BevImages
from bevcli.recording.blueprint import recording_blueprint
from bevcli.recording.colors import EGO_COLOR, STAGE_COLORS, class_color
from bevcli.recording.matching import detectable, true_positives
from bevcli.recording.options import RecordingOptions
from bevcli.recording.pillars import drawn_pillars
from bevcli.viewer.live import LiveView

APPLICATION = "bevcli"
FLUSH_TIMEOUT_S = 20.0
UNTRAINED = "untrained weights"


class Recording:
    """`with Recording(...) as recording: recording.log(frame, prediction)`, once a frame, in order.

    Each frame is on the disk when `log` returns. Raises OutputError when the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        *,
        rig: CameraRig,
        class_names: Sequence[str],
        title: str,
        untrained: bool,
        options: RecordingOptions | None = None,
    ) -> None:
        self.path, self.rig, self.title, self.untrained = Path(path), rig, title, untrained
        self.class_names = tuple(class_names)
        self.options = RecordingOptions() if options is None else options
        self._stream = rr.RecordingStream(APPLICATION)
        self._live = LiveView() if self.options.live else None
        self._origin: Array | None = None
        self._last: Frame | None = None
        self._early_events: list[tuple[str, str]] = []  # said before there was a frame to say it at
        self._pillars: Array | None = None
        wanted = self.options.bev != "none" and self.options.shows_insides
        self._bev_images: BevImages[tuple[FrameStamp, Prediction]] | None = None
        if wanted:
            self._bev_images = BevImages(self.options.bev)

    def __enter__(self) -> Recording:
        note = UNTRAINED if self.untrained else ""
        blueprint = recording_blueprint(self.rig, note, probes=bool(self.options.probes))
        self._stream.__enter__()
        sinks = [] if self._live is None else [self._live.sink]
        try:
            self._stream.set_sinks(rr.FileSink(self.path), *sinks, default_blueprint=blueprint)
        except RuntimeError as error:
            raise OutputError(f"{self.path}: the recording cannot be written ({error})") from error
        if self._live is not None:
            self._live.open()
        static_scene.log_static(self._stream, self.rig, self.class_names)
        self._log_about()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bev_images is not None:
            self._log_bev_images(self._bev_images.finish())
        self._stream.__exit__(kind, error, trace)
        if self._live is not None:
            self._live.close()

    def log(self, frame: Frame, prediction: Prediction) -> None:
        """Writes one frame: what was seen, the boxes at or above the score, and what the attention did."""
        self._start_or_follow(frame)
        self._at(frame.stamp)
        shots = self._log_cameras(frame)
        self._log_boxes(frame, prediction, shots)
        self._log_curves(prediction)
        self._log_frame_events(frame, prediction)
        if self.options.shows_insides:
            self._log_insides(frame, prediction, shots)
        self._last = frame
        self._flush()

    def event(self, text: str, level: str = "INFO") -> None:
        """Writes a line into the log of events, at the newest frame, or the first. level: "INFO", "WARN" or "ERROR"."""
        if self._origin is None:
            self._early_events.append((text, level))
        else:
            self._stream.log(entities.EVENTS, rr.TextLog(text, level=level))

    def _log_about(self) -> None:
        text = about_text(self.title, self.rig, self.options, untrained=self.untrained)
        facts = rr.AnyValues(
            title=self.title,
            untrained=self.untrained,
            score=self.options.score,
            class_names=list(self.class_names),
            camera_names=list(self.rig.names),
        )
        self._stream.log(entities.RUN, rr.TextDocument(text, media_type="text/markdown"), facts, static=True)

    def _at(self, stamp: FrameStamp) -> None:
        self._stream.set_time(entities.FRAME_TIMELINE, sequence=stamp.index)
        self._stream.set_time(entities.TIME_TIMELINE, timestamp=np.datetime64(stamp.timestamp_ns, "ns"))

    def _flush(self) -> None:
        try:
            self._stream.flush(timeout_sec=FLUSH_TIMEOUT_S)
        except (RuntimeError, ValueError, TimeoutError) as error:
            raise OutputError(f"{self.path}: the recording cannot be written ({error})") from error

    def _start_or_follow(self, frame: Frame) -> None:
        """Places the frame: the recording's world is the drive's, moved to where the first frame's vehicle stands."""
        if self._origin is None:
            self._origin = frame.world_from_ego.matrix[:3, 3].copy()
            self._stream.log(entities.WORLD, rr.AnyValues(origin=self._origin), static=True)
        self._at(frame.stamp)
        pose = self._in_recording(frame.world_from_ego.matrix)
        self._stream.log(
            entities.EGO,
            rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]),
            rr.AnyValues(scene=frame.stamp.scene, timestamp_ns=frame.stamp.timestamp_ns, pose=pose.ravel()),
        )
        before = self._last
        if before is not None and before.stamp.scene == frame.stamp.scene:
            way = [self._in_recording(f.world_from_ego.matrix)[:3, 3] for f in (before, frame)]
            self._stream.log(entities.TRAJECTORY, rr.LineStrips3D([way], colors=EGO_COLOR, radii=0.06))

    def _in_recording(self, world_from_a: Array) -> Array:
        return rigid(-(self._origin if self._origin is not None else np.zeros(3))) @ world_from_a

    def _log_cameras(self, frame: Frame) -> tuple[log_cameras.CameraShot, ...]:
        shots = tuple(
            log_cameras.CameraShot(c, self._in_recording(frame.world_from_ego_at[c.name].matrix) @ c.ego_from_camera)
            for c in frame.rig.cameras
        )
        for shot in shots:
            log_cameras.log_image(self._stream, shot, frame.images.get(shot.camera.name))
        return shots

    def _log_boxes(self, frame: Frame, prediction: Prediction, shots: tuple[log_cameras.CameraShot, ...]) -> None:
        shown = shown_boxes(prediction.boxes, self.options.score)
        world_from_bev = self._in_recording(prediction.world_from_ego.matrix) @ prediction.ego_from_bev
        in_world = shown.transformed(world_from_bev)
        true = np.ones(len(shown), dtype=bool)
        if frame.ground_truth is not None:
            in_recording = frame.ground_truth.transformed(self._in_recording(np.eye(4)))
            truth = detectable(in_recording.transformed(inverse(world_from_bev)), prediction.grid)
            if self.untrained:  # nothing can be found or missed: a scene all in red would say nothing
                found = np.ones(len(truth), dtype=bool)
            else:
                true, found = true_positives(shown, truth)
            self._log_ground_truth(truth, found, world_from_bev, shots)
        stream, names = self._stream, self.class_names
        ego_xy = self._in_recording(prediction.world_from_ego.matrix)[:2, 3]
        log_boxes.log_boxes_3d(stream, in_world, ~true, names, ego_xy)
        log_boxes.log_boxes_bev(stream, shown, ~true, names)
        for shot in shots:
            log_cameras.log_boxes_in_image(stream, shot, in_world, names)
        counts = [float((shown.classes == name).sum()) for name in names]
        stream.log(entities.BOX_CURVES, rr.Scalars(counts))

    def _log_ground_truth(
        self, truth: Boxes3D, found: np.ndarray, world_from_bev: Array, shots: tuple[log_cameras.CameraShot, ...]
    ) -> None:
        in_world = truth.transformed(world_from_bev)
        log_boxes.log_ground_truth_3d(self._stream, in_world, found)
        log_boxes.log_ground_truth_bev(self._stream, truth, found)
        for shot in shots:
            log_cameras.log_ground_truth_in_image(self._stream, shot, in_world, found)

    def _log_curves(self, prediction: Prediction) -> None:
        stages = prediction.stage_seconds
        if self._last is None:
            self._name_curves(stages)
        self._stream.log(entities.STAGE_CURVES, rr.Scalars(list(stages.values())))

    def _name_curves(self, stages: Mapping[str, float]) -> None:
        stage_colors = [STAGE_COLORS[place % len(STAGE_COLORS)] for place in range(len(stages))]
        self._stream.log(entities.STAGE_CURVES, rr.SeriesLines(names=list(stages), colors=stage_colors), static=True)
        colors = [class_color(name, place) for place, name in enumerate(self.class_names)]
        lines = rr.SeriesLines(names=list(self.class_names), colors=colors)
        self._stream.log(entities.BOX_CURVES, lines, static=True)

    def _log_frame_events(self, frame: Frame, prediction: Prediction) -> None:
        if self._last is None and self.untrained:
            self.event("The weights are UNTRAINED: boxes and maps mean nothing.", "WARN")
        while self._early_events:
            self.event(*self._early_events.pop(0))
        if prediction.started_anew:
            self.event(f"frame {frame.stamp.index}: {self._why_anew(frame.stamp)}; the model starts without history")
        for camera, reason in frame.dropped.items():
            self.event(f"frame {frame.stamp.index}: camera {camera} is missing: {reason}", "WARN")
        if prediction.skipped:
            self.event(f"frame {frame.stamp.index}: no image at all, the model was not asked", "WARN")

    def _why_anew(self, stamp: FrameStamp) -> str:
        before = None if self._last is None else self._last.stamp
        if before is None:
            return f'scene "{stamp.scene}" begins' if stamp.scene else "the drive begins"
        if before.scene != stamp.scene:
            return f'scene change from "{before.scene}" to "{stamp.scene}"'
        return f"{(stamp.timestamp_ns - before.timestamp_ns) / 1e9:.1f} s since the last frame"

    def _log_insides(
        self,
        frame: Frame,
        prediction: Prediction,
        shots: tuple[log_cameras.CameraShot, ...],
    ) -> None:
        self._log_pillars(frame, prediction, shots)
        if prediction.segmentation is not None:
            log_bev.log_segmentation(self._stream, prediction.segmentation)
        if self._bev_images is not None and prediction.bev is not None:
            grid = prediction.grid
            features = prediction.bev.detach().float().cpu().numpy().reshape(grid.rows, grid.columns, -1)
            placed = (frame.stamp, prediction)
            self._log_bev_images(self._bev_images.push(placed, features))
            self._at(frame.stamp)
        self._log_attention(prediction, shots)

    def _log_bev_images(self, ready: list[tuple[tuple[FrameStamp, Prediction], np.ndarray]]) -> None:
        for (stamp, prediction), image in ready:
            self._at(stamp)
            log_bev.log_features(self._stream, image, prediction.grid, prediction.ego_from_bev)

    def _log_pillars(self, frame: Frame, prediction: Prediction, shots: tuple[log_cameras.CameraShot, ...]) -> None:
        if self._pillars is None:
            self._pillars = drawn_pillars(prediction.grid, everything=self.options.level == "full")
            static_scene.log_pillars(self._stream, prediction.grid, prediction.ego_from_bev, self._pillars)
        colors = static_scene.pillar_colors(prediction.grid, len(self._pillars))
        world_from_bev = self._in_recording(prediction.world_from_ego.matrix) @ prediction.ego_from_bev
        points = self._pillars.reshape(-1, 3) @ world_from_bev[:3, :3].T + world_from_bev[:3, 3]
        for shot in shots:
            if shot.camera.name in frame.images:
                log_cameras.log_pillar_hits(self._stream, shot, points, colors)

    def _log_attention(self, prediction: Prediction, shots: tuple[log_cameras.CameraShot, ...]) -> None:
        attention = prediction.attention
        if attention is None:
            return
        log_bev.log_history(self._stream, attention.history_weight, prediction.grid)
        log_bev.log_probes(self._stream, attention.probes, prediction.ego_from_bev, prediction.grid)
        for shot in shots if attention.probes else ():
            samples = [p.cameras[shot.camera.name] for p in attention.probes if shot.camera.name in p.cameras]
            log_cameras.log_samples(self._stream, shot, samples)


def shown_boxes(boxes: Boxes3D, score: float) -> Boxes3D:
    """The boxes at or above a score; all where there are no scores."""
    return boxes if boxes.scores is None else boxes[boxes.scores >= score]
