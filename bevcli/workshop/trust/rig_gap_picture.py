"""rig_gap.png: the share of objects that a model finds with each of two rigs, by direction and distance.

And the difference, where it is beyond noise. Neighbouring sectors of a ring count half, because a cell has few objects.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Array
from bevcli.rig.drawings import AXLE_TO_TAIL_M, CAR_LENGTH_M, CAR_WIDTH_M, FAINT, INK, PAPER, save
from bevcli.rig.rig_checks import seen_range_deg
from bevcli.workshop.trust.rig_gap import (
    RING_M,
    SECTORS,
    SHOWN_SCORE,
    MeasuredRig,
    Scored,
    cells_of,
    is_clear,
    polar_map,
)

EMPTY, NOISE = "#1b2027", "#39414c"
FOUND = LinearSegmentedColormap.from_list("found", ["#8c2438", "#d9833b", "#f0e28a", "#63b77c", "#1f7a6d"])
CHANGE = LinearSegmentedColormap.from_list("change", ["#e0455e", "#9a4a5a", NOISE, "#4a7f8f", "#3fb7c9"])
SHARES, CHANGES = Normalize(0, 1), Normalize(-0.8, 0.8)
FEWEST = 2.0  # objects of a cell, with those that count half
LEGEND = f"share of objects found: a box of the class within 2 m, score {SHOWN_SCORE:g} or more; below it, the objects"


def write_picture(path: Path, first: MeasuredRig, second: MeasuredRig, range_m: float) -> None:
    """Write the PNG: both rigs, and the second less the first. Raises OutputError."""
    rigs = (first, second)
    a, b = (each.scored for each in rigs)
    figure = Figure(figsize=(17.4, 7.0), dpi=100, facecolor=PAPER)
    maps = [polar_map(each.places, each.found, range_m) for each in (a, b)]
    counts = smoothed(maps[0].counts)
    with np.errstate(invalid="ignore", divide="ignore"):
        enough = (counts >= FEWEST) & (maps[0].counts > 0)
        shares = [np.where(enough, smoothed(each.found) / counts, np.nan) for each in maps]
    change = np.where(np.isnan(shares[0]) | _clear_cells(a, b, shares[0].shape), shares[1] - shares[0], 0.0)
    for place, values in enumerate((*shares, change)):
        axes: Any = figure.add_axes((0.015 + 0.33 * place, 0.16, 0.305, 0.69), projection="polar")
        colors = CHANGE(CHANGES(values)) if place == 2 else FOUND(SHARES(values))
        _draw_cells(axes, values, colors, "" if place == 2 else maps[0].counts)
        _draw_rig(axes, rigs[min(place, 1)].rig, values.shape[1] * RING_M)
        name = f"{second.name} - {first.name}"
        if place < 2:
            name = f"{rigs[place].name}: {rigs[place].scored.found.mean():.0%} found"
        axes.set_title(name, color=INK, fontsize=14, pad=30)
    _draw_bar(figure, (0.10, 0.45), FOUND, SHARES, "{:.0%}", f"{LEGEND}; dark: too few")
    _draw_bar(figure, (0.715, 0.23), CHANGE, CHANGES, "{:+.0%}", "change of that share; without a number: within noise")
    save(figure, path)


def smoothed(counts: NDArray[np.int64]) -> Array:
    """(SECTORS, R) numbers with half of those of both neighbouring sectors."""
    return np.asarray(counts + 0.5 * (np.roll(counts, 1, axis=0) + np.roll(counts, -1, axis=0)))


def _clear_cells(a: Scored, b: Scored, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """(SECTORS, R) whether the difference of a cell is beyond noise."""
    (sectors, rings), clear = cells_of(a.places), np.zeros(shape, bool)
    for sector, ring in np.ndindex(shape):
        apart = (sectors - sector + 1) % SECTORS  # 0 and 2: a neighbour
        weights = np.where(apart == 1, 1.0, np.where(apart <= 2, 0.5, 0.0)) * (rings == ring)
        clear[sector, ring] = is_clear(a, b, weights)
    return clear


def _draw_cells(axes: Any, values: Array, colors: Array, counts: NDArray[np.int64] | str) -> None:
    """values: (SECTORS, R), NaN without objects. colors: (SECTORS, R, 4). counts: of objects, "" for differences."""
    axes.set_theta_zero_location("N")  # ahead is up, and further directions are counter-clockwise, as yaw is
    axes.set_facecolor(EMPTY)
    axes.grid(False)
    turn, rings = 2 * np.pi / SECTORS, values.shape[1]
    for (sector, ring), value in np.ndenumerate(values):
        color = EMPTY if np.isnan(value) else colors[sector, ring]
        start, style = ring * RING_M, {"color": color, "edgecolor": PAPER, "linewidth": 0.8}
        axes.bar(sector * turn, RING_M, turn, start, **style)
        if ring == 0 or np.isnan(value) or (isinstance(counts, str) and value == 0):
            continue
        text = f"{value:+.0%}" if isinstance(counts, str) else f"{value:.0%}\n{counts[sector, ring]}"
        dark = isinstance(counts, str) or not 0.3 < value < 0.85
        axes.text(
            sector * turn,
            start + RING_M / 2,
            text,
            fontsize=6.5,
            ha="center",
            va="center",
            color=INK if dark else PAPER,
            linespacing=0.95,
        )
    axes.set_ylim(0, rings * RING_M)
    axes.set_yticks(np.arange(1, rings + 1) * RING_M, [f"{ring * RING_M:g} m" for ring in range(1, rings + 1)])
    axes.set_rlabel_position(180 / SECTORS)
    axes.tick_params(axis="y", colors=INK, labelsize=8)
    axes.set_xticks([])
    axes.spines["polar"].set_color(FAINT)


def _draw_rig(axes: Any, rig: CameraRig, reach: float) -> None:
    """The vehicle, and the field of view of each camera. reach: the radius of the map, metres."""
    nose, tail, half = CAR_LENGTH_M - AXLE_TO_TAIL_M, -AXLE_TO_TAIL_M, CAR_WIDTH_M / 2
    outline = [(tail, half), (tail, -half), (nose - 0.8, -half), (nose, 0), (nose - 0.8, half), (tail, half)]
    axes.fill(*_polar(np.array(outline)), facecolor=PAPER, edgecolor=INK, linewidth=1.0, zorder=4)
    for camera in rig.cameras:
        position = camera.ego_from_camera[:2, 3]
        for angle in camera.yaw - np.radians(seen_range_deg(camera, 0)):
            line = position + np.linspace(0, 1.5 * reach, 150)[:, None] * [np.cos(angle), np.sin(angle)]
            line = line[np.hypot(*line.T) <= reach]
            axes.plot(*_polar(line), color=INK, linewidth=0.9, alpha=0.7, zorder=3)
        name = camera.name.removeprefix("CAM_").replace("_", " ").lower()
        box = {"facecolor": PAPER, "edgecolor": FAINT, "linewidth": 0.5, "boxstyle": "round,pad=0.25"}
        style = {"color": INK, "fontsize": 8, "ha": "center", "va": "center", "bbox": box, "zorder": 5}
        axes.text(camera.yaw, 1.1 * reach, name, **style)


def _polar(points: Array) -> tuple[Array, Array]:
    """Points (P, 2) on the ground -> directions and distances (P,)."""
    return np.arctan2(points[:, 1], points[:, 0]), np.hypot(*points.T)


def _draw_bar(figure: Figure, place: tuple[float, float], colors: Any, norm: Normalize, form: str, text: str) -> None:
    """A bar of colours. place: left and width, as shares of the figure's width."""
    axes = figure.add_axes((place[0], 0.085, place[1], 0.02))
    bar = figure.colorbar(ScalarMappable(norm, colors), cax=axes, orientation="horizontal")
    bar.set_label(text, color=INK, fontsize=10)
    axes.tick_params(colors=FAINT, labelsize=9)
    axes.xaxis.set_major_formatter(lambda value, _: form.format(value))
