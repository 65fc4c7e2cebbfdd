"""Writes what lies on the ground: BEV features, segmentation, history weights, probed cells, lines, futures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import BevMap, GroundLines, Probe
from bevcli.geometry.bev_grid import BevGrid, rectangle
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.recording import entities
from bevcli.recording.colors import BACKGROUND, Color, colormap, map_colors
from bevcli.recording.components import Components, blob, components, line_strips, rgb_format, ui_points
from bevcli.recording.log_boxes import box_colors
from bevcli.recording.log_cameras import PosedCamera, cut_to_images

Features = NDArray[np.float32]
FITTED_ON = 2  # frames
CELLS_FOR_FIT = 4000  # of each frame, evenly spaced
PERCENTILES = (1.0, 99.0)  # become the darkest and the brightest colour
GROUND_OPACITY = 110  # of 255: boxes, rings and the trajectory stay readable on the map
PROBE_COLOR: Color = (255, 80, 220)
BELOW_GROUND_M = 0.06  # the map is drawn below the ground, so that it does not flicker with the range rings
FUTURES_OPACITY, FUTURES_WIDTH = 230, 1.0  # of 255; points of the user interface
ABOVE_GROUND = (0, 0, 0.04)  # metres, so that lines do not flicker with what lies on the ground


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
            return colormap(shares[..., 0], "inferno")
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
        basis = _principal_components(features - mean)
    elif kind.startswith("channel:"):
        chosen = int(kind.partition(":")[2])
        if chosen >= channels:
            raise InputError(f"`bev={kind}`: the BEV map has channels 0 to {channels - 1}")
        basis = np.eye(channels, dtype=np.float32)[:, chosen : chosen + 1]
    low, high = np.percentile(_values(features, mean, basis), PERCENTILES, axis=0)
    return BevColors(mean, basis, low, high)


class BevImages:
    """Takes the features of each frame; returns the images that are ready, each with the stamp of its frame.

    Attributes:
        colors: fitted on the first frames, None before. Setting them continues an interrupted recording.
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.colors: BevColors | None = None
        self._waiting: list[tuple[Any, Features]] = []

    def push(self, stamp: Any, features: Features) -> list[tuple[Any, NDArray[np.uint8]]]:
        """Adds a frame; returns the images that are ready.

        features: (rows, columns, C); the first row has the smallest y. The images are (rows, columns, 3) uint8 RGB;
        their first row has the largest y.
        """
        self._waiting.append((stamp, features))
        if self.colors is None and len(self._waiting) < FITTED_ON:
            return []
        return self.finish()

    def finish(self) -> list[tuple[Any, NDArray[np.uint8]]]:
        """The images that are not returned yet: that of the first frame, where there was no second one."""
        if not self._waiting:
            return []
        if self.colors is None:
            self.colors = fit_colors(self.kind, np.concatenate([_thinned(f) for _, f in self._waiting]))
        colors = self.colors
        ready = [(stamp, np.ascontiguousarray(colors.paint(f)[::-1])) for stamp, f in self._waiting]
        self._waiting = []
        return ready


def _values(features: Features, mean: Features, basis: Features | None) -> Features:
    if basis is None:
        return np.asarray(np.linalg.norm(features, axis=-1, keepdims=True), dtype=np.float32)
    return np.asarray((features - mean) @ basis, dtype=np.float32)


def _thinned(features: Features) -> Features:
    cells = features.reshape(-1, features.shape[-1])
    return cells[:: max(1, len(cells) // CELLS_FOR_FIT)]


def _principal_components(centered: Features) -> Features:
    _, vectors = np.linalg.eigh(centered.T @ centered)
    basis = vectors[:, :-4:-1]  # the three largest, largest first
    signs = np.sign(basis[np.abs(basis).argmax(0), np.arange(basis.shape[1])])
    # The sign of an eigenvector is arbitrary: make its largest entry positive.
    return basis * np.where(signs == 0, 1, signs).astype(np.float32)


def log_features(stream: rr.RecordingStream, image: NDArray[np.uint8], grid: BevGrid, ego_from_bev: Array) -> None:
    """Writes an image of the BEV features into the BEV view, and onto the ground of the scene.

    image: (rows, columns, 3) RGB; the first row has the largest y.
    """
    painted = _Painted(image)
    stream.log(entities.BEV_FEATURES, painted.flat(grid, draw_order=-10))
    stream.log(entities.BEV_ON_GROUND, painted.on_ground(grid, ego_from_bev, GROUND_OPACITY))


def map_image(segmentation: BevMap) -> NDArray[np.uint8]:
    """A segmentation as an image (rows, columns, 3) RGB in the colours of the map classes."""
    palette = np.full((256, 3), BACKGROUND, dtype=np.uint8)
    contents = replace(segmentation, cells=np.arange(256, dtype=np.uint8))
    for name, color in map_colors(segmentation.classes).items():  # where a cell has several, the last one is shown
        palette[contents.layer(name)] = color
    return palette.take(segmentation.cells, axis=0)


def log_segmentation(stream: rr.RecordingStream, segmentation: BevMap, ego_from_bev: Array) -> None:
    """Writes a segmentation into the BEV view and onto the ground of the scene, in the colours of the map classes."""
    painted = _Painted(map_image(segmentation))
    stream.log(entities.BEV_SEGMENTATION, painted.flat(segmentation, draw_order=-5))
    stream.log(entities.SEGMENTATION_ON_GROUND, painted.on_ground(segmentation, ego_from_bev, 255))


def log_history(stream: rr.RecordingStream, weight: Array | None, grid: BevGrid) -> None:
    """Writes the attention weight of the previous BEV map in each cell.

    weight: (rows, columns) 0 to 1; None (no history was used) clears the map of the frame before.
    """
    if weight is None:
        stream.log(entities.BEV_HISTORY, rr.Clear(recursive=False))
        return
    stream.log(entities.BEV_HISTORY, _Painted(colormap(weight[::-1], "viridis")).flat(grid, draw_order=-8))


def log_probes(stream: rr.RecordingStream, probes: tuple[Probe, ...], ego_from_bev: Array, grid: BevGrid) -> None:
    """Marks the probed cells: with a dot in the BEV view, and with a pillar in the scene."""
    if not probes:
        return
    centers = np.array([probe.cell_center for probe in probes])
    dots = components(rr.Points2D, positions=centers * (1, -1), colors=PROBE_COLOR, radii=ui_points(5.0), draw_order=50)
    stream.log(entities.BEV_PROBES, dots)
    low, high = grid.pillar_heights()[[0, -1]]
    ends = np.stack([np.column_stack([centers, np.full(len(centers), z)]) for z in (low, high)], axis=1)
    strips = apply(ego_from_bev, ends).astype(np.float32)
    stream.log(entities.PROBES, rr.LineStrips3D(strips, colors=PROBE_COLOR, radii=0.05))


class _Painted:
    """An image (rows, columns, 3) RGB of the bev frame, whose first row has the largest y, for several entities."""

    def __init__(self, image: NDArray[np.uint8]) -> None:
        self._rows, self._columns = image.shape[:2]
        self._bytes, self._format = blob(image), rgb_format(self._columns, self._rows)

    def flat(self, area: BevGrid | BevMap, draw_order: float) -> Components:
        """The image in the BEV view."""
        (left, right), (low, high) = area.x_range_m, area.y_range_m
        cell = ((right - left) / self._columns, (high - low) / self._rows, 1.0)
        placed = components(rr.Transform3D, translation=(left, -high, 0), scale=cell)
        return components(rr.Image, buffer=self._bytes, format=self._format, draw_order=draw_order) + placed

    def on_ground(self, area: BevGrid | BevMap, ego_from_bev: Array, opacity: int) -> Components:
        """The image as a rectangle on the ground of the ego frame."""
        corners = apply(ego_from_bev, rectangle(area.x_range_m, area.y_range_m))
        corners[:, 2] = -BELOW_GROUND_M
        return components(
            rr.Mesh3D,
            vertex_positions=corners,
            triangle_indices=((0, 1, 2), (0, 2, 3)),
            vertex_texcoords=((0, 1), (1, 1), (1, 0), (0, 0)),
            albedo_texture_buffer=self._bytes,
            albedo_texture_format=self._format,
            albedo_factor=(255, 255, 255, opacity),
        )


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
    strips, colors, of_class = [], [], box_colors(boxes, classes)
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
    in_space = line_strips([strip + ABOVE_GROUND for strip in lines.strips], 3)
    solid = components(rr.LineStrips3D, strips=in_space, colors=colors, radii=radii)
    stream.log(f"{entities.WORLD}/{kind}", solid)
    bev_from_world = inverse(world_from_bev)
    flat = line_strips([apply(bev_from_world, strip)[:, :2] * (1, -1) for strip in lines.strips], 2)
    from_above = components(rr.LineStrips2D, strips=flat, colors=colors, radii=radii, draw_order=24)
    stream.log(f"{entities.BEV}/{kind}", from_above)
    _log_in_images(stream, kind, lines, cameras)


def _log_in_images(stream: rr.RecordingStream, kind: str, lines: GroundLines, cameras: Sequence[PosedCamera]) -> None:
    pieces = [np.stack([strip[:-1], strip[1:]], axis=1) for strip in lines.strips]
    ends = np.concatenate([np.zeros((0, 2, 3)), *pieces])
    owners = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    of_cameras = np.concatenate([apply(posed.camera_from_world, ends) for posed in cameras])
    counts = np.full(len(cameras), len(ends))
    parts = cut_to_images(of_cameras, np.tile(owners, len(cameras)), counts, [posed.camera for posed in cameras])
    own_colors, radii = np.array(lines.colors, dtype=np.uint8).reshape(-1, 4), ui_points(lines.width)
    for posed, visible in zip(cameras, parts, strict=True):
        colors = own_colors[visible.owners]
        strips = components(rr.LineStrips2D, strips=visible.segments, colors=colors, radii=radii, draw_order=15)
        stream.log(entities.overlay(posed.name, kind), strips)
