"""The rows that are written once: rig, vehicle, range rings, pillars, colours, legend, the page "About"."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bevcli._version import __version__
from bevcli.frame import DriveFacts, FrameResult, FrameStamp
from bevcli.geometry.bev_grid import BevGrid, rectangle
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.object_classes import NUSCENES_CLASSES, Color, ObjectClass, hex_of_color
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.model.config import ModelConfig
from bevcli.printing import counted
from bevcli.recording import RecordingOptions, entities
from bevcli.recording.entities import log, packed
from bevcli.recording.log_cameras import labels_2d
from bevcli.recording.meshes import Mesh, VehicleMesh, default_vehicle

UNTRAINED = "untrained weights"
FROM_RENDERED = "trained on renderings"
WARNINGS = {
    UNTRAINED: "The weights are UNTRAINED: boxes and maps are meaningless.",
    FROM_RENDERED: "The weights were trained on rendered streets; these images are not rendered.",
}
RING_STEP_M = 10
DEFAULT_RANGE_M = 50.0  # of the range rings without a model
FRUSTUM_LENGTH_M = 0.55  # longer frusta would hide the vehicle from the eye behind it
PILLARS_PER_SIDE = 25  # more pillars than this along one side of the grid would hide the image
LABELS_ALONE = """\
- **Labels** have the colour of their class. The front face is crossed; from above, a line points to the front.
- **Trails** are the last 5 s of a labelled object and, fainter, the next second at its velocity.
"""
TWO_MODELS = """\
- **Boxes** have the colour of their model, that of the legend. The front face is crossed; from above, a line points to
  the front. The first tab shows both models, each further one a model alone.
- **Ground truth** is pale.
"""
HOW_TO_READ = """\
- **Predicted boxes** have the colour of their class. The front face is crossed; from above, a line points to the front.
- **Ground truth** is pale where a prediction matches it or no camera looks, and red where it was missed. Classes that
  are not scored are grey.
- **False positives** are crossed out in red: no ground truth of their class is within 2 m.
- **Duplicates**, a second box on an object, have one grey diagonal.
- **Boxes where no camera looks** are not shown, but for those of a track that was in view within the last 3 s: their
  label says "out of view".
- **Tracks** have a number in their label and a trail: the last 5 s, and, fainter, the next second at the predicted
  velocity. Each is an entity below `world/tracks`; select it there or by a click on its trail.
"""
OF_A_MODEL = """\
- **Lines on the ground**, of a model that has them: lines of the map in the colours of the legend; the futures of each
  box in its colour, fainter with time and for modes with lower scores; planned paths, that of the given command as a
  ribbon.
- **The ground** shows the segmentation, if the model has one. For the BEV features click the eyes next to `bev_map` and
  `segmentation`, below `ego` in the left panel.
- **Pillars** are the 3D reference points of the BEV cells, coloured by height from blue to red. They are hidden at
  first: click the eye next to `pillars` in the left panel.
"""
LEGEND_COLUMNS = 2
COLUMN_WIDTH, ROW_HEIGHT = 9.0, 1.0  # in the units of the view
LETTER_WIDTH = 0.27  # of the same, in a window of 1920 pixels


class RecordedModel(Protocol):
    """The facts about a model that go into a recording."""

    @property
    def config(self) -> ModelConfig:
        """The model's configuration; its name and its classes are written."""

    @property
    def untrained(self) -> bool:
        """True for random weights. Then titles, events and the page "About" say so."""

    @property
    def bundled(self) -> bool:
        """True for the weights of the package. Titles and events say so where the drive is not a rendered one."""


@dataclass(frozen=True)
class RecordedBoxes:
    """Boxes that are recorded in place of a model's: those of one file against the labels, of two files, or labels."""

    names: tuple[str, ...] = ()  # of the files, at most two; none for labels alone
    classes: Mapping[str, ObjectClass] = field(default_factory=lambda: NUSCENES_CLASSES)  # by name, which are scored
    # by class, the distance from the ego vehicle below which misses and false positives are marked
    ranges_m: Mapping[str, float] = field(default_factory=dict)
    untrained: bool = False  # whether random weights made the boxes
    map_classes: tuple[str, ...] = ()  # of the map that is part of the labels


class RecordedDrive(Protocol):
    """The facts about a drive that go into a recording: those of a `Drive`, or of a `Session`."""

    name: str
    rig: CameraRig
    has_ego_motion: bool
    facts: DriveFacts

    @property
    def stamps(self) -> tuple[FrameStamp, ...]:
        """The frames that are known in advance; their rate is written."""


@dataclass(frozen=True)
class Recorded:
    """A drive, the model that runs on it or boxes of files, and how much of both a recording holds."""

    drive: RecordedDrive
    model: RecordedModel | RecordedBoxes
    options: RecordingOptions

    @property
    def config(self) -> ModelConfig | None:
        """The model's configuration; None without a model."""
        return None if isinstance(self.model, RecordedBoxes) else self.model.config

    @property
    def files(self) -> RecordedBoxes | None:
        """The boxes of files; None of a model."""
        return self.model if isinstance(self.model, RecordedBoxes) else None

    @property
    def layers(self) -> Mapping[str, Color]:
        """The names of two models that are compared, and their colours; none for one model or labels alone."""
        names = self.files.names if self.files else ()
        return dict(zip(names, entities.LAYER_COLORS, strict=True)) if len(names) > 1 else {}

    @property
    def title(self) -> str:
        """The drive and the model."""
        names = self.config.name if self.config else " · ".join(self.files.names if self.files else ()) or "labels"
        return f"{self.drive.name} · {names}"

    @property
    def object_classes(self) -> Mapping[str, ObjectClass]:
        """The classes of the boxes, by name."""
        if self.config is not None:
            return self.config.object_classes
        return self.files.classes if self.files else {}

    @property
    def grid(self) -> BevGrid | None:
        """The model's BEV grid; None without a model."""
        return self.config.bev_grid if self.config else None

    @property
    def results(self) -> Mapping[type[FrameResult], tuple[str, ...]]:
        """Types of the model's further results, with their names."""
        return self.config.results if self.config else {}

    @property
    def note(self) -> str:
        """A note on the weights for the titles of the views, "" for none: a key of WARNINGS."""
        if self.model.untrained:
            return UNTRAINED
        is_bundled = not isinstance(self.model, RecordedBoxes) and self.model.bundled
        return FROM_RENDERED if is_bundled and not self.drive.facts.rendered else ""

    @cached_property
    def classes(self) -> Mapping[str, Color]:
        """The classes of the boxes and their colours."""
        return entities.class_colors(self.object_classes.values())

    @property
    def map_classes(self) -> tuple[str, ...]:
        """The classes of the map that is written; none without a map."""
        if self.files is not None:
            return self.files.map_classes
        return tuple(self.config.map_classes) if self.config and self.options.shows_internals else ()


def log_scene(
    stream: rr.RecordingStream,
    rig: CameraRig,
    classes: Mapping[str, Color],
    vehicle: VehicleMesh | None = None,
    grid: BevGrid | None = None,
) -> None:
    """Writes the class colours, the pinholes, the vehicle and the range rings.

    vehicle: in the ego frame; None draws the default car. grid: of the model: its border is drawn, and no range ring is
    larger; None draws rings up to 50 m.
    """
    stream.log(entities.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    infos = [rr.AnnotationInfo(id=i + 1, label=n, color=color) for i, (n, color) in enumerate(classes.items())]
    stream.log("/", rr.AnnotationContext([rr.AnnotationInfo(id=0, label="other"), *infos]), static=True)
    for camera in rig.cameras:
        pinhole = rr.Pinhole(
            image_from_camera=camera.intrinsics,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=FRUSTUM_LENGTH_M,
            color=[*entities.EGO_COLOR, 160],
            line_width=0.01,
        )
        stream.log(entities.camera(camera.name), pinhole, static=True)
    vehicle = default_vehicle() if vehicle is None else vehicle
    log_mesh(stream, entities.VEHICLE, vehicle.mesh)
    strips = [bev_image_points(rig, strip) for strip in vehicle.top_view]
    stream.log(entities.BEV_VEHICLE, rr.LineStrips2D(strips, colors=entities.EGO_COLOR, draw_order=40), static=True)
    distances, width = ring_distances_m(grid), rr.Radius.ui_points(0.6)
    rings, lines = range_rings(grid), range_lines(rig, grid)
    in_space = [np.column_stack([line, np.zeros(len(line))]) for line in lines]
    stream.log(
        entities.RANGE_RINGS, rr.LineStrips3D(in_space, colors=[*entities.RING_COLOR, 140], radii=width), static=True
    )
    flat = [bev_image_points(rig, line) for line in lines]
    stream.log(
        entities.BEV_RINGS, rr.LineStrips2D(flat, colors=entities.RING_COLOR, radii=width, draw_order=5), static=True
    )
    # The labels are on the circles, ahead to the right, where they cover little.
    positions = [bev_image_points(rig, ring[[105]])[0] for ring in rings]
    labels = labels_2d(
        positions, [f"{distance} m" for distance in distances], colors=entities.RING_LABEL_COLOR, draw_order=6
    )
    log(stream, f"{entities.BEV_RINGS}/labels", labels, static=True)


def log_about(stream: rr.RecordingStream, recorded: Recorded) -> None:
    """Writes the page "About", the legend in columns, and the facts of the run that readers of the file need."""
    cameras, untrained = recorded.drive.rig.names, recorded.model.untrained
    title, maps = recorded.title, recorded.map_classes
    of_map: dict[str, Any] = {"map_classes": list(maps)} if maps else {}
    for kind, entries in (("line", dict(line_entries(recorded.config))), ("layer", recorded.layers)):
        if entries:
            of_map |= {f"{kind}_names": list(entries), f"{kind}_colors": list(map(hex_of_color, entries.values()))}
    details = rr.AnyValues(
        title=title,
        untrained=untrained,
        note=recorded.note,
        score=recorded.options.score,
        class_names=list(recorded.classes),
        class_colors=list(map(hex_of_color, recorded.classes.values())),
        camera_names=list(cameras),
        **of_map,
    )
    warning = "**The weights are untrained: boxes and maps are meaningless.**\n\n" if untrained else ""
    files = recorded.files
    is_scored = files is None or bool(files.names)
    scores = f" Boxes with a score of {recorded.options.score:g} or more are shown." if is_scored else ""
    summary = f"bevcli {__version__}; {counted(len(cameras), 'cameras')}: {', '.join(cameras)}.{scores}\n"
    how = HOW_TO_READ + (OF_A_MODEL if files is None else "")
    if files is not None and len(files.names) != 1:
        how = TWO_MODELS if files.names else LABELS_ALONE
    page = rr.TextDocument(f"# {title}\n\n{warning}{summary}\n{how}", media_type="text/markdown")
    stream.log(entities.RUN, page, details, static=True)
    legend = legend_entries(recorded)
    rows = -(-len(legend) // LEGEND_COLUMNS)
    spots = np.array([(i // rows * COLUMN_WIDTH, (i % rows + 0.5) * ROW_HEIGHT) for i in range(len(legend))])
    texts, colors_of_entries = zip(*legend, strict=True)
    circles = rr.Points2D(spots + (0.5, 0), colors=colors_of_entries, radii=rr.Radius.ui_points(6.0))
    stream.log(f"{entities.LEGEND}/colors", circles, static=True)
    halves = np.array([len(text) * LETTER_WIDTH / 2 for text in texts])  # a label is centred below its point
    places = spots + np.stack([1.05 + halves, np.full(len(texts), -0.25)], axis=-1)
    labels = labels_2d(places, list(texts), colors=entities.TEXT_COLOR)
    log(stream, f"{entities.LEGEND}/texts", labels, static=True)


def log_pillars(
    stream: rr.RecordingStream, grid: BevGrid, ego_from_bev: Array, *, all_cells: bool
) -> tuple[Array, NDArray[np.uint32]]:
    """Writes the 3D reference points of the grid's pillars into the scene, coloured by height from blue to red.

    At most PILLARS_PER_SIDE pillars along each side of the grid, evenly spaced, unless `all_cells`.

    Returns the points (K, 3) in the bev frame, and their colours (K,) of `packed`.
    """
    steps = [1 if all_cells else max(1, -(-side // PILLARS_PER_SIDE)) for side in (grid.rows, grid.columns)]
    pillars = grid.pillars()[steps[0] // 2 :: steps[0], steps[1] // 2 :: steps[1]].reshape(-1, grid.pillar_points, 3)
    of_pillar = entities.colormap(np.linspace(0.1, 0.95, grid.pillar_points), "turbo")
    colors, points = np.tile(of_pillar, (len(pillars), 1)), apply(ego_from_bev, pillars).reshape(-1, 3)
    stream.log(entities.PILLARS, rr.Points3D(points, colors=colors, radii=rr.Radius.ui_points(1.5)), static=True)
    return pillars.reshape(-1, 3), packed(colors)


def log_mesh(stream: rr.RecordingStream, entity: str, mesh: Mesh) -> None:
    """Writes the triangles of a mesh as an entity that does not change."""
    vertices, normals, faces, colors = mesh
    archetype = rr.Mesh3D(
        vertex_positions=vertices, vertex_normals=normals, triangle_indices=faces, vertex_colors=colors
    )
    stream.log(entity, archetype, static=True)


def ring_distances_m(grid: BevGrid | None) -> list[int]:
    """The radii of the range rings: every 10 m up to the nearest side of the grid."""
    reach = DEFAULT_RANGE_M if grid is None else grid.nearest_side_m
    return list(range(RING_STEP_M, int(reach) + 1, RING_STEP_M))


def range_rings(grid: BevGrid | None) -> list[Array]:
    """The range rings, (P, 2) each on the ground of the ego frame, metres."""
    angles = np.linspace(0, 2 * np.pi, 121)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return [circle * distance for distance in ring_distances_m(grid)]


def range_lines(rig: CameraRig, grid: BevGrid | None) -> list[Array]:
    """The range rings and the border of the grid, as `range_rings`."""
    rings = range_rings(grid)
    if grid is None:
        return rings
    border = rectangle(grid.x_range_m, grid.y_range_m)[[0, 1, 2, 3, 0]]
    return [*rings, apply(rig.ego_from_bev, border)[:, :2]]


def bev_image_points(rig: CameraRig, points_ego: Array) -> Array:
    """Points (K, 2) on the ground in the ego frame -> (K, 2) in the flat BEV image: x to the right, -y down, metres."""
    points = apply(inverse(rig.ego_from_bev), np.column_stack([points_ego, np.zeros(len(points_ego))]))
    return points[:, :2] * (1, -1)


def legend_entries(recorded: Recorded) -> list[tuple[str, Color]]:
    """The texts and colours of the legend: of objects, of map classes if there is a map, and of `line_entries`."""
    truth = ("ground truth", entities.GROUND_TRUTH_COLOR)
    maps = [
        (f"map: {name.replace('_', ' ')}", color) for name, color in entities.map_colors(recorded.map_classes).items()
    ]
    if recorded.layers:
        return [*recorded.layers.items(), truth, *maps]
    of_classes = [(name.replace("_", " "), color) for name, color in recorded.classes.items()]
    if recorded.files and not recorded.files.names:
        return [*of_classes, *maps]
    states = [truth, ("missed, false", entities.MISSED_COLOR), ("duplicate", entities.DUPLICATE_COLOR)]
    return [*of_classes, *states, *maps, *line_entries(recorded.config)]


def line_entries(config: ModelConfig | None) -> list[tuple[str, Color]]:
    """The texts and colours of the lines on the ground that a model finds; none without a model."""
    if config is None:
        return []
    of_results = [entry for cls, names in config.results.items() for entry in cls.legend(names).items()]
    return [*of_results, *([("futures: colour of the box", entities.TEXT_COLOR)] if config.future_times_s else [])]
