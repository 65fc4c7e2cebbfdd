"""odometry.png and odometry.rrd: the way on the road from above, and speed and yaw rate over time.

The road is stitched of what each frame shows of it near the vehicle, by the measured poses: edges that break or double
show an error of the motion or of the calibration.
"""

from collections.abc import Sequence, Sequence as Items
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bevcli.frame import DerivedDrive, Drive, Frame
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Array, inverse
from bevcli.parsing.images import encode_image
from bevcli.recording import entities
from bevcli.recording.blueprint import Layout, camera_rows, flat_view, frame_rate_hz
from bevcli.workshop.correspondence.images import sampled
from bevcli.workshop.odometry.measure import MeasuredMotion
from bevcli.workshop.odometry.report import KMH, lengths_m, speeds, yaw_rates_deg
from bevcli.workshop.odometry.step_views import nearest_cameras
from bevcli.workshop.odometry.steps import SeenPoints
from bevcli.writing import whole_file

Pixels = NDArray[np.uint8]
CELL_M, REACH_M = 0.1, 15.0  # of the road around one frame
SIDE = round(2 * REACH_M / CELL_M)  # pixels
BODY_M = (-1.2, 4.2, 1.1)  # of the vehicle: back and front, and half its width, from the origin of the ego frame
MOST_PIXELS = 1600  # of a side of the stitched road
SHOWN_WIDTH, MOST_SHOWN = 320, 100  # of images in the recording: pixels, and frames
JPEG_QUALITY = 80
MEASURED, STATED, GUESSED = "#ff8c1a", "#2a7de1", "#d62728"


class GroundView:
    """Looks at the road around the vehicle from above, by the cameras of one rig.

    Attributes:
        weight: (SIDE, SIDE) closeness of each cell to the camera that sees it, 0 where none does.
    """

    def __init__(self, rig: CameraRig) -> None:
        self.rig, cells = rig, ground_cells()
        self._pixels, self._camera, distance = nearest_cameras(rig.cameras, cells)
        back, front, half = BODY_M
        body = (cells[..., 0] > back) & (cells[..., 0] < front) & (np.abs(cells[..., 1]) < half)
        self._camera[body | (distance > REACH_M)] = -1
        seen = cv2.erode((self._camera >= 0).astype(np.float32), np.ones((5, 5)))  # an edge mixes with black
        self.weight = np.asarray(seen / (1 + distance), dtype=np.float32)

    def of(self, frame: Frame) -> Pixels:
        """(SIDE, SIDE, 3) BGR, the road around the vehicle; ahead is up. Black where no image shows it."""
        road = np.zeros((SIDE, SIDE, 3), np.uint8)
        for index, name in enumerate(self.rig.names):
            mine = self._camera == index
            if name in frame.images and mine.any():
                road[mine] = sampled(frame.images[name].pixels_bgr, self._pixels[index])[mine]
        return road


def ground_cells() -> Array:
    """(SIDE, SIDE, 3) centres of the cells on the ground, ego frame: the first row is farthest ahead, left first."""
    along = REACH_M - CELL_M * (np.arange(SIDE) + 0.5)
    return np.stack([*np.meshgrid(along, along, indexing="ij"), np.zeros((SIDE, SIDE))], axis=-1)


def _small(image: Pixels) -> bytes:
    """JPEG of an image, SHOWN_WIDTH wide."""
    height = round(SHOWN_WIDTH * image.shape[0] / image.shape[1])
    small = cv2.resize(image, (SHOWN_WIDTH, height), interpolation=cv2.INTER_AREA)
    return encode_image(small, quality=JPEG_QUALITY)


class WatchedDrive(DerivedDrive):
    """A drive that keeps what is drawn of each frame that is loaded: the road from above, and its stated pose."""

    def __init__(self, sequence: Drive) -> None:
        super().__init__(sequence)
        self.road: dict[int, bytes] = {}  # frame -> JPEG of the road from above
        self.images: dict[int, dict[str, bytes]] = {}  # frame -> camera -> JPEG; of MOST_SHOWN frames at most
        self.stated: dict[int, Array] = {}  # frame -> world_from_ego (4, 4); of a drive with poses
        self.view: GroundView | None = None  # the road in the images of the rig; None before a frame is loaded
        self._every = -(-len(sequence.stamps) // MOST_SHOWN)

    def load(self, index: int) -> Frame:
        frame = super().load(index)
        if self.view is None or self.view.rig is not frame.rig:
            self.view = GroundView(frame.rig)
        self.road[index] = encode_image(self.view.of(frame), quality=JPEG_QUALITY)
        if index % self._every == 0:
            self.images[index] = {name: _small(image.pixels_bgr) for name, image in frame.images.items()}
        if self.has_ego_motion:
            self.stated[index] = frame.world_from_ego.matrix
        return frame

    @property
    def stated_poses(self) -> list[Array] | None:
        """(F, 4, 4) of all frames; None for a drive without poses."""
        return [self.stated[index] for index in range(len(self.stamps))] if self.stated else None


@dataclass(frozen=True)
class StitchedRoad:
    """The road along the way."""

    image: Pixels  # (H, W, 3) RGB, white where it was not seen; the first row has the largest y
    x_range_m: tuple[float, float]  # of the image, in the world frame
    y_range_m: tuple[float, float]  # the same

    def pixels(self, poses: Array) -> Array:
        """(F, 2) column and row of each of some poses (F, 4, 4), world_from_ego."""
        (x0, x1), (_, y1) = self.x_range_m, self.y_range_m
        cell = (x1 - x0) / self.image.shape[1]
        return np.stack([poses[:, 0, 3] - x0, y1 - poses[:, 1, 3]], axis=-1) / cell


def stitched(drive: WatchedDrive, poses: Array) -> StitchedRoad:
    """The road of all frames by their poses (F, 4, 4): each place as the frame saw it that was closest to it."""
    assert drive.view is not None
    low, high = poses[:, :2, 3].min(0) - REACH_M, poses[:, :2, 3].max(0) + REACH_M
    cell = max(CELL_M, float((high - low).max()) / MOST_PIXELS)
    width, height = (int(size) for size in np.ceil((high - low) / cell))
    image, best = np.full((height, width, 3), 255, np.uint8), np.zeros((height, width), np.float32)
    pixel_from_world = np.array([[1 / cell, 0, -low[0] / cell], [0, -1 / cell, high[1] / cell], [0, 0, 1]])
    for index in sorted(drive.road):
        road = np.asarray(cv2.imdecode(np.frombuffer(drive.road[index], np.uint8), cv2.IMREAD_COLOR_RGB))
        weight = drive.view.weight * (road.max(-1) > 4)  # where an image is missing it is black
        pixel_from_patch = pixel_from_world @ _world_from_patch(poses[index])
        corners = pixel_from_patch @ np.array([[0, SIDE, 0, SIDE], [0, 0, SIDE, SIDE], [1, 1, 1, 1]])
        x0, y0 = np.maximum(np.floor(corners[:2].min(1)), 0).astype(int)
        x1, y1 = np.minimum(np.ceil(corners[:2].max(1)), (width, height)).astype(int)
        local = np.array([[1, 0, -x0], [0, 1, -y0]]) @ pixel_from_patch
        size = int(x1 - x0), int(y1 - y0)
        colors = cv2.warpAffine(road, local, size, flags=cv2.INTER_LINEAR)
        weights = cv2.warpAffine(weight, local, size, flags=cv2.INTER_NEAREST)
        best_weights, closer = best[y0:y1, x0:x1], weights > best[y0:y1, x0:x1]
        image[y0:y1, x0:x1][closer], best_weights[closer] = colors[closer], weights[closer]
    return StitchedRoad(
        image, (float(low[0]), float(low[0] + cell * width)), (float(high[1] - cell * height), float(high[1]))
    )


def _world_from_patch(world_from_ego: Array) -> Array:
    """(3, 3) from pixels (column, row) of the road around a frame to x, y of the world, on a level road."""
    ego_from_patch = np.array([[0, -CELL_M, REACH_M], [-CELL_M, 0, REACH_M], [0, 0, 1]])
    flat = np.eye(3)
    flat[:2, :2], flat[:2, 2] = world_from_ego[:2, :2], world_from_ego[:2, 3]
    return flat @ ego_from_patch


def write_picture(path: Path, motion: MeasuredMotion, road: StitchedRoad, stated_poses: Sequence[Array] | None) -> None:
    """Write odometry.png. stated_poses: (F, 4, 4) poses that the drive states. Raises OutputError."""
    figure = draw(motion, road, stated_poses)
    with whole_file(path, parents=True) as unfinished:
        figure.savefig(unfinished, dpi=110, format="png")


def draw(motion: MeasuredMotion, road: StitchedRoad, stated_poses: Sequence[Array] | None) -> Figure:
    """The figure: the way on the road, beside or above the curves."""
    height, width = road.image.shape[:2]
    wide = width > 1.6 * height
    figure = Figure(figsize=(13, 9) if wide else (14, 7), layout="constrained")
    figure.suptitle(f"{motion.name}: {lengths_m(motion).sum():.1f} m", x=0.01, ha="left", fontweight="bold")
    grid = figure.add_gridspec(3 if wide else 2, 1 if wide else 2, height_ratios=[2, 1, 1] if wide else None)
    cells = [grid[0], grid[1], grid[2]] if wide else [grid[:, 0], grid[0, 1], grid[1, 1]]
    way, speed, yaw_rate = (figure.add_subplot(cell) for cell in cells)
    _draw_way(way, motion, road, stated_poses)
    others = None
    if stated_poses is not None:  # as a motion
        moves = [inverse(a) @ b for a, b in pairwise(stated_poses)]
        steps = [replace(step, ego_a_from_ego_b=move) for step, move in zip(motion.steps, moves, strict=True)]
        others = replace(motion, steps=tuple(steps))
    _draw_curve(speed, motion, speeds(motion), None if others is None else speeds(others)[0], "speed, m/s")
    of_stated = None if others is None else yaw_rates_deg(others)[0]
    _draw_curve(yaw_rate, motion, yaw_rates_deg(motion), of_stated, "yaw rate, °/s")
    yaw_rate.set_xlabel("seconds")
    kmh = speed.secondary_yaxis("right", functions=(partial(np.multiply, KMH), partial(np.multiply, 1 / KMH)))
    kmh.set_ylabel("km/h")
    return figure


def _draw_way(axes: Axes, motion: MeasuredMotion, road: StitchedRoad, stated_poses: Sequence[Array] | None) -> None:
    axes.imshow(road.image, extent=(*road.x_range_m, *road.y_range_m), interpolation="bilinear")
    positions = motion.poses[:, :2, 3]
    if stated_poses is not None:
        moved = np.stack([inverse(stated_poses[0]) @ pose for pose in stated_poses])[:, :2, 3]
        axes.plot(*moved.T, color=STATED, linewidth=3.5, alpha=0.6, label="stated")
    axes.plot(*positions.T, color=MEASURED, linewidth=1.5, marker="o", markersize=2.5, label="measured")
    guessed = [index for index, step in enumerate(motion.steps) if step.reason]
    if guessed:
        for index in guessed:
            axes.plot(*positions[index : index + 2].T, color=GUESSED, linewidth=3)
        axes.plot([], [], color=GUESSED, linewidth=3, label="not measured")
    axes.plot(*positions[0], marker="s", color="black", markersize=6)
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.legend(loc="best", fontsize=9)
    axes.set_aspect("equal")


def _draw_curve(
    axes: Axes, motion: MeasuredMotion, measured: tuple[Array, Array], stated_values: Array | None, label: str
) -> None:
    """measured: values (F - 1,) and standard deviations."""
    values, deviations = measured
    times = (motion.timestamps_ns - motion.timestamps_ns[0]) / 1e9
    middles = (times[:-1] + times[1:]) / 2
    if stated_values is not None:
        axes.plot(middles, stated_values, color=STATED, linewidth=3.5, alpha=0.6)
    axes.fill_between(middles, values - deviations, values + deviations, color=MEASURED, alpha=0.3, linewidth=0)
    axes.plot(middles, values, color=MEASURED, linewidth=1.5)
    guessed = np.array([bool(step.reason) for step in motion.steps])
    axes.plot(middles[guessed], values[guessed], color=GUESSED, linestyle="", marker="x")
    axes.set_ylabel(label)
    axes.set_title(f"± σ, {np.median(deviations):.3f} (median)" if len(values) else "", fontsize=9, loc="right")
    axes.grid(visible=True, color="#e6e6e6")
    if len(values):  # a guess's wide deviation must not hide the curve
        shown = values if stated_values is None else np.concatenate([values, stated_values])
        margin = max(0.15 * float(np.ptp(shown)), 3 * float(np.median(deviations)), 0.5)
        axes.set_ylim(float(shown.min()) - margin, float(shown.max()) + margin)


WAY, ROAD, CAMERAS = "way", "road", "cameras"
CURVES = {"speed": "speed, m/s", "yaw_rate": "yaw rate, °/s"}
COLOR, PALE, STATED_COLOR, GUESSED_COLOR = (255, 140, 26), (255, 140, 26, 110), (42, 125, 225), (255, 45, 85)
SERIES = (("measured", "measured", COLOR, 2.0), ("low", "- σ", PALE, 1.0), ("high", "+ σ", PALE, 1.0))
ROAD_COLOR = (70, 150, 255)
RESIDUALS_PX, RESIDUAL_COLORS = (0.5, 1.5), ((70, 220, 120), (245, 222, 90), (255, 45, 85))  # of matched points


def write_recording(
    path: Path, motion: MeasuredMotion, drive: WatchedDrive, road: StitchedRoad, stated_poses: Items[Array] | None
) -> None:
    """Write the recording. stated_poses: (F, 4, 4) poses that the drive states. Raises OutputError."""
    with _layout(drive, road).saved_to(path, "bevcli-odometry") as stream:
        _log_way(stream, motion, road, stated_poses)
        for name in CURVES:
            for series, text, color, width in SERIES:
                style = rr.SeriesLines(colors=color, widths=width, names=text)
                stream.log(f"curves/{name}/{series}", style, static=True)
        for index, stamp in enumerate(drive.stamps):
            stream.set_time(entities.FRAME_TIMELINE, sequence=stamp.index)
            stream.set_time(entities.TIME_TIMELINE, duration=(stamp.timestamp_ns - drive.stamps[0].timestamp_ns) / 1e9)
            _log_frame(stream, motion, drive, road, index)


def _layout(drive: WatchedDrive, road: StitchedRoad) -> Layout:
    height, width = road.image.shape[:2]
    ahead = flat_view(ROAD, "road from above, ahead is up", (0, SIDE), (0, SIDE))
    way = flat_view(WAY, "way", (0, width), (0, height))
    curves = [rrb.TimeSeriesView(origin=f"curves/{name}", name=title) for name, title in CURVES.items()]
    texts = rrb.TextLogView(origin=entities.EVENTS, name="steps that were not measured")
    cameras = {
        camera.name: flat_view(
            f"{CAMERAS}/{camera.name}", camera.name, (0, SHOWN_WIDTH), (0, SHOWN_WIDTH * camera.height / camera.width)
        )
        for camera in drive.rig.cameras
    }
    rows = [rrb.Horizontal(*(cameras[name] for name in row)) for row in camera_rows(drive.rig)]
    middle = rrb.Horizontal(way, ahead, rrb.Vertical(*curves, texts, row_shares=[3, 3, 2]), column_shares=[3, 2, 3])
    return Layout(
        rrb.Vertical(*rows[:1], middle, *rows[1:], row_shares=[1, 2, 1][: len(rows) + 1]),
        rrb.TimePanel(state="collapsed", timeline=entities.TIME_TIMELINE, fps=frame_rate_hz(drive.stamps)),
    )


def _log_way(
    stream: rr.RecordingStream, motion: MeasuredMotion, road: StitchedRoad, stated_poses: Items[Array] | None
) -> None:
    """The stitched road with the whole way."""
    encoded = encode_image(road.image[..., ::-1], quality=JPEG_QUALITY)
    stream.log(f"{WAY}/road", rr.EncodedImage(contents=encoded, media_type="image/jpeg"), static=True)
    if stated_poses is not None:
        moved = np.stack([inverse(stated_poses[0]) @ pose for pose in stated_poses])
        line = rr.LineStrips2D([road.pixels(moved)], colors=STATED_COLOR, radii=rr.Radius.ui_points(2.5))
        stream.log(f"{WAY}/stated", line, static=True)
    pixels = road.pixels(motion.poses)
    line = rr.LineStrips2D([pixels], colors=COLOR, radii=rr.Radius.ui_points(1.2))
    stream.log(f"{WAY}/measured", line, static=True)
    guessed = [pixels[index : index + 2] for index, step in enumerate(motion.steps) if step.reason]
    red = rr.LineStrips2D(guessed, colors=GUESSED_COLOR, radii=rr.Radius.ui_points(2.0))
    stream.log(f"{WAY}/not_measured", red, static=True)


def _log_frame(
    stream: rr.RecordingStream, motion: MeasuredMotion, drive: WatchedDrive, road: StitchedRoad, index: int
) -> None:
    """The road around the vehicle, the vehicle on its way, and the curves of the step that ends here."""
    pose = motion.poses[index]
    ahead = pose @ np.array([[1, 0, 0, 3.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    start, end = road.pixels(np.stack([pose, ahead]))
    radii = rr.Radius.ui_points(3.0)
    vehicle = rr.Arrows2D(origins=[start], vectors=[end - start], colors=entities.EGO_COLOR, radii=radii)
    stream.log(f"{WAY}/vehicle", vehicle)
    stream.log(f"{ROAD}/image", rr.EncodedImage(contents=drive.road[index], media_type="image/jpeg"))
    for name in drive.rig.names if index in drive.images else ():
        contents = drive.images[index].get(name)
        file = rr.EncodedImage(contents=contents, media_type="image/jpeg") if contents else rr.EncodedImage.cleared()
        stream.log(f"{CAMERAS}/{name}/image", file)
    if index == 0:
        return
    for name, (values, deviations) in zip(CURVES, (speeds(motion), yaw_rates_deg(motion)), strict=True):
        value, deviation = float(values[index - 1]), float(deviations[index - 1])
        numbers = {"measured": value, "low": value - deviation, "high": value + deviation}
        for series, number in numbers.items():
            stream.log(f"curves/{name}/{series}", rr.Scalars(number))
    if index in drive.images:
        _log_points(stream, motion.steps[index - 1].seen, drive.rig)
    reason = motion.steps[index - 1].reason
    if reason:
        stream.log(entities.EVENTS, rr.TextLog(f"frame {drive.stamps[index].index}: {reason}", level="WARN"))


def _log_points(stream: rr.RecordingStream, seen: SeenPoints | None, rig: CameraRig) -> None:
    """The points of a step in the images: those of the road blue, matched ones by their residual."""
    for index, camera in enumerate(rig.cameras):
        entity = f"{CAMERAS}/{camera.name}/points"
        if seen is None:
            stream.log(entity, rr.Clear(recursive=False))
            continue
        mine = seen.camera == index
        colors = np.asarray(RESIDUAL_COLORS)[np.digitize(seen.residuals_px[mine], RESIDUALS_PX)]
        colors[seen.is_road[mine]] = ROAD_COLOR
        at = seen.at[mine] * (SHOWN_WIDTH, SHOWN_WIDTH * camera.height / camera.width)
        stream.log(entity, rr.Points2D(at, colors=colors, radii=rr.Radius.ui_points(2.0), draw_order=10))
