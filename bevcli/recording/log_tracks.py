"""Writes tracks into a recording: each has an entity of its own with its past, its footprint and the next second."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import rerun as rr

from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, apply
from bevcli.recording import entities
from bevcli.recording.colors import Color
from bevcli.recording.components import Components, any_values, components, line_strips, ui_points
from bevcli.recording.log_boxes import THIN, box_colors

PAST_S = 5.0  # length of a trail
AHEAD_S = 1.0  # how far ahead a trail shows where the object will be at its present velocity
LOST_S = 3.0  # the trail of a track that had no box for so long is forgotten
PAST_OPACITY, AHEAD_OPACITY = 220, 110  # of 255
ABOVE_GROUND_M = 0.05
WIDTH = ui_points(1.2)


@dataclass
class TrackHistory:
    """The positions of each track on the ground, kept for PAST_S, and the entities that an interrupted recording needs.

    Attributes:
        scene: the scene of the last frame; a new scene has new tracks.
        times_ns: by track, the times of its positions.
        positions: by track, positions (3,) in the recording's world, the oldest first.
        shown: the entities that show a track now, sorted.
    """

    scene: str = ""
    times_ns: dict[str, list[int]] = field(default_factory=dict)
    positions: dict[str, list[Array]] = field(default_factory=dict)
    shown: list[str] = field(default_factory=list)

    def add(self, boxes: Boxes3D, stamp: FrameStamp) -> None:
        """Adds the boxes of a frame, in the recording's world; forgets what is too old."""
        if stamp.scene != self.scene:
            self.times_ns, self.positions = {}, {}
        self.scene = stamp.scene
        for name, foot in zip(track_names(boxes), _feet(boxes), strict=True):
            if name:
                self.times_ns.setdefault(name, []).append(stamp.timestamp_ns)
                self.positions.setdefault(name, []).append(foot)
        for name, times in list(self.times_ns.items()):
            kept = sum(stamp.timestamp_ns - time <= PAST_S * 1e9 for time in times)
            self.times_ns[name], self.positions[name] = times[len(times) - kept :], self.positions[name][-kept:]
            if not kept or stamp.timestamp_ns - times[-1] > LOST_S * 1e9:
                del self.times_ns[name], self.positions[name]


def track_names(boxes: Boxes3D) -> list[str]:
    """The identity of each box's track, "" for a box without one."""
    if boxes.instances is None:
        return [""] * len(boxes)
    return [str(instance) for instance in boxes.instances]


def log_tracks(
    stream: rr.RecordingStream,
    history: TrackHistory,
    boxes: Boxes3D,
    stamp: FrameStamp,
    bev_from_world: Array,
    classes: Mapping[str, Color],
) -> None:
    """Writes the tracks of a frame, and clears the entities of tracks without a box. Without tracks: nothing.

    history: gets the boxes. boxes: in the recording's world. bev_from_world: (4, 4).
    """
    if boxes.instances is None:
        return
    # Anew in each scene: the times of a scene may lie before those of the one before.
    styled = history.shown if stamp.scene == history.scene else []
    history.add(boxes, stamp)
    ahead, outlines, colors = _ahead(boxes), _footprints(boxes), box_colors(boxes, classes)
    shown: set[str] = set()
    drawn, flat_colors = [], []
    for i, name in enumerate(track_names(boxes)):
        if not name:
            continue
        entity = entities.track(str(boxes.classes[i]), name)
        past = np.array(history.positions[name])  # (K, 3)
        trail = [past] if len(past) > 1 else []
        own_colors = [(*colors[i], opacity) for opacity in (AHEAD_OPACITY, PAST_OPACITY, PAST_OPACITY)]
        style: Components = []
        if entity not in styled:  # what stays is written once: its bytes are more than those of the points
            of_lines = components(rr.LineStrips3D, colors=np.array(own_colors, np.uint8), radii=WIDTH)
            style = of_lines + any_values(track=name)
        strips = line_strips([ahead[i], outlines[i], *trail], 3)
        stream.log(entity, components(rr.LineStrips3D, strips=strips) + style)
        shown.add(entity)
        drawn += [ahead[i], *trail]
        flat_colors += own_colors[:: 2 if trail else 3]
    of_strips = np.array(flat_colors, np.uint8) if flat_colors else None
    flat = apply(bev_from_world, np.concatenate([np.zeros((0, 3)), *drawn]))[:, :2] * (1, -1)
    strips = line_strips(np.split(flat, np.cumsum([len(strip) for strip in drawn])[:-1]) if drawn else (), 2)
    trails = components(rr.LineStrips2D, strips=strips, colors=of_strips, radii=THIN, draw_order=25)
    stream.log(entities.BEV_TRACKS, trails)
    for entity in set(history.shown) - shown:
        stream.log(entity, rr.Clear(recursive=False))
    history.shown = sorted(shown)


def _feet(boxes: Boxes3D) -> Array:
    """(N, 3) the points on the ground below the centres."""
    heights = boxes.centers[:, 2] - boxes.sizes_lwh[:, 2] / 2 + ABOVE_GROUND_M
    return np.column_stack([boxes.centers[:, :2], heights])


def _ahead(boxes: Boxes3D) -> Array:
    """(N, 2, 3) from the place on the ground to the one a second later."""
    feet = _feet(boxes)
    steps = np.column_stack([np.nan_to_num(boxes.velocities), np.zeros(len(boxes))]) * AHEAD_S
    return np.stack([feet, feet + steps], axis=1)


def _footprints(boxes: Boxes3D) -> Array:
    """(N, 5, 3) the closed outlines on the ground."""
    bottoms = boxes.corners()[:, :4] + [0, 0, ABOVE_GROUND_M]
    return np.concatenate([bottoms, bottoms[:, :1]], axis=1)
