"""The layout of a recording in the viewer: cameras above and below; scene, BEV, curves and events in the middle."""

from __future__ import annotations

import rerun as rr
import rerun.blueprint as rrb

from bevcli.geometry.cameras import CameraRig
from bevcli.recording import entities
from bevcli.recording.camera_layout import camera_rows

HIDDEN = rrb.EntityBehavior(visible=False)
EYE_M, LOOK_AT_M = (-15.0, 0.0, 10.0), (8.0, 0.0, 0.0)  # in the ego frame: behind and above, looking ahead
BACKGROUND = [18, 20, 25]
VIEW_MARGIN_M = 36.0  # the BEV view first shows this much around the vehicle


def recording_blueprint(rig: CameraRig, note: str = "", probes: bool = False) -> rrb.Blueprint:
    """The layout for a rig.

    note: is added to the titles of the main views ("untrained weights"). probes: whether probes are shown at first.
    """
    titled = f" ({note})" if note else ""
    middle = rrb.Horizontal(_scene(rig, titled), _bev_tabs(titled), _curves(), column_shares=[5, 4, 3])
    rows = [
        rrb.Horizontal(*(_camera(rig, name, probes=probes) for name in row), name="cameras") for row in camera_rows(rig)
    ]
    if len(rows) == 1:
        layout = rrb.Vertical(rows[0], middle, row_shares=[2, 4])
    else:
        layout = rrb.Vertical(rows[0], middle, rows[1], row_shares=[3, 5, 3])
    return rrb.Blueprint(
        layout,
        rrb.TimePanel(state="collapsed", timeline=entities.TIME_TIMELINE),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _scene(rig: CameraRig, titled: str) -> rrb.Spatial3DView:
    drawn_in_images = ("boxes", "ground_truth", "pillars", "probes")
    excluded = [f"- /{entities.overlay(name, kind)}/**" for name in rig.names for kind in drawn_in_images]
    from_start = [
        rr.VisibleTimeRange(timeline, start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative())
        for timeline in (entities.TIME_TIMELINE, entities.FRAME_TIMELINE)
    ]
    return rrb.Spatial3DView(
        origin=entities.EGO,  # drawn in the ego frame, so the view follows the vehicle
        contents=[f"/{entities.WORLD}/**", *excluded],
        name=f"3D scene{titled}",
        background=BACKGROUND,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=EYE_M, look_target=LOOK_AT_M, eye_up=(0, 0, 1)),
        overrides={
            entities.TRAJECTORY: [rrb.VisibleTimeRanges(from_start)],
            entities.PILLARS: [HIDDEN],
        },
    )


def _bev_tabs(titled: str) -> rrb.Tabs:
    around = rrb.VisualBounds2D(x_range=[-VIEW_MARGIN_M, VIEW_MARGIN_M], y_range=[-VIEW_MARGIN_M, VIEW_MARGIN_M])

    def view(name: str, *without: str) -> rrb.Spatial2DView:
        contents = [f"/{entities.BEV}/**", *(f"- /{entity}/**" for entity in without)]
        return rrb.Spatial2DView(
            origin=entities.BEV, contents=contents, name=name, background=BACKGROUND, visual_bounds=around
        )

    features, history, segmentation = entities.BEV_FEATURES, entities.BEV_HISTORY, entities.BEV_SEGMENTATION
    return rrb.Tabs(
        view(f"BEV{titled}", features, history),
        view("BEV features", history, segmentation),
        view("History weight", features, segmentation),
        active_tab=0,
    )


def _curves() -> rrb.Vertical:
    legend = rrb.PlotLegend(rrb.Corner2D.LeftTop)
    times = rrb.TimeSeriesView(origin=entities.STAGE_CURVES, name="Seconds per stage", plot_legend=legend)
    counts = rrb.TimeSeriesView(origin=entities.BOX_CURVES, name="Boxes per class", plot_legend=legend)
    columns = rrb.TextLogColumns(timeline_columns=[], text_log_columns=["loglevel", "body"])
    events = rrb.TextLogView(origin=entities.EVENTS, name="Events", columns=columns)
    about = rrb.TextDocumentView(origin=entities.RUN, name="About")
    return rrb.Vertical(rrb.Tabs(times, counts, active_tab=0), rrb.Tabs(events, about, active_tab=0), row_shares=[3, 2])


def _camera(rig: CameraRig, name: str, *, probes: bool) -> rrb.Spatial2DView:
    hidden = ("pillars",) if probes else ("pillars", "probes")
    camera = rig[name]
    return rrb.Spatial2DView(
        origin=entities.camera(name),
        name=name,
        background=BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(x_range=[0, camera.width], y_range=[0, camera.height]),
        overrides={entities.overlay(name, kind): HIDDEN for kind in hidden},
    )
