"""recording.rrd of a rig: poses, images, lines in them; of a calibration check also pillars, coverage and findings."""

import contextlib
from collections.abc import Iterable, Iterator, Mapping
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
from bevcli.recording.colors import BACKGROUND
from bevcli.rig import overlay
from bevcli.rig.coverage import Coverage
from bevcli.rig.drawings import COUNT_COLORS
from bevcli.rig.mounting import horizon
from bevcli.rig.overlay import PILLAR_GRID, Pixels, visible_runs
from bevcli.rig.rig_report import RigReport
from bevcli.writing import whole_file

COVERAGE, COVERAGE_ON_GROUND, FINDINGS = "coverage", f"{entities.EGO}/coverage", "findings"
PIXELS_PER_CELL = 6
JPEG_QUALITY = 90
Lines = tuple[list[Array], tuple[int, ...], float]  # strips (P, 2) in pixels, colour, width in points of the screen


def write_rig_recording(path: Path, rig: CameraRig, report: RigReport, images: Mapping[str, Pixels]) -> None:
    """Write the recording. images: by camera, (H, W, 3) BGR; any may be missing. Raises OutputError."""
    with rig_recording(path, "bevcli-project-debug", rig, _layout(rig)) as stream:
        _log_scene(stream, rig, report.coverage)
        for camera in rig.cameras:
            _log_camera(stream, camera, rig.ego_from_bev, images.get(camera.name))
        stream.set_time(entities.FRAME_TIMELINE, sequence=0)  # `bevcli viz` expects this timeline
        stream.log(FINDINGS, rr.TextDocument(_findings_markdown(report), media_type="text/markdown"))


def _findings_markdown(report: RigReport) -> str:
    """The findings and the comparison with nuScenes, as Markdown."""
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


def _log_scene(stream: rr.RecordingStream, rig: CameraRig, coverage: Coverage) -> None:
    points = apply(rig.ego_from_bev, PILLAR_GRID.pillars()).reshape(-1, 3)
    colors = np.tile(overlay.height_colors(), (PILLAR_GRID.rows * PILLAR_GRID.columns, 1))
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
    stream.log(entities.camera(camera.name), log_cameras.transform(camera.ego_from_camera), static=True)
    if pixels is not None:
        log_image(stream, camera.name, pixels)
    points, distances, colors = overlay.pillars_in(camera, ego_from_bev)
    radii = np.clip(60 / np.maximum(distances, 1e-3), 1.2, 6) * camera.width / 800
    dots = rr.Points2D(points, colors=colors, radii=radii, draw_order=30)
    stream.log(entities.overlay(camera.name, "pillars"), dots, static=True)
    lines: dict[str, Lines] = {
        "ground_grid": (overlay.ground_lines(camera), (*overlay.GROUND, 120), 0.6),
        "pillar_lines": (overlay.pillar_lines(camera, ego_from_bev), (235, 238, 245, 90), 0.6),
        "horizon": (visible_runs(horizon(camera)), overlay.HORIZON, 1.0),
    }
    log_lines(stream, camera, lines, static=True)


def _layout(rig: CameraRig) -> Layout:
    overlays = ("pillars", "ground_grid", "pillar_lines", "horizon")
    seen = rrb.Spatial2DView(origin=COVERAGE, name="Cameras per BEV cell", background=list(BACKGROUND))
    findings = rrb.TextDocumentView(origin=FINDINGS, name="Findings")
    middle = rrb.Horizontal(rig_view(rig, overlays), seen, findings, column_shares=[4, 3, 4])
    rows = camera_views(rig)
    views = rrb.Vertical(*rows[:1], middle, *rows[1:], row_shares=[3, 5, 3][: len(rows) + 1])
    return Layout(views, rrb.TimePanel(state="hidden"))


@contextlib.contextmanager
def rig_recording(path: Path, application: str, rig: CameraRig, layout: Layout) -> Iterator[rr.RecordingStream]:
    """A recording with the vehicle and the rig's pinholes; the layout is freed. Raises OutputError."""
    with whole_file(path) as own, plain_name(own) as unfinished, rr.RecordingStream(application) as stream:
        try:
            stream.save(unfinished, default_blueprint=layout)
        except RuntimeError as error:
            raise OutputError(f"{path}: the recording cannot be written ({error})") from error
        finally:
            layout.free()
        log_static.log_scene(stream, rig, {})
        yield stream


def log_image(stream: rr.RecordingStream, name: str, pixels: Pixels) -> None:
    """Writes the image of a camera. pixels: (H, W, 3) BGR."""
    encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    stream.log(entities.image(name), rr.EncodedImage(contents=encoded, media_type="image/jpeg"), static=True)


def log_lines(stream: rr.RecordingStream, camera: Camera, lines: Mapping[str, Lines], *, static: bool) -> None:
    """Writes lines of several kinds into the image of a camera."""
    for kind, (strips, color, width) in lines.items():
        inside = [strip for line in strips for strip in _clipped(line, camera)]
        archetype = rr.LineStrips2D(inside, colors=color, radii=rr.Radius.ui_points(width), draw_order=20)
        stream.log(entities.overlay(camera.name, kind), archetype, static=static)


def _clipped(line: Array, camera: Camera) -> list[Array]:
    """The parts of a line (P, 2) inside the image. The viewer does not clip lines."""
    size = np.array([camera.width, camera.height])
    inside = ((line >= 0) & (line <= size)).all(axis=-1, keepdims=True)
    return visible_runs(np.where(inside, line, np.nan))


def rig_view(rig: CameraRig, overlays: Iterable[str]) -> rrb.Spatial3DView:
    """The rig from behind. overlays: kinds of drawings in the images, which it leaves out."""
    return rrb.Spatial3DView(
        origin=entities.EGO,
        contents=[
            f"/{entities.WORLD}/**",
            *(f"- /{entities.overlay(name, kind)}/**" for name in rig.names for kind in overlays),
        ],
        name="The rig",
        background=list(BACKGROUND),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=(-5.5, 0.0, 4.5), look_target=(0.9, 0.0, 0.8), eye_up=(0, 0, 1)),
    )


def camera_views(rig: CameraRig) -> list[rrb.Horizontal]:
    """The images of the cameras, in rows."""
    return [rrb.Horizontal(*(_camera_view(rig[name]) for name in row)) for row in camera_rows(rig)]


def _camera_view(camera: Camera) -> rrb.Spatial2DView:
    return flat_view(entities.camera(camera.name), camera.name, (0, camera.width), (0, camera.height))
