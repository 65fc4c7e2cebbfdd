"""Write boxes into a recording: in the 3D scene, in the BEV view, on the street map, and the trails of their tracks.

It finds misses and duplicates.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from bevcli.frame import Frame, FrameStamp, Prediction
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import (
    MATCH_DISTANCE_M,
    OPTIONAL_COLUMNS,
    Boxes2D,
    Boxes3D,
    ScoredBoxes,
    descending_scores,
    match_greedily,
)
from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array, GeoOrigin, apply
from bevcli.recording import entities
from bevcli.recording.entities import Components, any_values, components, line_strips, log, ui_points

OF_COCO = {"person": "pedestrian"}  # classes of boxes in images that are called otherwise in the scene
LABELS_IN_SCENE = 10  # only the nearest boxes are labelled
MOVING_M_S = 0.5  # slower objects get no velocity arrow
THIN, THICK = ui_points(0.8), ui_points(1.6)
PAST_S = 5.0  # length of a trail
AHEAD_S = 1.0  # how far ahead a trail shows where the object will be at its present velocity
LOST_S = 3.0  # the trail of a track that had no box for so long is forgotten
PAST_OPACITY, AHEAD_OPACITY = 220, 110  # of 255
ABOVE_GROUND_M = 0.05
TRAIL_WIDTH = ui_points(1.2)


def detectable(ground_truth: Boxes3D, grid: BevGrid | None) -> Boxes3D:
    """The ground-truth boxes, in the bev frame, that a model can find: inside its grid, with sensor points if known.

    grid: None where no model is known.
    """
    everywhere = np.ones(len(ground_truth), dtype=bool)
    inside = everywhere if grid is None else (grid.cell_of(ground_truth.centers[:, :2]) >= 0).all(-1)
    points = ground_truth.num_points
    seen = everywhere if points is None else points != 0
    return ground_truth[inside & seen]


class Marks(NamedTuple):
    """N predicted boxes against M ground-truth boxes."""

    false: NDArray[np.bool_]  # (N,) bool, the false positives: crossed out in red
    duplicate: NDArray[np.bool_]  # (N,) bool, a second box on an object: one grey diagonal
    found: NDArray[np.bool_]  # (M,) bool, the ground truth that a prediction matches


def false_and_duplicate(predictions: Boxes3D, ground_truth: Boxes3D | None) -> Marks:
    """The marks of predictions against the ground truth.

    A duplicate is no true positive, and either the tracker marked it, or the ground truth of its class within 2 m was
    found by a better box. Without ground truth no box is a false positive, and the tracker's marks are returned.
    """
    none = np.zeros(len(predictions), dtype=bool)
    marked = none if predictions.duplicates is None else predictions.duplicates
    if ground_truth is None:
        return Marks(none, marked, np.zeros(0, dtype=bool))
    true, is_found = true_positives(predictions, ground_truth)
    truths = ground_truth[is_found]
    away = np.linalg.norm(predictions.centers[:, None, :2] - truths.centers[:, :2], axis=-1)  # (N, M)
    near = (away < MATCH_DISTANCE_M) & (predictions.classes[:, None] == truths.classes)
    duplicate = ~true & (marked | near.any(-1))
    return Marks(~true & ~duplicate, duplicate, is_found)


def marks_within(
    predictions: Boxes3D, ground_truth: Boxes3D, near: NDArray[np.bool_], near_truth: NDArray[np.bool_]
) -> Marks:
    """The marks of the boxes that are scored, near (N,) and near_truth (M,); ground truth beyond counts as found."""
    inside = false_and_duplicate(predictions[near], ground_truth[near_truth])
    marks = Marks(np.zeros_like(near), np.zeros_like(near), np.ones_like(near_truth))
    marks.false[near], marks.duplicate[near], marks.found[near_truth] = inside
    return marks


def true_positives(predictions: Boxes3D, ground_truth: Boxes3D) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Match predictions (N,) and ground truth (M,) of one frame as `bevcli eval` does, at 2 m.

    Returns (N,) bool, the true positives, and (M,) bool, the ground truth that is found. Predictions without scores
    count as equal.
    """
    is_true, is_found = np.zeros(len(predictions), dtype=bool), np.zeros(len(ground_truth), dtype=bool)
    order = descending_scores(np.ones(len(predictions)) if predictions.scores is None else predictions.scores)
    names = np.concatenate([ground_truth.classes, predictions.classes[order]])
    # Boxes of different classes match as little as those of different frames.
    frames = np.split(np.unique(names, return_inverse=True)[1], [len(ground_truth)])
    sides = zip((ground_truth, predictions[order]), frames, strict=True)
    truths, best_first = (ScoredBoxes(boxes, index, np.zeros(len(boxes))) for boxes, index in sides)
    matched = match_greedily(truths, best_first, (MATCH_DISTANCE_M,))[0]
    is_true[order[matched >= 0]] = True
    is_found[matched[matched >= 0]] = True
    return is_true, is_found


def box_colors(boxes: Boxes3D | Boxes2D, classes: Mapping[str, Color]) -> np.ndarray:
    """(N, 3) uint8 RGB: the colour of each box's class."""
    other = entities.index_color(len(classes))
    names = [OF_COCO.get(name, name) for name in boxes.classes.tolist()]
    return np.array([classes.get(name, other) for name in names], dtype=np.uint8).reshape(-1, 3)


def image_box_colors(
    prediction: Prediction, frame: Frame, seen: Mapping[str, Boxes2D], least: float, classes: Mapping[str, Color]
) -> dict[str, np.ndarray]:
    """Camera -> (N, 3) colours of boxes in its image: bright where no box of the model explains one, else half as much.

    least: score of the model's boxes.
    """
    from bevcli.workshop.trust.sightings import unexplained

    boxes = prediction.boxes_ego.scored(least).transformed(frame.world_from_ego.matrix)
    lonely = unexplained(frame, boxes, seen, prediction.object_classes)
    shades = {name: np.where(each, 1.0, 0.5)[:, None] for name, each in lonely.items()}
    return {name: (box_colors(each, classes) * shades[name]).astype(np.uint8) for name, each in seen.items()}


def log_boxes_3d(
    stream: rr.RecordingStream,
    boxes: Boxes3D,
    corners: Array,
    marks: Marks,
    classes: Mapping[str, Color],
    labels: list[str],
) -> None:
    """Write predicted boxes into the scene: boxes, velocity arrows, marks of false positives and duplicates.

    boxes: N in the recording's world. corners: (N, 8, 3) of these. labels: of the N boxes, "" for none.
    """
    ids_of_classes = {name: index for index, name in enumerate(classes, 1)}
    ids = np.array([ids_of_classes.get(name, 0) for name in boxes.classes.tolist()])
    row = _solid(boxes, class_ids=ids, labels=labels, show_labels=True, radii=THICK)
    columns = {column.recorded: getattr(boxes, name) for name, column in OPTIONAL_COLUMNS.items() if column.recorded}
    if boxes.scores is None:
        columns[OPTIONAL_COLUMNS["scores"].recorded] = np.ones(len(boxes))
    details = any_values(
        velocity_x=boxes.velocities[:, 0],
        velocity_y=boxes.velocities[:, 1],
        name=boxes.classes,
        **{name: values for name, values in columns.items() if values is not None},
    )
    log(stream, entities.BOXES, row | details)
    moving = np.linalg.norm(boxes.velocities, axis=-1) > MOVING_M_S
    arrows = components(
        rr.Arrows3D,
        vectors=np.pad(boxes.velocities[moving], ((0, 0), (0, 1))),
        origins=boxes.centers[moving],
        colors=box_colors(boxes, classes)[moving],
        radii=ui_points(1.2),
    )
    log(stream, entities.VELOCITY, arrows)
    marked = zip((entities.FALSE_BOXES, entities.DUPLICATES), _marks(corners, marks), strict=True)
    for entity, (strips, color) in marked:
        log(stream, entity, components(rr.LineStrips3D, strips=strips, colors=color, radii=THICK))


def log_boxes_bev(
    stream: rr.RecordingStream, boxes: Boxes3D, corners: Array, marks: Marks, colors: NDArray[np.uint8]
) -> None:
    """Write predicted boxes into the BEV view. boxes: N in the bev frame. corners: (N, 8, 3). colors: (N, 3)."""
    doubled = np.concatenate([colors, colors])
    outlines = components(rr.LineStrips2D, strips=footprints(corners), colors=doubled, radii=THICK, draw_order=30)
    log(stream, entities.BEV_BOXES, outlines)
    moving = np.linalg.norm(boxes.velocities, axis=-1) > MOVING_M_S
    arrows = components(
        rr.Arrows2D,
        vectors=boxes.velocities[moving] * (1, -1),
        origins=boxes.centers[moving, :2] * (1, -1),
        colors=colors[moving],
        radii=ui_points(1.0),
        draw_order=31,
    )
    log(stream, entities.BEV_VELOCITY, arrows)
    marked = zip((entities.BEV_FALSE, entities.BEV_DUPLICATES), _marks(corners, marks), strict=True)
    for entity, (strips, color) in marked:
        flat = (strips[..., :2] * (1, -1)).astype(np.float32)
        log(stream, entity, components(rr.LineStrips2D, strips=flat, colors=color, radii=THIN, draw_order=32))


def log_layer(
    stream: rr.RecordingStream, name: str, boxes: Boxes3D, corners_bev: Array, color: Color, labels: list[str]
) -> None:
    """Write the boxes of one of two models, all in its colour, into the scene and into the BEV view.

    boxes: N in the recording's world. corners_bev: (N, 8, 3) in the bev frame. labels: of the N boxes, "" for none.
    """
    row = _solid(boxes, colors=color, labels=labels, show_labels=True, radii=THICK)
    log(stream, entities.layer(entities.WORLD, name), row | any_values(name=boxes.classes))
    outlines = components(rr.LineStrips2D, strips=footprints(corners_bev), colors=color, radii=THICK, draw_order=30)
    log(stream, entities.layer(entities.BEV, name), outlines)


def other_classes(truth: Boxes3D, classes: Iterable[str]) -> np.ndarray:
    """(M,) bool, ground-truth boxes of classes that the model does not have: they are never missed."""
    return ~np.isin(truth.classes, list(classes))


def ground_truth_colors(is_found: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(M, 3) uint8 colours of ground-truth boxes: pale where found, red where missed, grey for other classes.

    found: (M,) bool. other: (M,) bool, classes that are not among the model's.
    """
    colors = np.where(is_found[:, None], entities.GROUND_TRUTH_COLOR, entities.MISSED_COLOR)
    return np.where(other[:, None], entities.OTHER_COLOR, colors).astype(np.uint8).reshape(-1, 3)


def log_ground_truth(
    stream: rr.RecordingStream, in_world: Boxes3D, corners_bev: Array, is_found: np.ndarray, colors: np.ndarray
) -> None:
    """Write ground-truth boxes into the scene and into the BEV view; found and missed ones are two entities.

    in_world: M in the recording's world. corners_bev: (M, 8, 3) in the bev frame. found: (M,) bool. colors: (M, 3)
    uint8.
    """
    pale = np.insert(colors[is_found], 3, 150, axis=1)
    for entity, entity_bev, selection, color in (
        (entities.GROUND_TRUTH, entities.BEV_GROUND_TRUTH, is_found, pale),
        (entities.MISSED, entities.BEV_MISSED, ~is_found, entities.MISSED_COLOR),
    ):
        boxes, strips = in_world[selection], footprints(corners_bev[selection])
        log(stream, entity, _solid(boxes, colors=color, radii=THIN) | any_values(name=boxes.classes))
        doubled = np.tile(np.insert(colors[selection], 3, 200, axis=1), (2, 1))
        log(stream, entity_bev, components(rr.LineStrips2D, strips=strips, colors=doubled, radii=THIN, draw_order=20))


def footprints(corners: Array) -> pa.Array:
    """Boxes of the bev frame in the flat BEV image (x to the right, -y down, metres).

    corners: (N, 8, 3). Returns N closed outlines, then N lines from the centre to the front.
    """
    ground = corners[:, :4, :2] * (1, -1)
    outlines = ground[:, [0, 1, 2, 3, 0]].reshape(-1, 2)
    directions = np.stack([ground.mean(1), (ground[:, 0] + ground[:, 3]) / 2], axis=1).reshape(-1, 2)
    return line_strips(np.concatenate([outlines, directions]), [5] * len(ground) + [2] * len(ground))


def _solid(boxes: Boxes3D, **fields: Any) -> Components:
    """Boxes of the scene. fields: further ones of `rr.Boxes3D`."""
    return components(
        rr.Boxes3D,
        centers=boxes.centers,
        half_sizes=boxes.sizes_lwh / 2,
        quaternions=quaternions(boxes),
        fill_mode="majorwireframe",
        **fields,
    )


def quaternions(boxes: Boxes3D) -> Array:
    """(N, 4) the headings of boxes as unit quaternions in rerun's order, x, y, z, w."""
    halves, zeros = boxes.yaws / 2, np.zeros(len(boxes))
    return np.stack([zeros, zeros, np.sin(halves), np.cos(halves)], axis=-1)


def _marks(corners: Array, marks: Marks) -> list[tuple[NDArray[np.float32], Color]]:
    """The diagonals (K, 2, 3) of top faces, and their colour: two of each false positive, one of each duplicate."""
    diagonals = corners[:, 4:][:, [[0, 2], [1, 3]]].astype(np.float32)  # (N, 2, 2, 3)
    false = diagonals[marks.false].reshape(-1, 2, 3)
    return [(false, entities.FALSE_COLOR), (diagonals[marks.duplicate, 0], entities.DUPLICATE_COLOR)]


def log_class_mesh(stream: rr.RecordingStream, name: str, boxes: Boxes3D) -> None:
    """Write where the mesh of a class stands: one in each box of the class. boxes: in the recording's world."""
    # The last one has no size: an entity without poses would show its mesh at the origin.
    poses = components(
        rr.InstancePoses3D,
        translations=np.append(boxes.centers, [[0, 0, 0]], axis=0),
        quaternions=np.append(quaternions(boxes), [[0, 0, 0, 1]], axis=0),
        scales=np.append(boxes.sizes_lwh, [[0, 0, 0]], axis=0),
    )
    log(stream, entities.class_mesh(name), poses)


def log_ego_on_map(stream: rr.RecordingStream, origin: GeoOrigin, here: Array, before: Array | None) -> None:
    """Write the vehicle's position, and the way from its position in the frame before.

    here, before: (3,) in the sequence's world frame, metres; before is None in the first frame of a scene.
    """
    point = origin.latitude_longitude(here)
    stream.log(
        entities.MAP_EGO, rr.GeoPoints(lat_lon=[point], radii=rr.Radius.ui_points(7.0), colors=entities.EGO_COLOR)
    )
    if before is not None:
        way = [origin.latitude_longitude(before), point]
        line = rr.GeoLineStrings(lat_lon=[way], radii=rr.Radius.ui_points(2.0), colors=entities.EGO_COLOR)
        stream.log(entities.MAP_ROUTE, line)


def log_boxes_on_map(stream: rr.RecordingStream, origin: GeoOrigin, centers: Array, colors: np.ndarray | None) -> None:
    """Write the centres (N, 3) of boxes in the sequence's world frame. colors: (N, 3) uint8, None for no boxes."""
    places = origin.latitude_longitude(centers)
    stream.log(entities.MAP_BOXES, rr.GeoPoints(lat_lon=places, radii=rr.Radius.ui_points(4.0), colors=colors))


@dataclass
class TrackHistory:
    """The positions of each track on the ground, kept for PAST_S, and the entities that an interrupted run needs."""

    scene: str = ""  # the scene of the last frame; a new scene has new tracks
    times_ns: dict[str, list[int]] = field(default_factory=dict)  # by track, the times of its positions
    # by track, positions (3,) in the recording's world, the oldest first
    positions: dict[str, list[Array]] = field(default_factory=dict)
    shown: list[str] = field(default_factory=list)  # the entities that show a track now, sorted

    def add(self, identities: list[str], feet: Array, stamp: FrameStamp) -> None:
        """Add the positions of T tracks, and forget what is too old. feet: (T, 3), in the recording's world."""
        if stamp.scene != self.scene:
            self.times_ns, self.positions = {}, {}
        self.scene = stamp.scene
        for name, foot in zip(identities, feet, strict=True):
            self.times_ns.setdefault(name, []).append(stamp.timestamp_ns)
            self.positions.setdefault(name, []).append(foot)
        for name, times in list(self.times_ns.items()):
            kept = sum(stamp.timestamp_ns - time <= PAST_S * 1e9 for time in times)
            self.times_ns[name], self.positions[name] = times[len(times) - kept :], self.positions[name][-kept:]
            if not kept or stamp.timestamp_ns - times[-1] > LOST_S * 1e9:
                del self.times_ns[name], self.positions[name]

    def trail(self, name: str) -> list[Array]:
        """The line (K, 3) of a track's positions, in a list; an empty list for a single position."""
        past = self.positions[name]
        return [np.array(past)] if len(past) > 1 else []


def log_tracks(
    stream: rr.RecordingStream,
    history: TrackHistory,
    boxes: Boxes3D,
    corners: Array,
    colors: NDArray[np.uint8],
    stamp: FrameStamp,
    bev_from_world: Array,
) -> None:
    """Write the tracks of a frame, and clear the entities of tracks without a box. Without tracks: nothing.

    history: gets the boxes. boxes: N in the recording's world. corners: (N, 8, 3). colors: (N, 3). bev_from_world:
    (4, 4).
    """
    if boxes.instances is None:
        return
    # Anew in each scene: the times of a scene may lie before those of the one before.
    styled = history.shown if stamp.scene == history.scene else []
    tracked = boxes.instances != ""
    identities, boxes = boxes.instances[tracked].tolist(), boxes[tracked]
    feet = boxes.centers - boxes.sizes_lwh[:, 2:] / 2 * (0, 0, 1) + (0, 0, ABOVE_GROUND_M)
    history.add(identities, feet, stamp)
    feet_later = feet + np.pad(np.nan_to_num(boxes.velocities), ((0, 0), (0, 1))) * AHEAD_S
    ahead = np.stack([feet, feet_later], axis=1)  # (T, 2, 3)
    outlines = corners[tracked][:, [0, 1, 2, 3, 0]] + [0, 0, ABOVE_GROUND_M]  # (T, 5, 3) closed
    entity_of = dict(zip(identities, map(entities.track, boxes.classes.tolist(), identities), strict=True))
    on_ground: list[Array] = []
    flat_colors: list[tuple[int, ...]] = []
    for name, color, way, outline in zip(identities, colors[tracked].tolist(), ahead, outlines, strict=True):
        entity, trail = entity_of[name], history.trail(name)
        line_colors = [(*color, opacity) for opacity in (AHEAD_OPACITY, PAST_OPACITY, PAST_OPACITY)]
        lines = [way, outline, *trail]
        row = components(rr.LineStrips3D, strips=line_strips(np.concatenate(lines), list(map(len, lines))))
        if entity not in styled:  # what stays is written once: its bytes are more than those of the points
            row |= components(rr.LineStrips3D, colors=np.array(line_colors, np.uint8), radii=TRAIL_WIDTH)
            row |= any_values(track=name)
        log(stream, entity, row)
        on_ground += [way, *trail]
        flat_colors += line_colors[: 1 + len(trail)]
    of_strips = np.array(flat_colors, np.uint8) if flat_colors else None
    flat = apply(bev_from_world, np.concatenate(on_ground or [np.zeros((0, 3))]))[:, :2] * (1, -1)
    strips = line_strips(flat, [len(line) for line in on_ground])
    of_bev = components(rr.LineStrips2D, strips=strips, colors=of_strips, radii=THIN, draw_order=25)
    log(stream, entities.BEV_TRACKS, of_bev)
    shown = set(entity_of.values())
    for entity in set(history.shown) - shown:
        stream.log(entity, rr.Clear(recursive=False))
    history.shown = sorted(shown)
