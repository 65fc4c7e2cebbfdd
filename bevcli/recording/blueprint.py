"""The layout of a recording in the viewer: cameras above and below scene and BEV; curves and texts to the right."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bevcli.errors import OutputError
from bevcli.frame import FrameStamp
from bevcli.geometry.cameras import CameraRig
from bevcli.parsing.files import plain_name
from bevcli.recording import entities
from bevcli.recording.log_static import COLUMN_WIDTH, LEGEND_COLUMNS, ROW_HEIGHT, Recorded, legend_entries
from bevcli.writing import whole_file

SIDEWAYS = np.pi / 2 + 1e-6  # a camera that looks exactly sideways belongs to the front row
HIDDEN = rrb.EntityBehavior(visible=False)
FROM_START = rrb.VisibleTimeRanges(
    [
        rr.VisibleTimeRange(timeline, start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative())
        for timeline in (entities.TIME_TIMELINE, entities.FRAME_TIMELINE)
    ]
)
EYE_M, LOOK_AT_M = (-15.0, 0.0, 10.0), (8.0, 0.0, 0.0)  # in the ego frame: behind and above, looking ahead
VIEW_MARGIN_M = 36.0  # the BEV view first shows this much around the vehicle, or the grid if it is smaller
WINDOW = (1920, 960)  # pixels of a window that the views fill; in others, the images get thin black borders
TITLE_HEIGHT = 24  # pixels of a view's title
TEXTS_SHARE = 0.23  # of the window's width, for curves and texts
CAMERAS_WIDTH = WINDOW[0] * (1 - TEXTS_SHARE)
LARGEST_CAMERAS_SHARE = 0.62  # of the window's height, for all rows of cameras
MAP_ZOOM = 17.0


def camera_rows(rig: CameraRig) -> tuple[tuple[str, ...], ...]:
    """The camera names of a rig in one or two rows, as `rows_of_largest_images` finds them for the viewer."""
    yaws = {camera.name: camera.yaw for camera in rig.cameras}
    aspect = min(camera.width / camera.height for camera in rig.cameras)
    return rows_of_largest_images(yaws, aspect, CAMERAS_WIDTH, LARGEST_CAMERAS_SHARE * WINDOW[1], TITLE_HEIGHT)


def rows_of_largest_images(
    yaws: Mapping[str, float], aspect: float, width: float, height: float, title_height: float = 0
) -> tuple[tuple[str, ...], ...]:
    """The rows of `rows_by_yaw`, or both in one row, ahead first, if the images are then at least as large.

    yaws: by camera name, radians, in the ego frame. aspect: width / height of the narrowest image. width, height: of
    the area for all cameras, pixels. title_height: of each image's title, pixels.
    """
    rows = rows_by_yaw(yaws)
    one_row = (sum(rows, ()),)
    wide, narrow = (
        min(width / max(map(len, layout)), (height / len(layout) - title_height) * aspect) for layout in (one_row, rows)
    )
    return one_row if wide >= narrow else rows


def rows_by_yaw(yaws: Mapping[str, float]) -> tuple[tuple[str, ...], ...]:
    """Camera names in one or two rows, left to right: those that look ahead, then those that look back.

    In both rows the left side of the vehicle is on the left. yaws: by camera name, radians, in the ego frame.
    """
    ahead = sorted((name for name, yaw in yaws.items() if abs(yaw) <= SIDEWAYS), key=lambda name: -yaws[name])
    back = sorted(yaws.keys() - set(ahead), key=lambda name: yaws[name] % (2 * np.pi))
    return tuple(tuple(row) for row in (ahead, back) if row)


class Layout(rrb.Blueprint):
    """Views in the middle, side panels collapsed.

    rerun writes a blueprint into a stream in memory that refers to itself, so that its two threads and some MB stay as
    long as the process. Call `free` once the blueprint has been sent.
    """

    def __init__(self, views: rrb.Container, time_panel: rrb.TimePanel) -> None:
        panels = rrb.SelectionPanel(state="collapsed"), rrb.BlueprintPanel(state="collapsed")
        super().__init__(views, time_panel, *panels, auto_views=False, auto_layout=False)
        self._streams: list[rr.RecordingStream] = []

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        """Called by rerun when the blueprint is sent."""
        self._streams.append(stream)
        super()._log_to_stream(stream)

    def free(self) -> None:
        """Frees what sending it took, with rerun's next `flush_and_cleanup_orphaned_recordings`."""
        while self._streams:
            self._streams.pop().disconnect()

    @contextmanager
    def saved_to(self, path: Path, application: str) -> Iterator[rr.RecordingStream]:
        """The stream of a recording with this layout, for one block. Frees the layout. Raises OutputError."""
        with whole_file(path) as whole, plain_name(whole) as unfinished, rr.RecordingStream(application) as stream:
            try:
                stream.save(unfinished, default_blueprint=self)
            except RuntimeError as error:
                raise OutputError(f"{path}: the recording cannot be written ({error})") from error
            finally:
                self.free()
            yield stream


def recording_blueprint(recorded: Recorded, *, follows: bool = False) -> Layout:
    """The layout of a recording. follows: the viewer first shows the newest frame, else it plays from the first one."""
    views: rrb.Container = _views(recorded, "", ())
    if names := tuple(recorded.layers):  # a tab for both models, and one for each
        alone = [_views(recorded, name, tuple(other for other in names if other != name)) for name in names]
        views = rrb.Tabs(_views(recorded, " · ".join(names), ()), *alone, active_tab=0)
    return Layout(
        rrb.Horizontal(views, _texts(recorded), column_shares=[1 - TEXTS_SHARE, TEXTS_SHARE]),
        # Playback of "time" runs at the drive's own speed; `fps` is that of the timeline "frame".
        rrb.TimePanel(
            state="collapsed",
            timeline=entities.TIME_TIMELINE,
            fps=frame_rate_hz(recorded.drive.stamps),
            play_state="following" if follows else None,
        ),
    )


def frame_rate_hz(stamps: tuple[FrameStamp, ...]) -> float:
    """Frames per second: 1 / the median time between frames; 2 where there are less than two frames."""
    steps = np.diff([stamp.timestamp_ns for stamp in stamps])
    steps = steps[steps > 0]
    return float(1e9 / np.median(steps)) if len(steps) else 2.0


def camera_row_shares(rig: CameraRig) -> list[float]:
    """The share of the window's height of each row of cameras: images are as wide in all rows as in the longest one."""
    rows = camera_rows(rig)
    image_width = CAMERAS_WIDTH / max(map(len, rows))
    aspects = [min(rig[name].width / rig[name].height for name in row) for row in rows]
    shares = [(image_width / aspect + TITLE_HEIGHT) / WINDOW[1] for aspect in aspects]
    return [min(share, LARGEST_CAMERAS_SHARE / len(rows)) for share in shares]


def _views(recorded: Recorded, title: str, hidden_layers: tuple[str, ...]) -> rrb.Vertical:
    """The cameras above and below scene and BEV. hidden_layers: names of models whose boxes are hidden at first."""
    rig, titled = recorded.drive.rig, f" ({recorded.note})" if recorded.note else ""
    scene, bev = _scene(recorded, titled, hidden_layers), _bev_tabs(recorded, titled, hidden_layers)
    hidden = ("pillars",) if recorded.options.probes else ("pillars", "probes")
    views_of = {}
    for camera in rig.cameras:
        name, sides = camera.name, ((0, camera.width), (0, camera.height))
        overrides = {entities.overlay(name, kind): HIDDEN for kind in hidden}
        overrides |= {entities.layer(entities.camera(name), layer): HIDDEN for layer in hidden_layers}
        views_of[name] = flat_view(entities.camera(name), name, *sides, overrides=overrides)
    rows = [rrb.Horizontal(*map(views_of.__getitem__, row), name="cameras") for row in camera_rows(rig)]
    heights = camera_row_shares(rig)
    shares = [*heights[:1], 1 - sum(heights), *heights[1:]]
    middle = rrb.Horizontal(scene, bev, column_shares=[5, 3])
    return rrb.Vertical(*rows[:1], middle, *rows[1:], row_shares=shares, name=title or None)


def _scene(recorded: Recorded, titled: str, hidden_layers: tuple[str, ...]) -> rrb.Spatial3DView:
    lines = (*sorted(result.kind for result in recorded.results), entities.FUTURES)
    boxes = ("boxes", "ground_truth", entities.IMAGE_BOXES, entities.MODELS)
    drawn_in_images = (*boxes, entities.NO_IMAGE, "pillars", "probes", *lines)
    overlays = [entities.overlay(name, kind) for name in recorded.drive.rig.names for kind in drawn_in_images]
    # A map lies on the ground in place of the BEV features.
    hidden = [entities.PILLARS, *([entities.BEV_ON_GROUND] if recorded.map_classes else [])]
    hidden += [entities.layer(entities.WORLD, layer) for layer in hidden_layers]
    return rrb.Spatial3DView(
        origin=entities.EGO,  # drawn in the ego frame, so the view follows the vehicle
        contents=[f"/{entities.WORLD}/**", *(f"- /{overlay}/**" for overlay in overlays)],
        name=f"3D scene{titled}",
        background=list(entities.BACKGROUND),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=EYE_M, look_target=LOOK_AT_M, eye_up=(0, 0, 1)),
        overrides={entities.TRAJECTORY: [FROM_START], **{entity: [HIDDEN] for entity in hidden}},
    )


def _bev_tabs(recorded: Recorded, titled: str, hidden_layers: tuple[str, ...]) -> rrb.Tabs:
    margin = min(VIEW_MARGIN_M, recorded.grid.nearest_side_m if recorded.grid else VIEW_MARGIN_M)

    features, history, segmentation = entities.BEV_FEATURES, entities.BEV_HISTORY, entities.BEV_SEGMENTATION
    hidden = {f"BEV{titled}": (features, history)}
    if recorded.config is not None:
        hidden |= {"BEV features": (history, segmentation), "History weight": (features, segmentation)}
    overrides = {entities.layer(entities.BEV, layer): HIDDEN for layer in hidden_layers}
    tabs: list[rrb.View] = []
    for name, without in hidden.items():
        contents = [f"/{entities.BEV}/**", *(f"- /{entity}/**" for entity in without)]
        ranges = (-margin, margin), (-margin, margin)
        tabs.append(flat_view(entities.BEV, name, *ranges, contents=contents, overrides=overrides))
    if recorded.drive.facts.geo_origin is not None:
        tabs.append(
            rrb.MapView(
                origin=entities.MAP,
                name="Street map",
                zoom=MAP_ZOOM,
                background=rrb.MapProvider.OpenStreetMap,
                overrides={entities.MAP_ROUTE: [FROM_START]},
            )
        )
    return rrb.Tabs(*tabs, active_tab=0)


def _texts(recorded: Recorded) -> rrb.Vertical:
    corner = rrb.PlotLegend(rrb.Corner2D.LeftTop)
    counted = "Boxes per model" if recorded.layers else "Boxes per class"
    curves = {"Speed": entities.SPEED_CURVE, counted: entities.BOX_CURVES}
    if recorded.config is not None:
        curves["Seconds per stage"] = entities.STAGE_CURVES
    plots = [rrb.TimeSeriesView(origin=entity, name=name, plot_legend=corner) for name, entity in curves.items()]
    columns = rrb.TextLogColumns(timeline_columns=[], text_log_columns=["loglevel", "body"])
    events = rrb.TextLogView(origin=entities.EVENTS, name="Events", columns=columns)
    about = rrb.TextDocumentView(origin=entities.RUN, name="About")
    legend_rows = -(-len(legend_entries(recorded)) // LEGEND_COLUMNS)
    sides = (0, LEGEND_COLUMNS * COLUMN_WIDTH), (0, legend_rows * ROW_HEIGHT)
    legend = flat_view(entities.LEGEND, "Legend", *sides)
    pages = rrb.Tabs(events, about, active_tab=0)
    return rrb.Vertical(rrb.Tabs(*plots, active_tab=0), legend, pages, row_shares=[3, 3, 4])


def flat_view(
    origin: str, name: str, x_range: tuple[float, float], y_range: tuple[float, float], **options: Any
) -> rrb.Spatial2DView:
    """A 2D view of an entity that first shows these ranges. options: of `rrb.Spatial2DView`."""
    bounds = rrb.VisualBounds2D(x_range=x_range, y_range=y_range)
    return rrb.Spatial2DView(
        origin=origin, name=name, background=list(entities.BACKGROUND), visual_bounds=bounds, **options
    )
