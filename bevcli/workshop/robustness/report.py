"""The table, the plot and the contact sheet of a stress test."""

import math
from collections.abc import Iterable, Sequence as Items
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bevcli.frame import Frame, Sequence
from bevcli.geometry.transforms import inverse
from bevcli.printing import aligned
from bevcli.recording.log_cameras import lines_in_image
from bevcli.workshop.robustness.conditions import Condition, Corruption, Group, Shown
from bevcli.workshop.robustness.options import StressOptions
from bevcli.workshop.robustness.results import ConditionScores, StressResults
from bevcli.workshop.scores.plots import BLUES, GRID_COLOR, titled_figure
from bevcli.workshop.synth.corruptions import Pixels
from bevcli.writing import write_whole

_OTHER_COLOR = "#d62728"


def stress_table(results: StressResults, against: StressResults | None = None) -> str:
    """NDS and mAP by corruption and severity as text; with `against`, also the corruption errors."""
    parts = []
    if results.clean is not None:
        parts.append(f"clean drives: NDS {results.clean.nd_score:.3f}, mAP {results.clean.mean_ap:.3f}")
    tested = results.tested()
    groups = {
        tuple(corruption.levels): [c for c in tested if c.levels.keys() == corruption.levels.keys()]
        for corruption in tested
    }
    parts += [_block(results, severities, group, against) for severities, group in groups.items()]
    published, unseen = (sum(each.group is group for each in tested) for group in (Group.ROBOBEV, Group.UNSEEN))
    if published:
        parts.append(_means(results, published, against))
    if unseen:
        mean = _percent(results.mean_resilience(Group.UNSEEN))
        parts.append(f"mean resilience {mean} % over {unseen} of 5 corruptions that no training of bevcli uses")
    return "\n\n".join(parts)


def _block(
    results: StressResults, severities: tuple[str, ...], group: list[Corruption], against: StressResults | None
) -> str:
    """The corruptions with the same severities, a row each."""
    scale = "level " if severities[0].isdecimal() else ""
    head = [cell for severity in severities for cell in (f"{scale}{severity}: NDS", "mAP")]
    rows = [("corruption", *head, "mean NDS", "RR %", *(("CE %",) if against else ()))]
    for corruption in group:
        scores = results.of(corruption.name)
        cells = []
        for part in map(scores.get, severities):
            cells += [f"{part.nd_score:.3f}", f"{part.mean_ap:.3f}"] if part else ["-", "-"]
        mean = sum(part.nd_score for part in scores.values()) / len(scores)
        rates = [f"{mean:.3f}", _percent(results.resilience(corruption.name))]
        rates += [_percent(results.corruption_error(corruption.name, against))] if against else []
        rows.append((corruption.name, *cells, *rates))
    return aligned(rows)


def _means(results: StressResults, published: int, against: StressResults | None) -> str:
    what = f"over {published} of RoboBEV's 8 corruptions"
    lines = [f"mRR {_percent(results.mean_resilience())} % {what}"]
    if against is not None:
        other = against.header.get("model", "?")
        lines.append(f"mCE {_percent(results.mean_corruption_error(against))} % against {other} {what}")
    return "\n".join(lines)


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.1f}"


def draw_stress(results: StressResults, against: StressResults | None = None) -> Figure:
    """NDS and mAP as bars, one group a corruption, one bar a severity; dashed: clean drives; red: `against`."""
    tested = results.tested()
    other = "" if against is None else f"; red: {against.header.get('model', '?')}, the run compared with"
    figure = titled_figure(
        (max(8.0, 2.5 + 1.2 * len(tested)), 8.5),
        f"Robustness of {results.header.get('model', '?')}",
        f"from the easiest severity (pale) to the hardest; dashed: without corruption{other}",
    )
    panels = figure.subplots(2, 1, sharex=True)
    for axes, label in zip(panels, ("NDS", "mAP"), strict=True):
        _draw_bars(axes, results, label, color=None)
        if against is not None:
            _draw_bars(axes, against, label, color=_OTHER_COLOR, order=tested)
        axes.set(ylabel=label, ylim=(0, 1), axisbelow=True)
        axes.grid(axis="y", color=GRID_COLOR)
    titles = [part.title.replace(" of the ", "\nof the ").replace(" by up to ", "\nby up to ") for part in tested]
    panels[1].set_xticks(range(len(tested)), titles, rotation=35, ha="right")
    return figure


def _draw_bars(
    axes: Axes, results: StressResults, label: str, color: str | None, order: Iterable[Corruption] | None = None
) -> None:
    """Bars, or with a colour only marks at the height of the bars."""
    for place, corruption in enumerate(results.tested() if order is None else order):
        severities = tuple(corruption.levels)
        width = 0.8 / len(severities)
        colors = [BLUES[i] for i in np.linspace(0, len(BLUES) - 1, len(severities)).astype(int)]
        for severity, scores in results.of(corruption.name).items():
            index = severities.index(severity)
            x = place - 0.4 + width * (index + 0.5)
            if color is None:
                axes.bar(x, _value(scores, label), 0.92 * width, color=colors[index])
            else:
                axes.hlines(_value(scores, label), x - 0.46 * width, x + 0.46 * width, color=color, linewidth=2)
    if results.clean is not None:
        axes.axhline(_value(results.clean, label), color=color or "black", linewidth=1, linestyle="--")


def _value(scores: ConditionScores, label: str) -> float:
    return scores.nd_score if label == "NDS" else scores.mean_ap


TILE_WIDTH = 400  # pixels
CAPTION = 24  # height of the text above a tile, pixels
GAP = 6
PAPER, INK, BOX = (28, 23, 20), (241, 236, 232), (60, 220, 255)  # BGR


def write_contact_sheet(path: Path, scene: Sequence, conditions: Items[Condition], options: StressOptions) -> None:
    """Write corruptions.png: the middle frame of a scene, one row a corruption, one column a severity.

    Raises OutputError.
    """
    place, rows = len(scene.stamps) // 2, dict[str, list[Pixels]]()
    for condition in conditions:
        corruption = condition.corruption
        if corruption.shown is Shown.NOTHING:
            continue
        if corruption.name not in rows:
            rows[corruption.name] = [_tile(scene.load(place), corruption, "clean")]
        (changed,) = condition.sequences(scene, options.seed, options.lost_images)
        rows[corruption.name].append(_tile(changed.load(place), corruption, condition.severity))
    if not rows:
        return
    _, encoded = cv2.imencode(".png", _sheet(list(rows.values())))
    write_whole(path, encoded.tobytes())


def _tile(frame: Frame, corruption: Corruption, severity: str) -> Pixels:
    """The part of a frame that shows a corruption, below its caption."""
    ahead = min(frame.rig.cameras, key=lambda camera: abs(camera.yaw)).name
    if corruption.shown is Shown.CAMERAS:
        tile = _mosaic(frame)
    else:
        tile = _camera_tile(frame, ahead, TILE_WIDTH, boxes=corruption.shown is Shown.BOXES)
    top, text = np.full((CAPTION, TILE_WIDTH, 3), PAPER, dtype=np.uint8), f"{corruption.name}: {severity}"
    cv2.putText(top, text, (2, CAPTION - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
    return np.concatenate([top, tile])


def _mosaic(frame: Frame) -> Pixels:
    """All cameras in rows of three, from left to right as they look."""
    cameras, cell = sorted(frame.rig.cameras, key=lambda camera: -camera.yaw), TILE_WIDTH // 3
    tiles = [_camera_tile(frame, camera.name, cell) for camera in cameras]
    height = max(tile.shape[0] for tile in tiles)
    rows = [_row(tiles[start : start + 3], cell, height, TILE_WIDTH) for start in range(0, len(tiles), 3)]
    return np.concatenate(rows)


def _camera_tile(frame: Frame, name: str, width: int, *, boxes: bool = False) -> Pixels:
    """A camera's image at a width, grey where it is missing."""
    camera = frame.rig[name]
    height = round(width * camera.height / camera.width)
    if name not in frame.images:
        return np.full((height, width, 3), 90, dtype=np.uint8)
    pixels = frame.images[name].pixels_bgr.copy()
    if boxes:
        _draw_boxes(pixels, frame, name)
    return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)


def _draw_boxes(pixels: Pixels, frame: Frame, name: str) -> None:
    """Draws the ground truth boxes where the stated calibration and poses see them."""
    if frame.ground_truth is None:
        return
    camera = frame.rig[name]
    camera_from_world = camera.camera_from_ego @ inverse(frame.world_from_ego_at[name].matrix)
    thickness = max(1, round(pixels.shape[1] / 500))
    for start, end in lines_in_image(frame.ground_truth, camera, camera_from_world).segments.astype(int):
        cv2.line(pixels, start.tolist(), end.tolist(), BOX, thickness, cv2.LINE_AA)


def _sheet(rows: list[list[Pixels]]) -> Pixels:
    cell = TILE_WIDTH + GAP
    width = max(map(len, rows)) * cell + GAP
    return np.concatenate([_row(row, cell, max(tile.shape[0] for tile in row) + GAP, width) for row in rows])


def _row(tiles: list[Pixels], cell_width: int, height: int, width: int) -> Pixels:
    """Tiles side by side, each in a cell, in a row of a height and a width."""
    return _padded(np.concatenate([_padded(tile, cell_width, height) for tile in tiles], axis=1), width, height)


def _padded(tile: Pixels, width: int, height: int) -> Pixels:
    canvas = np.full((height, width, 3), PAPER, dtype=np.uint8)
    canvas[: tile.shape[0], : tile.shape[1]] = tile
    return canvas
