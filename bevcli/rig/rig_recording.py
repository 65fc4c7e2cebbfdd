"""recording.rrd of a calibration check: poses, images with pillars and lines, coverage and findings."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.colors import to_rgb

from bevcli.errors import OutputError
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import Array, apply
from bevcli.parsing.files import plain_name
from bevcli.recording import entities, log_cameras, log_static
from bevcli.recording.blueprint import Layout, camera_rows, flat_view
from bevcli.recording.components import log
from bevcli.rig.drawings import (
    COUNT_COLORS,
    GROUND,
    HORIZON,
    PILLAR_GRID,
    Pixels,
    ground_lines,
    height_colors,
    horizon,
    pillar_lines,
    pillars_in,
    visible_runs,
)
from bevcli.rig.rig_report import Coverage, RigReport
from bevcli.writing import whole_file

COVERAGE, COVERAGE_ON_GROUND, FINDINGS = "coverage", f"{entities.EGO}/coverage", "findings"
PIXELS_PER_CELL = 6
JPEG_QUALITY = 90
OVERLAYS = ("pillars", "ground_grid", "pillar_lines", "horizon")


def write_rig_recording(path: Path, rig: CameraRig, report: RigReport, images: Mapping[str, Pixels]) -> None:
    """Write the recording. images: by camera, (H, W, 3) BGR; any may be missing. Raises OutputError."""
    layout = _layout(rig)
    with whole_file(path) as own, plain_name(own) as unfinished, rr.RecordingStream("bevcli-project-debug") as stream:
        try:
            stream.save(unfinished, default_blueprint=layout)
        except RuntimeError as error:
            raise OutputError(f"{path}: the recording cannot be written ({error})") from error
        finally:
            layout.free()
        log_static.log_scene(stream, rig, {})
        _log_coverage(stream, rig, report.coverage)
        for camera in rig.cameras:
            _log_camera(stream, camera, rig.ego_from_bev, images.get(camera.name))
        stream.set_time(entities.FRAME_TIMELINE, sequence=0)  # `bevcli viz` expects this timeline
        stream.log(FINDINGS, rr.TextDocument(_findings_markdown(report), media_type="text/markdown"))


def _findings_markdown(report: RigReport) -> str:
    lines = ["## Findings", ""]
    for finding in report.findings:
        where = f"`{finding.camera}` " if finding.camera else ""
        lines.append(f"- **{finding.severity}** {where}{finding.message}.")
        stated = (("found", finding.found), ("expected", finding.expected))
        numbers = [f"{word} {value}" for word, value in stated if value]
        lines += [f"    - {text}" for text in (", ".join(numbers), finding.advice) if text]
    if not report.findings:
        lines.append("None: the rig is plausible.")
    if report.measures:
        lines += ["", "## Comparison with nuScenes", "", "| | this rig | nuScenes |", "|---|---|---|"]
        lines += [f"| {m.name} | {m.value} | {m.reference} |" for m in report.measures]
    return "\n".join(lines)


def _log_coverage(stream: rr.RecordingStream, rig: CameraRig, coverage: Coverage) -> None:
    points = apply(rig.ego_from_bev, PILLAR_GRID.pillars()).reshape(-1, 3)
    colors = np.tile(height_colors(), (PILLAR_GRID.rows * PILLAR_GRID.columns, 1))
    stream.log(entities.PILLARS, rr.Points3D(points, colors=colors, radii=rr.Radius.ui_points(1.5)), static=True)
    by_count = np.array([to_rgb(color) for color in COUNT_COLORS])
    image = np.round(255 * by_count[np.minimum(coverage.counts, 4)][::-1]).astype(np.uint8)  # first row: largest y
    large = np.kron(image, np.ones((PIXELS_PER_CELL, PIXELS_PER_CELL, 1), dtype=np.uint8))
    stream.log(COVERAGE, rr.Image(large, color_model="RGB"), static=True)
    (x0, x1), (y0, y1) = coverage.grid.x_range_m, coverage.grid.y_range_m
    corners = apply(rig.ego_from_bev, [(x0, y1, 0), (x1, y1, 0), (x1, y0, 0), (x0, y0, 0)])
    corners[:, 2] = -0.05  # on the ground, slightly below the range rings
    quad = rr.Mesh3D(
        vertex_positions=corners,
        triangle_indices=[(0, 1, 2), (0, 2, 3)],
        vertex_texcoords=[(0, 0), (1, 0), (1, 1), (0, 1)],
        albedo_texture=large,
    )
    stream.log(COVERAGE_ON_GROUND, quad, static=True)


def _log_camera(stream: rr.RecordingStream, camera: Camera, ego_from_bev: Array, pixels: Pixels | None) -> None:
    log(stream, entities.camera(camera.name), log_cameras.transform(camera.ego_from_camera), static=True)
    if pixels is not None:
        encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
        image = rr.EncodedImage(contents=encoded, media_type="image/jpeg")
        stream.log(entities.image(camera.name), image, static=True)
    points, distances, colors = pillars_in(camera, ego_from_bev)
    radii = np.clip(60 / np.maximum(distances, 1e-3), 1.2, 6) * camera.width / 800
    dots = rr.Points2D(points, colors=colors, radii=radii, draw_order=30)
    stream.log(entities.overlay(camera.name, "pillars"), dots, static=True)
    for kind, lines, color, width in (
        ("ground_grid", ground_lines(camera), (*GROUND, 120), 0.6),
        ("pillar_lines", pillar_lines(camera, ego_from_bev), (235, 238, 245, 90), 0.6),
        ("horizon", visible_runs(horizon(camera)), HORIZON, 1.0),
    ):
        inside = [part for line in lines for part in _clipped(line, camera)]
        strips = rr.LineStrips2D(inside, colors=color, radii=rr.Radius.ui_points(width), draw_order=20)
        stream.log(entities.overlay(camera.name, kind), strips, static=True)


def _clipped(line: Array, camera: Camera) -> list[Array]:
    """The parts of a line (P, 2) inside the image. The viewer does not clip lines."""
    inside = ((line >= 0) & (line <= [camera.width, camera.height])).all(axis=-1, keepdims=True)
    return visible_runs(np.where(inside, line, np.nan))


def _layout(rig: CameraRig) -> Layout:
    overlays = [f"- /{entities.overlay(name, kind)}/**" for name in rig.names for kind in OVERLAYS]
    from_behind = rrb.EyeControls3D(position=(-5.5, 0.0, 4.5), look_target=(0.9, 0.0, 0.8), eye_up=(0, 0, 1))
    scene = rrb.Spatial3DView(
        origin=entities.EGO,
        contents=[f"/{entities.WORLD}/**", *overlays],
        name="The rig",
        background=list(entities.BACKGROUND),
        line_grid=False,
        eye_controls=from_behind,
    )
    seen = rrb.Spatial2DView(origin=COVERAGE, name="Cameras per BEV cell", background=list(entities.BACKGROUND))
    findings = rrb.TextDocumentView(origin=FINDINGS, name="Findings")
    middle = rrb.Horizontal(scene, seen, findings, column_shares=[4, 3, 4])
    rows = [rrb.Horizontal(*(_camera_view(rig[name]) for name in row)) for row in camera_rows(rig)]
    views = rrb.Vertical(*rows[:1], middle, *rows[1:], row_shares=[3, 5, 3][: len(rows) + 1])
    return Layout(views, rrb.TimePanel(state="hidden"))


def _camera_view(camera: Camera) -> rrb.Spatial2DView:
    return flat_view(entities.camera(camera.name), camera.name, (0, camera.width), (0, camera.height))
