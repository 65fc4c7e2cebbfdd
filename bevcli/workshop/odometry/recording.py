"""odometry.rrd: the way on the road, the road from above frame by frame, images, and the curves, for `bevcli viz`."""

from collections.abc import Sequence as Items
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Array, inverse
from bevcli.parsing.images import encode_image
from bevcli.recording import entities
from bevcli.recording.blueprint import Layout, camera_rows, flat_view, frame_rate_hz
from bevcli.workshop.odometry.measure import MeasuredMotion
from bevcli.workshop.odometry.picture import JPEG_QUALITY, SHOWN_WIDTH, SIDE, StitchedRoad, WatchedDrive
from bevcli.workshop.odometry.report import speeds, yaw_rates_deg
from bevcli.workshop.odometry.steps import SeenPoints

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
