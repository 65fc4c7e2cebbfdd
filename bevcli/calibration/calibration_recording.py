"""recording.rrd of a calibration from motion: frame 0 shows the stated calibration, frame 1 the measured one."""

from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from bevcli.calibration.drawings import LINE, POINT
from bevcli.calibration.evidence import Evidence, epipolar_piece
from bevcli.geometry.cameras import CameraRig
from bevcli.recording import entities
from bevcli.recording.blueprint import Layout
from bevcli.rig.mounting import horizon
from bevcli.rig.overlay import GROUND, HORIZON, ground_lines, visible_runs
from bevcli.rig.recorded_rig import Lines, camera_views, log_image, log_lines, log_pose, rig_recording, rig_view

TABLE = "calibration"


def write_calibration_recording(path: Path, evidence: Evidence, table: str) -> None:
    """Write the recording. table: the text of the result. Raises OutputError."""
    rig = evidence.views.rig
    with rig_recording(path, "bevcli-calibrate", rig, _layout(rig)) as stream:
        text = rr.TextDocument(f"```\n{table}\n```", media_type="text/markdown")
        stream.log(TABLE, text, static=True)
        for index in range(len(rig.cameras)):
            _log_image(stream, evidence, index)
        for step in (0, 1):
            stream.set_time(entities.FRAME_TIMELINE, sequence=step)
            for index in range(len(rig.cameras)):
                _log_camera(stream, evidence, index, measured=step == 1)


def _log_image(stream: rr.RecordingStream, evidence: Evidence, index: int) -> None:
    """What both calibrations share: the image and its matched points."""
    name, pixels = evidence.views.rig.names[index], evidence.image(index)
    if pixels is None:
        return
    log_image(stream, name, pixels)
    points = evidence.matches(index, measured=True).pixels_b
    dots = rr.Points2D(points, colors=POINT, radii=rr.Radius.ui_points(2.5), draw_order=30)
    stream.log(entities.overlay(name, "matches"), dots, static=True)


def _log_camera(stream: rr.RecordingStream, evidence: Evidence, index: int, *, measured: bool) -> None:
    """Pose, epipolar lines, ground grid and horizon by one of the two calibrations."""
    camera, matches = evidence.camera(index, measured=measured), evidence.matches(index, measured=measured)
    log_pose(stream, camera, static=False)
    motion = matches.camera_b_from_camera_a
    pieces = [
        piece
        for ray, point in zip(matches.rays_a, matches.pixels_b, strict=True)
        for piece in epipolar_piece(camera, motion, ray, point)
    ]
    lines: dict[str, Lines] = {
        "epipolar_lines": (pieces, LINE, 1.2),
        "ground_grid": (ground_lines(camera), GROUND, 0.6),
        "horizon": (visible_runs(horizon(camera)), HORIZON, 1.0),
    }
    log_lines(stream, camera, lines, static=False)


def _layout(rig: CameraRig) -> Layout:
    scene = rig_view(rig, ("matches", "epipolar_lines", "ground_grid", "horizon"))
    middle = rrb.Horizontal(scene, rrb.TextDocumentView(origin=TABLE, name="Calibration"), column_shares=[2, 5])
    rows = camera_views(rig)
    return Layout(rrb.Vertical(*rows[:1], middle, *rows[1:]), rrb.TimePanel(state="collapsed"))
