"""Writes the vehicle's route and the objects onto a street map, where the drive states its place on Earth."""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.geographic import GeoOrigin
from bevcli.geometry.transforms import Array
from bevcli.recording import entities
from bevcli.recording.colors import EGO_COLOR
from bevcli.recording.log_boxes import box_colors


def log_ego_on_map(stream: rr.RecordingStream, origin: GeoOrigin, here: Array, before: Array | None) -> None:
    """Writes the vehicle's position, and the way from its position in the frame before.

    here, before: (3,) in the sequence's world frame, metres; before is None in the first frame of a scene.
    """
    place = origin.latitude_longitude(here)
    point = rr.GeoPoints(lat_lon=[place], radii=rr.Radius.ui_points(7.0), colors=EGO_COLOR)
    stream.log(entities.MAP_EGO, point)
    if before is not None:
        way = [origin.latitude_longitude(before), place]
        line = rr.GeoLineStrings(lat_lon=[way], radii=rr.Radius.ui_points(2.0), colors=EGO_COLOR)
        stream.log(entities.MAP_ROUTE, line)


def log_boxes_on_map(stream: rr.RecordingStream, origin: GeoOrigin, boxes: Boxes3D, class_names: Sequence[str]) -> None:
    """Writes the centres of boxes, in the sequence's world frame, in the colours of their classes."""
    places = origin.latitude_longitude(boxes.centers)
    points = rr.GeoPoints(
        lat_lon=places, radii=rr.Radius.ui_points(4.0), colors=box_colors(boxes, class_names) if len(boxes) else None
    )
    stream.log(entities.MAP_BOXES, points)
