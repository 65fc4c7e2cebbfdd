"""The legend: a small view with the colours of classes, states and map classes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from bevcli.recording import entities
from bevcli.recording.colors import (
    DUPLICATE_COLOR,
    GROUND_TRUTH_COLOR,
    MISSED_COLOR,
    Color,
    class_color,
    map_colors,
)

COLUMNS = 2
COLUMN_WIDTH, ROW_HEIGHT = 9.0, 1.0  # in the units of the view
TEXT_COLOR: Color = (225, 228, 235)


def legend_entries(class_names: Sequence[str], map_classes: Sequence[str] = ()) -> list[tuple[str, Color]]:
    """The texts and colours of the legend. map_classes: of the model's map; empty without one."""
    classes = [(name.replace("_", " "), class_color(name, index)) for index, name in enumerate(class_names)]
    states = [
        ("ground truth", GROUND_TRUTH_COLOR),
        ("missed, false", MISSED_COLOR),
        ("duplicate", DUPLICATE_COLOR),
    ]
    maps = [(f"map: {name.replace('_', ' ')}", color) for name, color in map_colors(map_classes).items()]
    return [*classes, *states, *maps]


def legend_size(entries: int) -> tuple[float, float]:
    """Width and height of the legend with this number of entries, in the units of its view."""
    return COLUMNS * COLUMN_WIDTH, -(-entries // COLUMNS) * ROW_HEIGHT


def log_legend(stream: rr.RecordingStream, entries: Sequence[tuple[str, Color]]) -> None:
    """Writes the legend: a filled circle and a text for each entry, in columns."""
    rows = -(-len(entries) // COLUMNS)
    places = np.array([(i // rows * COLUMN_WIDTH, (i % rows + 0.5) * ROW_HEIGHT) for i in range(len(entries))])
    texts, colors = [text for text, _ in entries], [color for _, color in entries]
    circles = rr.Points2D(places + (0.7, 0), colors=colors, radii=rr.Radius.ui_points(6.0))
    stream.log(f"{entities.LEGEND}/colors", circles, static=True)
    labels = rr.Points2D(
        places + (5.0, -0.25),  # a label is drawn below its point
        labels=texts,
        colors=TEXT_COLOR,
        radii=rr.Radius.ui_points(0.01),
        show_labels=True,
    )
    stream.log(f"{entities.LEGEND}/texts", labels, static=True)
