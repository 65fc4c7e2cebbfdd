"""Images and lines of the ground: BEV features and maps from above and in the scene, probes, lines, futures, paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import BevMap, Frame, GroundLines, Probe
from bevcli.geometry.bev_grid import BevGrid, rectangle
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.recording import entities, log_boxes, log_cameras
from bevcli.recording.entities import components, line_strips, log, rgb_format, ui_points
from bevcli.recording.log_cameras import PosedCamera

Features = NDArray[np.float32]
Ranges = tuple[tuple[float, float], tuple[float, float]]  # of x and of y, bev frame, metres
FITTED_ON = 2  # frames
CELLS_FOR_FIT = 4000  # of each frame, evenly spaced
PERCENTILES = (1.0, 99.0)  # become the darkest and the brightest colour
BELOW_GROUND_M = 0.06  # the map is drawn below the ground, so that it does not flicker with the range rings
FUTURES_OPACITY, FUTURES_WIDTH = 230, 1.0  # of 255; points of the user interface
ABOVE_GROUND = (0, 0, 0.04)  # metres, so that lines do not flicker with what lies on the ground


@dataclass(frozen=True)
class BevColors:
    """A fixed mapping from features to colours."""

    mean: Features  # (C,) subtracted from the features
    basis: Features | None  # (C, K) projection, K 1 or 3; None takes the norm of the features (K 1)
    low: Array  # (K,) values that become 0
    high: Array  # (K,) values that become 1

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
        channel = int(kind.partition(":")[2])
        if channel >= channels:
            raise InputError(f"`bev={kind}` (`--bev`): the BEV map has channels 0 to {channels - 1}")
        basis = np.eye(channels, dtype=np.float32)[:, channel : channel + 1]
    low, high = np.percentile(_values(features, mean, basis), PERCENTILES, axis=0)
    return BevColors(mean, basis, low, high)


@dataclass
class BevImages:
    """Takes the features of each frame; returns the images that are ready, each with the stamp of its frame."""

    kind: str  # see `fit_colors`
    # fitted on the first frames, None before. Setting them continues an interrupted recording
    colors: BevColors | None = None
    # stamps and features of the frames whose images are not returned yet
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
    dots = components(
        rr.Points2D, positions=centers * (1, -1), colors=entities.PROBE_COLOR, radii=ui_points(5.0), draw_order=50
    )
    log(stream, entities.BEV_PROBES, dots)
    low, high = grid.pillar_heights()[[0, -1]]
    ends = np.stack([np.column_stack([centers, np.full(len(centers), z)]) for z in (low, high)], axis=1)
    strips = apply(ego_from_bev, ends).astype(np.float32)
    stream.log(entities.PROBES, rr.LineStrips3D(strips, colors=entities.PROBE_COLOR, radii=0.05))


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
        line_colors = own_colors[visible.owners]
        strips = components(rr.LineStrips2D, strips=visible.segments, colors=line_colors, radii=radii, draw_order=15)
        log(stream, entities.overlay(posed.camera.name, kind), strips)


class SeenCells:
    """The cells of a map that a frame's cameras see; elsewhere, a model fills in what it has learned about streets.

    Those of the last rig are kept, as most drives have one.
    """

    def __init__(self) -> None:
        self._rig: CameraRig | None = None
        self._of_camera: dict[str, NDArray[np.bool_]] = {}

    def of(self, ground_map: BevMap, frame: Frame, grid: BevGrid) -> BevMap:
        """A map in which cells have no class if no camera with an image sees a point of their pillar.

        grid: of the model, for the heights of the pillars' points.
        """
        rows, columns = ground_map.cells.shape
        if frame.rig is not self._rig:
            x_range_m, y_range_m = ground_map.x_range_m, ground_map.y_range_m
            of_map = replace(grid, rows=rows, columns=columns, x_range_m=x_range_m, y_range_m=y_range_m)
            points = apply(frame.rig.ego_from_bev, of_map.pillars()[::-1])  # (Y, X, Z, 3), the largest y first
            self._of_camera = {camera.name: np.any(camera.sees(points), axis=-1) for camera in frame.rig.cameras}
            self._rig = frame.rig
        seen = np.zeros((rows, columns), dtype=bool)
        for camera in frame.images:
            seen |= self._of_camera[camera]
        return replace(ground_map, cells=np.where(seen, ground_map.cells, 0))
