"""calibration.png and recording.rrd: what each camera sees, with the stated and with the measured calibration."""

from pathlib import Path

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from bevcli.geometry.cameras import CameraRig
from bevcli.recording import entities, log_cameras
from bevcli.recording.blueprint import Layout
from bevcli.rig.drawings import FAINT, INK, PAPER, save
from bevcli.rig.mounting import horizon
from bevcli.rig.overlay import GROUND, HORIZON, draw_lines, ground_lines, visible_runs
from bevcli.rig.rig_recording import Lines, camera_views, log_image, log_lines, rig_recording, rig_view
from bevcli.workshop.calibration.estimates import CameraEstimate, Verdict, change_text
from bevcli.workshop.calibration.measure import Measurement

ROW_INCHES, WIDTH_INCHES = 2.9, 15.0
POINT, LINE = (255, 120, 90), (110, 200, 255)  # RGB
COLORS = {Verdict.FINE: "#7fd6a0", Verdict.CORRECTED: "#ffd640", Verdict.NOT_MEASURABLE: "#ff8080"}
HEADINGS = (
    "stated: matched points (red), their epipolar lines (blue)",
    "measured: ground grid (green), horizon (yellow)",
    "stated minus measured, 3 deviations",
)
TABLE = "calibration"  # in the recording


def write_sheet(path: Path, measurement: Measurement, cameras: tuple[CameraEstimate, ...]) -> None:
    """Write the sheet as a PNG, one row a camera. Raises OutputError."""
    height = ROW_INCHES * len(cameras) + 0.6
    figure = Figure(figsize=(WIDTH_INCHES, height), dpi=90, facecolor=PAPER)
    for left, text in zip((0.05, 0.43, 0.82), HEADINGS, strict=True):
        figure.text(left, 1 - 0.15 / height, text, color=INK, fontsize=11, va="top")
    for row, estimate in enumerate(cameras):
        bottom, size = 1 - (0.6 + ROW_INCHES * (row + 1)) / height, (ROW_INCHES - 0.45) / height
        for column in (0, 1):
            axes = figure.add_axes((0.01 + 0.38 * column, bottom + 0.1 / height, 0.37, size))
            _draw_image(axes, measurement, row, measured=column == 1)
        figure.text(0.01, bottom + size + 0.13 / height, _title(estimate), color=COLORS[estimate.verdict], fontsize=10)
        axes = figure.add_axes((0.82, bottom + 0.45 / height, 0.16, size - 0.4 / height))
        _draw_ellipse(axes, estimate)
    save(figure, path)


def _title(estimate: CameraEstimate) -> str:
    text = estimate.reason or change_text(estimate)
    return f"{estimate.camera}: {estimate.verdict.value}; {text}"


def _draw_image(axes: Axes, measurement: Measurement, index: int, *, measured: bool) -> None:
    """The image with the ground grid and the horizon, matched points, and pieces of their epipolar lines."""
    axes.set(xticks=[], yticks=[])
    grey, camera = measurement.image(index), measurement.camera(index, measured=measured)
    blank = np.full((camera.height, camera.width), 40, dtype=np.uint8)
    canvas = np.repeat((blank if grey is None else grey)[..., None], 3, axis=-1)
    draw_lines(canvas, ground_lines(camera), GROUND, 1)
    draw_lines(canvas, visible_runs(horizon(camera)), HORIZON, 2)
    for point, pieces in measurement.shown_matches(index, measured=measured):
        draw_lines(canvas, pieces, LINE, 2)
        cv2.circle(canvas, (round(point[0]), round(point[1])), 4, POINT, -1, cv2.LINE_AA)
    axes.imshow(canvas)


def _draw_ellipse(axes: Axes, estimate: CameraEstimate) -> None:
    """Yaw and pitch, with the ellipse of three standard deviations."""
    axes.set_facecolor(PAPER)
    yaw, pitch, _ = estimate.rotation_deg
    covariance = np.degrees(np.degrees(estimate.covariance[:2, :2]))[::-1, ::-1] * [[1, -1], [-1, 1]]
    sizes, turns = np.linalg.eigh(covariance)
    angle = float(np.degrees(np.arctan2(turns[1, 1], turns[0, 1])))
    width, height = 6 * np.sqrt(sizes[::-1])
    axes.add_patch(Ellipse((yaw, pitch), width, height, angle=angle, color=COLORS[estimate.verdict], alpha=0.5))
    axes.plot([0, yaw], [0, pitch], color=INK, linewidth=1)
    axes.plot([0], [0], "+", color=INK)
    reach = 1.2 * max(abs(yaw), abs(pitch), width, height, 0.3)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
    axes.set_xlabel("yaw, degrees", color=FAINT, fontsize=8, labelpad=1)
    axes.set_ylabel("pitch, degrees", color=FAINT, fontsize=8, labelpad=1)
    axes.tick_params(colors=FAINT, labelsize=7)
    axes.grid(color=FAINT, alpha=0.25)


def write_calibration_recording(path: Path, measurement: Measurement, table: str) -> None:
    """Write the recording: frame 0 shows the stated calibration, frame 1 the measured one. Raises OutputError.

    table: the text of the result.
    """
    rig = measurement.views.rig
    with rig_recording(path, "bevcli-calibrate", rig, _layout(rig)) as stream:
        text = rr.TextDocument(f"```\n{table}\n```", media_type="text/markdown")
        stream.log(TABLE, text, static=True)
        for index in range(len(rig.cameras)):
            _log_image(stream, measurement, index)
        for step in (0, 1):
            stream.set_time(entities.FRAME_TIMELINE, sequence=step)
            for index in range(len(rig.cameras)):
                _log_camera(stream, measurement, index, measured=step == 1)


def _log_image(stream: rr.RecordingStream, measurement: Measurement, index: int) -> None:
    """What both calibrations share: the image and its matched points."""
    name, pixels = measurement.views.rig.names[index], measurement.image(index)
    if pixels is None:
        return
    log_image(stream, name, pixels)
    points = [point for point, _ in measurement.shown_matches(index, measured=True)]
    dots = rr.Points2D(points, colors=POINT, radii=rr.Radius.ui_points(2.5), draw_order=30)
    stream.log(entities.overlay(name, "matches"), dots, static=True)


def _log_camera(stream: rr.RecordingStream, measurement: Measurement, index: int, *, measured: bool) -> None:
    """Pose, epipolar lines, ground grid and horizon by one of the two calibrations."""
    camera, matches = measurement.camera(index, measured=measured), measurement.shown_matches(index, measured=measured)
    stream.log(entities.camera(camera.name), log_cameras.transform(camera.ego_from_camera))
    pieces = [piece for _, lines in matches for piece in lines]
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
