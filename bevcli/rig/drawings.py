"""cameras.png: all images with pillars, ground grid and horizon, around the coverage map. coverage.png: the map alone.

recording.rrd has the same for the rerun viewer, with the findings. The overlay is drawn as the calibration projects it.
"""

import textwrap
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import BoundaryNorm, ListedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from bevcli.errors import Finding
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.parsing.images import encode_image
from bevcli.recording import entities, log_cameras, log_static
from bevcli.recording.blueprint import Layout, camera_rows, flat_view
from bevcli.recording.entities import GROUND_GRID_COLOR, HORIZON_COLOR, PILLAR_COLOR, colormap, log
from bevcli.rig.coverage import Coverage, Measure, pixels_in_image
from bevcli.rig.rig_checks import degrees_text, mounting_of, seen_fov_deg, seen_range_deg
from bevcli.viewer.drawing import FONT, Canvas, draw_lines
from bevcli.writing import whole_file

GRID_STEP_M, GRID_REACH_M = 5.0, 30.0
FINE_STEP_M, FINE_REACH_M = 1.0, 15.0  # of the grid in a large image, beside the other one
PILLAR_LINES_M = 25.0  # lines of farther pillars would be too dense
PILLAR_GRID = BevGrid(rows=20, columns=20)  # one pillar every 5.12 m; a denser grid would hide the image
LABELLED_M = (5.0, 10.0, 20.0, 40.0)
BACKDROP: Color = (44, 49, 58)


def pillars_in(camera: Camera, ego_from_bev: Array) -> tuple[Array, Array, NDArray[np.uint8]]:
    """The M pillar points that are inside the camera's image, the farthest first. ego_from_bev: (4, 4).

    Returns pixels (M, 2), distances (M,) in metres, and RGB (M, 3) by height.
    """
    points = apply(ego_from_bev, PILLAR_GRID.pillars()).reshape(-1, 3)
    pixels = pixels_in_image(camera, points)
    distances = np.linalg.norm(points - camera.ego_from_camera[:3, 3], axis=1)
    colors = np.tile(height_colors(), (PILLAR_GRID.rows * PILLAR_GRID.columns, 1))
    order = np.argsort(-distances)
    order = order[np.isfinite(pixels[order]).all(-1)]
    return pixels[order], distances[order], colors[order]


def height_colors() -> NDArray[np.uint8]:
    """(Z, 3) RGB, the colours of a pillar's points, the lowest first."""
    return colormap(np.linspace(0.12, 0.9, PILLAR_GRID.pillar_points), "turbo")


def ground_lines(camera: Camera, step_m: float = GRID_STEP_M, reach_m: float = GRID_REACH_M) -> list[Array]:
    """Lines (P, 2) in pixels of a grid on the ground around the ego origin, cut near the image border."""
    along = np.arange(-reach_m, reach_m + 0.05, 0.1)
    lines: list[Array] = []
    for offset in np.arange(-reach_m, reach_m + 0.1, step_m):
        across, flat = np.full_like(along, offset), np.zeros_like(along)
        for line in (np.stack([along, across, flat], axis=-1), np.stack([across, along, flat], axis=-1)):
            lines += visible_runs(_near_image(camera, line))
    return lines


def pillar_lines(camera: Camera, ego_from_bev: Array) -> list[Array]:
    """Lines (P, 2) in pixels from the lowest to the highest point of each pillar within 25 m."""
    pillars = PILLAR_GRID.pillars().reshape(-1, PILLAR_GRID.pillar_points, 3)
    low, high = pillars[:, :1], pillars[:, -1:]
    points = apply(ego_from_bev, low + np.linspace(0, 1, 24)[:, None] * (high - low))  # (Y X, 24, 3)
    near = np.linalg.norm(points[:, 0, :2] - camera.ego_from_camera[:2, 3], axis=-1) < PILLAR_LINES_M
    return [run for line in points[near] for run in visible_runs(_near_image(camera, line))]


def _near_image(camera: Camera, points_ego: Array) -> Array:
    """Points (P, 3) in the ego frame -> pixels (P, 2), NaN where they are more than an image size outside the image."""
    pixels, depth = camera.project_ego(points_ego)
    size = np.array([camera.width, camera.height])
    with np.errstate(invalid="ignore"):
        near = ((pixels > -size) & (pixels < 2 * size)).all(-1) & (depth > 0.1)
    return np.where(near[:, None], pixels, np.nan)


def horizon(camera: Camera) -> Array:
    """(P, 2) pixels of points 100 km away at the camera's own height; NaN where they are outside the image."""
    yaws = np.radians(np.arange(0, 360, 0.25))
    far = np.stack([np.cos(yaws), np.sin(yaws), np.zeros_like(yaws)], axis=-1) * 1e5
    pixels, depth = camera.project_ego(far + camera.ego_from_camera[:3, 3])
    seen = np.where(camera.contains(pixels, depth)[:, None], pixels, np.nan)
    start = int(np.argmax(depth < 0))  # start behind the camera, so that the line is not cut inside the image
    return np.roll(seen, -start, axis=0)


def visible_runs(pixels: Array) -> list[Array]:
    """A line (P, 2), split where it has NaN, into parts of two points or more."""
    seen = np.isfinite(pixels).all(-1)
    cuts = np.flatnonzero(np.diff(seen.astype(int))) + 1
    return [run for run in np.split(pixels, cuts) if len(run) > 1 and np.isfinite(run).all()]


def draw_overlay(
    camera: Camera, ego_from_bev: Array, image_bgr: Canvas | None, width: int, *, fine: bool = False
) -> Canvas:
    """The camera's image with the overlay, (h, width, 3) RGB.

    image_bgr: (H, W, 3); a dark image is used where it is None. width: of the result, pixels. fine: lines each metre.
    """
    shown = camera.scaled(width / camera.width)
    if image_bgr is None:
        canvas = np.full((shown.height, shown.width, 3), BACKDROP, dtype=np.uint8)
    else:
        resized = cv2.resize(image_bgr, (shown.width, shown.height), interpolation=cv2.INTER_AREA)
        canvas = (resized[..., ::-1] * 0.85).astype(np.uint8)  # a little darker, so that the overlay stands out
    if fine:
        draw_lines(canvas, ground_lines(shown, FINE_STEP_M, FINE_REACH_M), GROUND_GRID_COLOR, opacity=0.45, bits=4)
    draw_lines(canvas, ground_lines(shown), GROUND_GRID_COLOR, 2 if fine else 1, opacity=0.55, bits=4)
    draw_lines(canvas, visible_runs(horizon(shown)), HORIZON_COLOR, 2, 0.9, 4)
    draw_lines(canvas, pillar_lines(shown, ego_from_bev), PILLAR_COLOR, opacity=0.35, bits=4)
    for pixel, distance, color in zip(*pillars_in(shown, ego_from_bev), strict=True):
        radius = float(np.clip(60 / distance, 1.2, 6)) * (width / 800)
        center = tuple(np.round(pixel * 16).astype(int).tolist())
        cv2.circle(canvas, center, round(radius * 16), color.tolist(), -1, cv2.LINE_AA, 4)
    _draw_distances(canvas, shown)
    return canvas


def _draw_distances(canvas: Canvas, camera: Camera) -> None:
    """Label distances on the ground along the viewing direction, where the labels do not overlap."""
    ahead = np.array([np.cos(camera.yaw), np.sin(camera.yaw), 0.0])
    start = camera.ego_from_camera[:3, 3] * [1, 1, 0]
    size, last = 0.5 * canvas.shape[1] / 800, np.inf
    for distance in LABELLED_M:
        pixel = pixels_in_image(camera, start + distance * ahead)
        if np.isfinite(pixel).all() and last - pixel[1] > 22:
            last = float(pixel[1])
            corner = (round(pixel[0]), round(pixel[1]))
            for color, thickness in (((10, 12, 16), 4), ((240, 244, 248), 1)):
                cv2.putText(canvas, f"{distance:g} m", corner, FONT, size, color, thickness, cv2.LINE_AA)


SEVERITY_COLORS = {"error": "#ff5c72", "warning": "#ffc857", "info": "#7fb7e6"}
SIDE_DEG = (75.0, 105.0)  # cameras with a yaw in this range are placed beside the map
DPI = 100
# Layout in inches: width of an image, gap between images, title above and details below an image, size of the map.
SLOT, GAP, TITLE, DETAILS, MIDDLE = 5.2, 0.3, 0.32, 0.38, 5.2
FOOTER = 3.0  # findings and legend, where cameras are placed beside the map
LINE = 0.19  # height of a line of text
IMAGE_WIDTH = 1040  # pixels, of an image as wide as SLOT
PAPER, INK, FAINT = "#14171c", "#e8ecf1", "#8a93a0"
COUNT_COLORS = ("#b3324a", "#2b4a63", "#3f8f8a", "#9fd67a", "#f4f1a1")  # of 0, 1, 2, 3, and 4 or more cameras
LEGEND_STYLE = {"facecolor": PAPER, "edgecolor": "none", "labelcolor": INK, "fontsize": 9}
CAR_LENGTH_M, CAR_WIDTH_M, AXLE_TO_TAIL_M = 4.6, 1.8, 1.0


def write_camera_sheet(
    path: Path, rig: CameraRig, findings: Sequence[Finding], coverage: Coverage, images: Mapping[str, Canvas]
) -> None:
    """Write the PNG. images: by camera, (H, W, 3) BGR; others are drawn on a dark background. Raises OutputError."""
    front, left, right, back = _cameras_by_side(rig)
    columns = max(len(front), len(back), 3)
    slot = SLOT if len(rig.cameras) > 1 else columns * (SLOT + GAP) - GAP  # one image has all of the width
    height_of = partial(_camera_height, slot=slot)
    ahead, behind = (max(map(height_of, row), default=0.0) for row in (front, back))
    heights = [ahead, max(*(sum(map(height_of, column)) for column in (left, right)), MIDDLE), behind]
    footer = FOOTER if left or right else 0.0
    sheet = _Sheet(columns * (SLOT + GAP) + GAP, sum(heights) + footer + 2 * GAP, slot)
    tops = GAP + np.cumsum([0.0, *heights[:2]])
    for row, top in ((front, tops[0]), (back, tops[2])):
        start = (sheet.width - len(row) * (slot + GAP) + GAP) / 2
        for column_index, camera in enumerate(row):
            _draw_camera(sheet, (start + column_index * (slot + GAP), top), camera, rig, findings, images)
    for column, start in ((left, GAP), (right, sheet.width - SLOT - GAP)):
        top = tops[1]
        for camera in column:
            _draw_camera(sheet, (start, top), camera, rig, findings, images)
            top += height_of(camera)
    size, top = MIDDLE - 1.1, tops[1] + (heights[1] - MIDDLE) / 2 + 0.35
    draw_coverage(sheet.axes((sheet.width - size) / 2 + 0.1, top, size, size), rig, coverage)
    if footer:
        top, size = sheet.height - GAP - footer, footer
    _write_findings(sheet.axes(GAP, top, SLOT, size), size, findings)
    _write_legend(sheet.axes(sheet.width - SLOT - GAP, top, SLOT, size))
    save(sheet.figure, path)


class _Sheet:
    """A figure on which axes are placed in inches from the top left corner. slot: width of an image."""

    def __init__(self, width: float, height: float, slot: float) -> None:
        self.width, self.height, self.slot = width, height, slot
        self.figure = Figure(figsize=(width, height), dpi=DPI, facecolor=PAPER)

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        bottom = self.height - top - height
        box = (left / self.width, bottom / self.height, width / self.width, height / self.height)
        return self.figure.add_axes(box)


def _camera_height(camera: Camera, slot: float) -> float:
    return TITLE + slot * min(camera.height / camera.width, 1.0) + DETAILS


def _cameras_by_side(rig: CameraRig) -> tuple[list[Camera], list[Camera], list[Camera], list[Camera]]:
    """The cameras that look ahead (from left to right), left, right, and back (from the vehicle's left to right)."""
    yaws = {camera.name: float(np.degrees(camera.yaw)) for camera in rig.cameras}
    low, high = SIDE_DEG if len(yaws) > 1 else (360.0, 360.0)  # one camera is at the top, wherever it looks
    ahead = [c for c in rig.cameras if abs(yaws[c.name]) < low]
    back = [c for c in rig.cameras if abs(yaws[c.name]) > high]
    sides = [c for c in rig.cameras if low <= abs(yaws[c.name]) <= high]
    return (
        sorted(ahead, key=lambda c: -yaws[c.name]),
        [c for c in sides if yaws[c.name] > 0],
        [c for c in sides if yaws[c.name] < 0],
        sorted(back, key=lambda c: yaws[c.name] % 360),
    )


def _draw_camera(
    sheet: _Sheet,
    corner: tuple[float, float],
    camera: Camera,
    rig: CameraRig,
    findings: Sequence[Finding],
    images: Mapping[str, Canvas],
) -> None:
    """Draw a camera's image with title, angles and its first finding. corner: left and top, inches."""
    left, top = corner
    axes = sheet.axes(left, top + TITLE, sheet.slot, _camera_height(camera, sheet.slot) - TITLE - DETAILS)
    width = round(IMAGE_WIDTH * sheet.slot / SLOT)
    image = images.get(camera.name)
    if image is not None and image.shape[:2] != (camera.height, camera.width):
        image = cv2.resize(image, (camera.width, camera.height)).astype(np.uint8)
    axes.imshow(draw_overlay(camera, rig.ego_from_bev, image, width, fine=sheet.slot > SLOT))
    axes.set(xticks=[], yticks=[])
    mounting = mounting_of(camera.ego_from_camera)
    mine = [finding for finding in findings if finding.camera == camera.name]
    color = SEVERITY_COLORS[mine[0].severity] if mine else FAINT
    axes.spines[:].set(color=color, linewidth=2.5 if mine else 0.8)
    axes.set_title(camera.name, loc="left", color=INK, fontsize=11)
    details = f"yaw {degrees_text(mounting.yaw_deg, 0)}  pitch {degrees_text(mounting.pitch_deg)}  "
    details += f"roll {degrees_text(mounting.roll_deg)}  height {mounting.height:.2f} m  "
    details += f"FOV {seen_fov_deg(camera)[0]:.0f}°"
    axes.set_xlabel(details, color=FAINT, fontsize=9, loc="left", labelpad=5)
    if mine:
        box = {"facecolor": PAPER, "edgecolor": color, "alpha": 0.9, "boxstyle": "round,pad=0.4"}
        text = textwrap.fill(mine[0].message, 50)
        axes.text(0.02, 0.96, text, transform=axes.transAxes, va="top", color=color, fontsize=10, bbox=box)


def _write_findings(axes: Axes, height: float, findings: Sequence[Finding]) -> None:
    """Write as many findings as fit. height: of the axes, inches."""
    axes.axis("off")
    axes.set_ylim(height, 0)
    axes.text(0, 0, "Findings", color=INK, fontsize=13, va="top")
    if not findings:
        axes.text(0, 0.45, "none: the rig is plausible", color="#7fd6a0", fontsize=10, va="top")
    top = 0.45
    for finding in findings:
        camera = f"{finding.camera}: " if finding.camera else ""
        numbers = f" ({finding.found})" if finding.found else ""
        lines = textwrap.wrap(f"{camera}{finding.message}{numbers}", 56)[:4]
        if top + LINE * len(lines) > height - LINE:
            axes.text(0, top, "more in findings.json", color=FAINT, fontsize=9, va="top")
            break
        axes.text(0, top, finding.severity, color=SEVERITY_COLORS[finding.severity], fontsize=9, va="top")
        axes.text(0.15, top, "\n".join(lines), color=INK, fontsize=9, va="top", linespacing=1.25)
        top += LINE * len(lines) + 0.08


def _write_legend(axes: Axes) -> None:
    axes.axis("off")
    axes.text(0.1, 1.0, "Legend", color=INK, fontsize=13, va="top", transform=axes.transAxes)
    texts = [f"pillar point {height:+.1f} m in the bev frame" for height in PILLAR_GRID.pillar_heights()[::-1]]
    colors = [tuple(color / 255) for color in height_colors()[::-1]]
    style: dict[str, Any] = {"marker": "o", "linestyle": "none"}
    dots = [Line2D([], [], color=color, label=text, **style) for color, text in zip(colors, texts, strict=True)]
    lines = [
        Line2D(
            [], [], color=tuple(np.array(HORIZON_COLOR) / 255), label="horizon: infinitely far, at the camera's height"
        ),
        Line2D(
            [],
            [],
            color=tuple(np.array(GROUND_GRID_COLOR) / 255),
            label="ground grid of 5 m, fine 1 m: should lie on the road",
        ),
    ]
    axes.legend(handles=dots + lines, loc="upper left", bbox_to_anchor=(0.08, 0.94), labelspacing=0.9, **LEGEND_STYLE)


def write_coverage_map(path: Path, rig: CameraRig, coverage: Coverage) -> None:
    """Write the map as a PNG. Raises OutputError."""
    figure = Figure(figsize=(9.6, 8.2), dpi=110, facecolor=PAPER)
    axes = figure.add_axes((0.08, 0.08, 0.72, 0.85))
    draw_coverage(axes, rig, coverage)
    axes.set_title("How many cameras see each BEV cell", color=INK, fontsize=13, loc="left", pad=12)
    figure.legend(handles=_legend(coverage), loc="upper left", bbox_to_anchor=(0.80, 0.935), **LEGEND_STYLE)
    save(figure, path)


def draw_coverage(axes: Axes, rig: CameraRig, coverage: Coverage) -> None:
    """Draw the map on axes: x and y of the bev frame in metres, with the vehicle and its cameras."""
    grid = coverage.grid
    colors, norm = ListedColormap(COUNT_COLORS), BoundaryNorm(np.arange(-0.5, 5), 5)
    extent = (*grid.x_range_m, *grid.y_range_m)
    shown = np.minimum(coverage.counts, 4)
    axes.imshow(shown, origin="lower", extent=extent, cmap=colors, norm=norm, interpolation="nearest")
    _draw_rings(axes, rig)
    _draw_vehicle(axes, rig)
    for camera in rig.cameras:
        _draw_field_of_view(axes, camera, rig)
    axes.set(xlim=grid.x_range_m, ylim=grid.y_range_m)
    axes.set_xlabel("x of the bev frame, m", color=FAINT, fontsize=9, labelpad=2)
    axes.set_ylabel("y of the bev frame, m", color=FAINT, fontsize=9, labelpad=1)
    axes.tick_params(colors=FAINT, labelsize=8)
    axes.spines[:].set_color(FAINT)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG. Raises OutputError."""
    with whole_file(path) as unfinished:
        FigureCanvasAgg(figure).print_png(str(unfinished))


def _legend(coverage: Coverage) -> Sequence[Patch]:
    words = ("no camera", "1 camera", "2 cameras", "3 cameras", "4 or more")
    counts = np.bincount(np.minimum(coverage.counts, 4).ravel(), minlength=5)
    shares = 100 * counts / counts.sum()
    rows = zip(COUNT_COLORS, words, shares, strict=True)
    return [
        Patch(color=color, label=f"{word}: {share:.1f}%") for color, word, share in rows if share or word == words[0]
    ]


def _draw_rings(axes: Axes, rig: CameraRig) -> None:
    center = inverse(rig.ego_from_bev)[:2, 3]
    angles = np.linspace(0, 2 * np.pi, 200)
    for radius in (10, 20, 30, 40, 50):
        x, y = center[0] + radius * np.cos(angles), center[1] + radius * np.sin(angles)
        axes.plot(x, y, color=INK, linewidth=0.5, alpha=0.35)
        style: dict[str, Any] = {"color": INK, "fontsize": 7, "ha": "center", "va": "bottom", "alpha": 0.8}
        axes.text(center[0], center[1] + radius, f"{radius} m", **style)


def _draw_vehicle(axes: Axes, rig: CameraRig) -> None:
    tail, half = -AXLE_TO_TAIL_M, CAR_WIDTH_M / 2
    nose = tail + CAR_LENGTH_M
    outline = [(tail, half), (tail, -half), (nose - 0.8, -half), (nose, 0), (nose - 0.8, half)]
    points = apply(inverse(rig.ego_from_bev), [(x, y, 0.0) for x, y in outline])
    axes.fill(points[:, 0], points[:, 1], facecolor=PAPER, edgecolor=INK, linewidth=1.2, zorder=4)


def _draw_field_of_view(axes: Axes, camera: Camera, rig: CameraRig) -> None:
    bev_from_camera = inverse(rig.ego_from_bev) @ camera.ego_from_camera
    position, forward = bev_from_camera[:2, 3], bev_from_camera[:2, 2]
    yaw = float(np.degrees(np.arctan2(forward[1], forward[0])))
    for angle in np.radians(yaw - np.array(seen_range_deg(camera, 0))):
        end = position + 80 * np.array([np.cos(angle), np.sin(angle)])
        axes.plot([position[0], end[0]], [position[1], end[1]], color=INK, linewidth=0.7, alpha=0.6, zorder=3)
    label = position + 27 * np.array([np.cos(np.radians(yaw)), np.sin(np.radians(yaw))])
    box = {"facecolor": PAPER, "edgecolor": "none", "alpha": 0.75, "boxstyle": "round,pad=0.25"}
    style: dict[str, Any] = {"color": INK, "fontsize": 8, "ha": "center", "va": "center", "bbox": box}
    axes.text(float(label[0]), float(label[1]), camera.name, zorder=5, clip_on=True, **style)


COVERAGE, COVERAGE_ON_GROUND, FINDINGS = "coverage", f"{entities.EGO}/coverage", "findings"
PIXELS_PER_CELL = 6
OVERLAYS = ("pillars", "ground_grid", "pillar_lines", "horizon")


def write_rig_recording(
    path: Path,
    rig: CameraRig,
    findings: Sequence[Finding],
    coverage: Coverage,
    measures: Sequence[Measure],
    images: Mapping[str, Canvas],
) -> None:
    """Write the recording. images: by camera, (H, W, 3) BGR; any may be missing. Raises OutputError."""
    with _layout(rig).saved_to(path, "bevcli-project-debug") as stream:
        log_static.log_scene(stream, rig, {})
        _log_coverage(stream, rig, coverage)
        for camera in rig.cameras:
            _log_camera(stream, camera, rig.ego_from_bev, images.get(camera.name))
        stream.set_time(entities.FRAME_TIMELINE, sequence=0)  # `bevcli viz` expects this timeline
        stream.log(FINDINGS, rr.TextDocument(_findings_markdown(findings, measures), media_type="text/markdown"))


def _findings_markdown(findings: Sequence[Finding], measures: Sequence[Measure]) -> str:
    lines = ["## Findings", ""]
    for finding in findings:
        camera = f"`{finding.camera}` " if finding.camera else ""
        lines.append(f"- **{finding.severity}** {camera}{finding.message}.")
        texts = (("found", finding.found), ("expected", finding.expected))
        numbers = [f"{word} {value}" for word, value in texts if value]
        lines += [f"    - {text}" for text in (", ".join(numbers), finding.advice) if text]
    if not findings:
        lines.append("None: the rig is plausible.")
    if measures:
        lines += ["", "## Comparison with nuScenes", "", "| | this rig | nuScenes |", "|---|---|---|"]
        lines += [f"| {m.name} | {m.value} | {m.reference} |" for m in measures]
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


def _log_camera(stream: rr.RecordingStream, camera: Camera, ego_from_bev: Array, pixels: Canvas | None) -> None:
    log(stream, entities.camera(camera.name), log_cameras.transform(camera.ego_from_camera), static=True)
    if pixels is not None:
        encoded = encode_image(pixels)
        image = rr.EncodedImage(contents=encoded, media_type="image/jpeg")
        stream.log(entities.image(camera.name), image, static=True)
    points, distances, colors = pillars_in(camera, ego_from_bev)
    radii = np.clip(60 / np.maximum(distances, 1e-3), 1.2, 6) * camera.width / 800
    dots = rr.Points2D(points, colors=colors, radii=radii, draw_order=30)
    stream.log(entities.overlay(camera.name, "pillars"), dots, static=True)
    for kind, lines, color, width in (
        ("ground_grid", ground_lines(camera), (*GROUND_GRID_COLOR, 120), 0.6),
        ("pillar_lines", pillar_lines(camera, ego_from_bev), (*PILLAR_COLOR, 90), 0.6),
        ("horizon", visible_runs(horizon(camera)), HORIZON_COLOR, 1.0),
    ):
        inside = [run for line in lines for run in _clipped(line, camera)]
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
