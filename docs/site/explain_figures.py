"""Draw the figures of docs/bevformer.md: `python docs/site/explain_figures.py`.

The model demo runs over a drive up to one frame. Forward hooks keep what its parts compute in that frame, and each
function below draws one step of the model.
"""

import argparse
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Patch, Polygon, Rectangle
from matplotlib.patheffects import AbstractPathEffect, Normal, Stroke
from numpy.typing import NDArray

import bevcli
from bevcli.geometry.object_classes import SHOWN_SCORE
from bevcli.geometry.transforms import apply, inverse, rotation_about_z
from bevcli.inference.preprocess import Preprocessor
from bevcli.model.decoder import boxes_of_codes
from bevcli.model.segmentation import STUFF_CLASSES, THING_CLASS
from bevcli.recording.log_ground import fit_colors

ROOT = Path(__file__).parents[2]
RECENT = 4  # frames in the figure of the recurrence
INK, GREY, FAINT, PALE = "#1f2430", "#6b7280", "#d7dae0", "#9aa0ab"
ORANGE, BLUE, GREEN = "#e4572e", "#1769aa", "#2a9d5c"
HEIGHT_COLORS = ("#7b3ff2", "#1f8fe0", "#1fae6a", "#f2a900")  # of the points of a pillar, the lowest first
MAP_COLORS = {
    "drivable_road": (201, 206, 216), "lane_boundary": (242, 169, 0), "pedestrian_crossing": (95, 163, 211),
    "vehicle": (228, 87, 46),
}  # fmt: skip
CAN_BUS = (  # names, unit, colour
    ([f"position change {axis}" for axis in "xyz"], "m", ORANGE),
    ([f"quaternion {part}" for part in "wxyz"], "", "#7b3ff2"),
    ([f"acceleration {axis}" for axis in "xyz"], "m/s²", BLUE),
    ([f"rotation rate {axis}" for axis in "xyz"], "rad/s", "#b7791f"),
    ([f"velocity {axis}" for axis in "xyz"], "m/s", GREEN),
    (["heading"], "rad", "#c2185b"),
    (["heading change"], "°", "#0f766e"),
)
VISIBILITY = 0.2  # true boxes below this are not drawn
PARTS = ("neck", "pillars", "bev_queries", "encoder", "decoder", "segmentation_head")


class Trace:
    """One frame's way through the model.

    Attributes:
        network: the model.
        recent: the last frames and their predictions; the traced one is the last.
        calls: name of a part -> its positional arguments, its named ones, and its output.
        visible: (N, Y, X, Z), the pillar points that each camera sees.
        scores, codes: (L, Q, classes) and (L, Q, 10), of the object queries after each decoder layer.
        places: (L + 1, Q, 2), their places in metres; the first are those at the start.
    """

    def __init__(self, drive: bevcli.Sequence, cell_xy: tuple[float, float]) -> None:
        model = bevcli.load_model("demo", device="cpu")
        self.network: Any = model.prepared
        self.grid = model.config.bev_grid
        self.row, self.column = map(int, self.grid.cell_of(cell_xy))
        self.center = self.grid.cell_centers()[self.row, self.column]
        self.calls: dict[str, tuple[Any, dict[str, Any], Any]] = {}
        layers = [f"encoder.layers.{layer}" for layer in range(len(self.network.encoder.layers))]
        for name in (*PARTS, *layers):
            self.network.get_submodule(name).register_forward_hook(self._keep(name), with_kwargs=True)
        self.recent = deque(bevcli.run(model, drive, probes=(cell_xy,)), maxlen=RECENT)
        self.frame, self.prediction = self.recent[-1]
        self.prepared = Preprocessor(model.config)(self.frame)
        self.cameras = self.prepared.assignment.cameras
        self.layers = [self.as_map(self.calls[layer][2][0]) for layer in layers]
        self.history = self.as_map(self.calls["encoder"][1]["history"][0])
        self.can_bus = self.calls["bev_queries"][0][0][0].numpy()
        self.shift = self.calls["encoder"][1]["shift"][0].numpy()
        self.boxes = self.prediction.boxes.scored(SHOWN_SCORE)
        visible = self.network.pillars.project(*self.calls["pillars"][0]).visible[0].numpy()
        self.visible = visible.reshape(len(self.cameras), self.grid.rows, self.grid.columns, -1)
        self.extent_m = np.diff([self.grid.x_range_m, self.grid.y_range_m])[:, 0]
        logits, codes, _ = self.calls["decoder"][2]
        self.scores, self.codes = logits[:, 0].float().sigmoid().numpy(), codes[:, 0].float().numpy()
        start = self.network.decoder.object_queries(batch=1).reference_points[0, :, :2].detach().numpy()
        start = start * self.extent_m + (self.grid.x_range_m[0], self.grid.y_range_m[0])
        self.places = np.concatenate([start[None], self.codes[..., :2]])

    def _keep(self, name: str) -> Any:
        def keep(_: object, arguments: Any, named: dict[str, Any], output: Any) -> None:
            self.calls[name] = (arguments, named, output)

        return keep

    def as_map(self, tokens: torch.Tensor) -> NDArray[Any]:
        """Tokens (Y·X, C) -> (Y, X, C), rows from the smallest y."""
        return tokens.detach().float().numpy().reshape(self.grid.rows, self.grid.columns, -1)


def titled(height: float, title: str, subtitle: str, heading: float = 1.3) -> Figure:
    """A figure of 14 inches by `height`, whose top `heading` inches hold a title and a subtitle."""
    figure = Figure(figsize=(14, height), dpi=100, facecolor="white")
    figure.text(0.015, 1 - 0.16 / height, title, fontsize=19, fontweight="bold", color=INK, va="top")
    figure.text(0.015, 1 - 0.56 / height, subtitle, fontsize=13, color=GREY, va="top", linespacing=1.35)
    figure.subplots_adjust(left=0.045, right=0.985, bottom=0.55 / height, top=1 - heading / height)
    return figure


def bev_axes(axes: Axes, trace: Trace, title: str = "", *, y_labels: bool = True, ticks: bool = True) -> Axes:
    """Set up axes as the area of the BEV grid in metres, with the vehicle."""
    axes.set(xlim=trace.grid.x_range_m, ylim=trace.grid.y_range_m, aspect="equal")
    axes.set_title(title, fontsize=13, color=INK, loc="left", pad=7)
    axes.tick_params(labelsize=10, colors=GREY, length=3)
    axes.set(**{"xlabel": "x, m"} if ticks else {"xticks": [], "yticks": []})
    axes.set(**{"ylabel": "y, m"} if ticks and y_labels else {"yticklabels": []})
    axes.spines[:].set_color(FAINT)
    axes.add_patch(Polygon(vehicle(trace), closed=True, fc="white", ec=INK, lw=1.4, zorder=8))
    return axes


def vehicle(trace: Trace) -> NDArray[np.float64]:
    """(5, 2) outline of the vehicle with a pointed front, metres, bev frame."""
    points = [[-0.9, -0.95, 0], [-0.9, 0.95, 0], [2.5, 0.95, 0], [3.7, 0, 0], [2.5, -0.95, 0]]
    return apply(inverse(trace.frame.rig.ego_from_bev), points)[:, :2]


def show(axes: Axes, trace: Trace, image: NDArray[Any], **settings: Any) -> Any:
    """Draw an array (Y, X) or (Y, X, 3) over the grid's area."""
    extent = (*trace.grid.x_range_m, *trace.grid.y_range_m)
    return axes.imshow(image, extent=extent, origin="lower", interpolation="nearest", zorder=0, **settings)


def show_map(axes: Axes, trace: Trace, bev_map: bevcli.BevMap) -> None:
    """Draw a map of the ground in the colours of its classes."""
    image = np.full((*bev_map.cells.shape, 3), 255, np.uint8)
    for name in bev_map.classes:
        image[bev_map.layer(name)] = MAP_COLORS[name]  # later classes lie on top
    axes.imshow(image, extent=(*bev_map.x_range_m, *bev_map.y_range_m), zorder=0, interpolation="nearest")
    axes.set(xlim=trace.grid.x_range_m, ylim=trace.grid.y_range_m)


def camera(axes: Axes, frame: bevcli.Frame, name: str, title: str = "") -> None:
    """Draw the image of a camera."""
    axes.imshow(frame.images[name].pixels_bgr[..., ::-1], interpolation="antialiased", aspect="auto")
    axes.set(xticks=[], yticks=[], xlim=(0, frame.rig[name].width), ylim=(frame.rig[name].height, 0))
    axes.set_aspect("equal" if title else "auto")
    axes.set_title(title, fontsize=11, color=INK, loc="left", pad=5)


def lengths(axes: Axes, trace: Trace, level: torch.Tensor, index: int) -> None:
    """Draw the lengths of the feature vectors (N, C, H, W) of one camera, without the padding."""
    norms = level.norm(dim=1).float().numpy()
    low, high = np.percentile(norms, (2, 99.5))
    height, width = trace.prepared.images.shape[-2:]
    axes.imshow(norms[index], extent=(0, width, height, 0), cmap="magma", vmin=low, vmax=high, aspect="auto")
    size, scale = trace.frame.rig[trace.cameras[index]], trace.prepared.scales[index]
    axes.set(xlim=(0, size.width * scale), ylim=(size.height * scale, 0), xticks=[], yticks=[])


def boxes(
    axes: Axes, shown: bevcli.Boxes3D, color: str, width: float = 1.6, style: str = "-", halo: bool = False
) -> None:
    """Draw boxes from above, with a line to the front. halo: a white border."""
    effects: list[AbstractPathEffect] = [Stroke(linewidth=width + 1.8, foreground="white", alpha=0.85)] * halo
    look: dict[str, Any] = {"color": color, "lw": width, "zorder": 6, "path_effects": [*effects, Normal()]}
    for corners, center in zip(shown.corners()[:, :4, :2], shown.centers[:, :2], strict=True):
        axes.plot(*np.concatenate([corners, corners[:1]]).T, ls=style, **look)
        axes.plot(*np.stack([center, (corners[0] + corners[3]) / 2]).T, **look)


def truth(axes: Axes, trace: Trace) -> None:
    """Draw the true boxes that are not mostly hidden."""
    frame = trace.frame
    assert frame.ground_truth is not None
    shown = frame.ground_truth[~(frame.ground_truth.visibilities < VISIBILITY)]
    in_bev = shown.transformed(inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev))
    boxes(axes, in_bev, PALE, width=1.2, style="--")
    axes.plot([], [], "--", color=PALE, label="ground truth")


def mark_cell(axes: Axes, trace: Trace) -> None:
    """Draw a square around the followed cell."""
    side = np.maximum(trace.grid.cell_size_m, 1.5)
    for color, width in (("white", 4.5), (ORANGE, 2.2)):
        axes.add_patch(Rectangle(trace.center - side / 2, *side, fc="none", ec=color, lw=width, zorder=9))


def colors_of(maps: Iterable[NDArray[Any]]) -> list[NDArray[np.uint8]]:
    """Maps (Y, X, C) -> images (Y, X, 3): three principal components of all of them. White where a map is zero."""
    maps = list(maps)
    fitted = fit_colors("pca", np.concatenate([part.reshape(-1, part.shape[-1]) for part in maps]))
    return [np.where((part == 0).all(-1, keepdims=True), np.uint8(255), fitted.paint(part)) for part in maps]


def similarity(features: NDArray[Any], trace: Trace) -> NDArray[Any]:
    """(Y, X) cosine similarity with the followed cell's vector, after the mean of all cells is removed."""
    centered = features - features.mean((0, 1))
    centered = centered / np.maximum(np.linalg.norm(centered, axis=-1, keepdims=True), 1e-9)
    return np.asarray(centered @ centered[trace.row, trace.column])


def in_image(trace: Trace, name: str, points_bev: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Points (..., 3) in the bev frame -> pixels (..., 2) of a camera, and which are visible (...)."""
    frame, seen_by = trace.frame, trace.frame.rig[name]
    ego_from_bev = inverse(frame.world_from_ego_at[name].matrix) @ frame.world_from_ego.matrix @ frame.rig.ego_from_bev
    pixels, depth = seen_by.project_ego(apply(ego_from_bev, points_bev))
    return pixels, seen_by.contains(pixels, depth)


def overview(trace: Trace) -> Figure:
    subtitle = "Blue: learned parts of the model. Orange: the recurrent state."
    figure = titled(7.7, "BEVFormer: one frame through the model", subtitle)
    canvas = figure.add_axes((0, 0, 1, 1), zorder=0)
    canvas.set(xlim=(0, 1), ylim=(0, 1))
    canvas.axis("off")
    for index, name in enumerate(trace.cameras):
        bottom = 0.79 - 0.127 * (index + 1)
        camera(figure.add_axes((0.012, bottom, 0.125, 0.118)), trace.frame, name)
        lengths(figure.add_axes((0.265, bottom, 0.125, 0.118)), trace, trace.calls["neck"][2][0], index)
    [queries] = colors_of([trace.as_map(trace.network.bev_queries.embedding)])
    now, history = colors_of([trace.layers[-1], trace.history])
    placed = {}
    for title, x, y, width, image in (
        ("BEV queries", 0.435, 0.645, 0.1, queries), ("Previous map, rotated", 0.435, 0.045, 0.1, history),
        ("BEV map", 0.655, 0.29, 0.16, now), ("Objects", 0.875, 0.56, 0.118, None),
        ("Segmentation", 0.875, 0.145, 0.118, None),
    ):  # fmt: skip
        placed[title] = bev_axes(figure.add_axes((x, y, width, width * 14 / 7.7)), trace, title, ticks=False)
        if image is not None:
            show(placed[title], trace, image)
    boxes(placed["Objects"], trace.boxes, ORANGE, width=1.3)
    show_map(placed["Segmentation"], trace, trace.prediction.segmentation)
    parts = "temporal self-attention\nspatial cross-attention\nfeed-forward network"
    for x, y, width, height, text in (
        (0.157, 0.29, 0.088, 0.19, f"{trace.network.config.backbone.title}\nbackbone\n+\nFPN neck"),
        (0.42, 0.335, 0.205, 0.235, f"Encoder × {len(trace.layers)}\n\n{parts}"),
        (0.778, 0.63, 0.082, 0.115, "Object\ndecoder"), (0.778, 0.175, 0.085, 0.09, "Segmentation\nhead"),
    ):  # fmt: skip
        style = "round,pad=0,rounding_size=0.012"
        canvas.add_patch(FancyBboxPatch((x, y), width, height, boxstyle=style, fc="#e3eefb", ec=BLUE, lw=1.6))
        canvas.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=11.5, linespacing=1.4)
    for start, end in (
        ((0.139, 0.385), (0.155, 0.385)), ((0.247, 0.385), (0.263, 0.385)), ((0.392, 0.45), (0.418, 0.45)),
        ((0.485, 0.64), (0.485, 0.575)), ((0.627, 0.45), (0.653, 0.45)), ((0.745, 0.615), (0.776, 0.685)),
        ((0.861, 0.685), (0.873, 0.685)), ((0.485, 0.262), (0.485, 0.33)), ((0.755, 0.285), (0.79, 0.267)),
        ((0.864, 0.22), (0.873, 0.22)),
    ):  # fmt: skip
        canvas.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", color=GREY, lw=2.4, mutation_scale=20))
    curve: dict[str, Any] = {"connectionstyle": "arc3,rad=-0.35", "lw": 2.2, "ls": "--", "mutation_scale": 18}
    canvas.add_patch(FancyArrowPatch((0.715, 0.285), (0.542, 0.135), arrowstyle="-|>", color=ORANGE, **curve))
    for x, y, text, color in (
        (0.012, 0.81, f"{len(trace.cameras)} cameras", INK), (0.265, 0.81, "image features", INK),
        (0.548, 0.74, "+ position\n+ can-bus", GREY),
        (0.63, 0.05, "the state: BEV map and pose,\nkept for the next frame", ORANGE),
    ):  # fmt: skip
        canvas.text(x, y, text, fontsize=12, color=color, va="center")
    return figure


def image_features(trace: Trace) -> Figure:
    levels = trace.calls["neck"][2]
    subtitle = (
        "Top: the images. Below: the length of the feature vector, one row a level. Each position becomes a token."
    )
    figure = titled(
        1.35 + 1.42 * (len(levels) + 1), "Image features: the output of the backbone and the neck", subtitle
    )
    grid = figure.add_gridspec(len(levels) + 1, len(trace.cameras), wspace=0.04, hspace=0.22, left=0.06, bottom=0.02)
    for column, name in enumerate(trace.cameras):
        camera(figure.add_subplot(grid[0, column]), trace.frame, name, name)
        for row, level in enumerate(levels, start=1):
            axes = figure.add_subplot(grid[row, column])
            lengths(axes, trace, level, column)
            if column == 0:
                axes.set_ylabel(f"level {row}\n{' × '.join(map(str, level.shape[-3:]))}", fontsize=11, color=INK)
    return figure


def bev_queries(trace: Trace) -> Figure:
    grid, (size_x, size_y) = trace.grid, trace.grid.cell_size_m
    subtitle = "The square marks the followed cell. The can-bus embedding is added to all queries in every frame."
    figure = titled(6.3, "BEV queries: one learned vector per cell of the grid around the vehicle", subtitle)
    spec = figure.add_gridspec(1, 3, wspace=0.14, bottom=0.08)
    index = f"{trace.row} · {grid.columns} + {trace.column} = {trace.row * grid.columns + trace.column}"
    titles = (f"The grid: index {index}", "Learned queries, as colours (PCA)", "Similarity of position embeddings")
    panels = [bev_axes(figure.add_subplot(spec[place]), trace, title) for place, title in enumerate(titles)]
    panels[0].vlines(np.arange(*grid.x_range_m, size_x), *grid.y_range_m, color="#dfe2e8", lw=0.6, zorder=1)
    panels[0].hlines(np.arange(*grid.y_range_m, size_y), *grid.x_range_m, color="#dfe2e8", lw=0.6, zorder=1)
    x, y = trace.center
    panels[0].axhspan(y - size_y / 2, y + size_y / 2, color=BLUE, alpha=0.28, zorder=2)
    panels[0].axvspan(x - size_x / 2, x + size_x / 2, color=ORANGE, alpha=0.28, zorder=2)
    show(panels[1], trace, colors_of([trace.as_map(trace.network.bev_queries.embedding)])[0])
    position = similarity(trace.as_map(trace.network.bev_queries.position()), trace)
    image = show(panels[2], trace, position, cmap="RdBu_r", vmin=-1, vmax=1)
    figure.colorbar(image, cax=panels[2].inset_axes((0.05, 0.05, 0.35, 0.035), zorder=15), orientation="horizontal")
    for axes in panels:
        mark_cell(axes, trace)
    return figure


def can_bus(trace: Trace) -> Figure:
    moved, turned, now = trace.shift * trace.extent_m, float(trace.can_bus[17]), vehicle(trace)
    subtitle = f"Shift {moved[0]:+.2f} m in x, {moved[1]:+.2f} m in y; rotation {turned:+.2f}° (counter-clockwise)."
    figure = titled(7.9, "Ego-motion: the 18 can-bus numbers, the shift and the rotation", subtitle)
    spec = figure.add_gridspec(1, 2, width_ratios=(1.25, 1), wspace=0.06, left=0.16, bottom=0.075)
    axes, row, labels = figure.add_subplot(spec[0]), 0, list[str]()
    for names, unit, color in CAN_BUS:
        group = trace.can_bus[row : row + len(names)]
        axes.barh(range(row, row + len(names)), group / max(np.abs(group).max(), 1e-9), color=color, height=0.6)
        labels += [f"{name}  {value + 0:.3f} {unit}" for name, value in zip(names, group, strict=True)]
        row += len(names)
    axes.set_yticks(range(row), labels, fontsize=11)
    axes.set(xlim=(-1.1, 1.1), ylim=(row, -1), xticks=[0])
    axes = figure.add_subplot(spec[1])
    before = now @ rotation_about_z(np.radians(-turned))[:2, :2].T - moved
    axes.add_patch(Polygon(before, fc="none", ec=GREY, lw=1.8, ls="--", zorder=5))
    axes.add_patch(Polygon(now, fc="#fde3dc", ec=ORANGE, lw=2.2, zorder=4))
    axes.annotate("", (0, 0), tuple(-moved), arrowprops={"arrowstyle": "-|>", "color": BLUE, "lw": 2.6}, zorder=6)
    reach, (x, y) = max(5.0, float(np.abs(moved).max()) + 3.5), -moved / 2
    axes.set(xlim=(x - reach, x + reach), ylim=(y - reach, y + reach), aspect="equal", xlabel="x, m (bev frame)")
    axes.set_title("Vehicle: previous frame dashed, current frame solid", fontsize=13, color=INK, loc="left", pad=7)
    return figure


def pillars(trace: Trace) -> Figure:
    heights, own = trace.grid.pillar_heights(), trace.grid.pillars()[trace.row, trace.column]
    subtitle = "The points of a pillar are projected into every camera. The cell attends in those that see one of them."
    figure = titled(8.2, "Pillars and 3D reference points: from a BEV cell into the cameras", subtitle)
    spec = figure.add_gridspec(2, 2, width_ratios=(1, 1.1), wspace=0.09, hspace=0.12, bottom=0.03, left=0.012)
    points = trace.visible[:, trace.row, trace.column].sum(-1)
    for place, index in enumerate(np.argsort(-points, kind="stable")[: min(2, (points > 0).sum())]):
        axes, name = figure.add_subplot(spec[place, 0]), trace.cameras[index]
        camera(axes, trace.frame, name, name)
        pixels, visible = in_image(trace, name, trace.grid.pillars()[trace.row % 4 :: 4, trace.column % 4 :: 4])
        for pillar in pixels[visible.all(-1)]:
            axes.plot(*pillar.T, ".-", color="white", lw=0.6, ms=2.5, alpha=0.6, zorder=2)
        pixels, _ = in_image(trace, name, own)
        axes.plot(*pixels.T, "-", color=INK, lw=1.6, zorder=5)
        axes.scatter(*pixels.T, s=100, c=HEIGHT_COLORS, edgecolors="white", linewidths=1.6, zorder=6)
    axes = bev_axes(figure.add_subplot(spec[:, 1]), trace, "Number of cameras that see each BEV cell")
    shades = ListedColormap(["#f1f2f4", "#bcd9ee", "#5fa3d3"])
    image = show(axes, trace, trace.visible.any(-1).sum(0), cmap=shades, vmin=-0.5, vmax=2.5)
    figure.colorbar(image, ax=axes, ticks=range(3), shrink=0.55, pad=0.02)
    mark_cell(axes, trace)
    for z, color in reversed(list(zip(heights, HEIGHT_COLORS, strict=True))):
        axes.plot([], [], "o", color=color, ms=9, label=f"z = {z:.2f} m")
    axes.legend(loc="lower right", fontsize=11, title="pillar points")
    return figure


def spatial_attention(trace: Trace) -> Figure:
    assert trace.prediction.attention is not None
    samples = trace.prediction.attention.probes[0].cameras
    subtitle = "Crosses: projected pillar points. Dots: sampling points of all heads and levels; larger is more weight."
    shown = list(samples)[:2]
    figure = titled(1.6 + 3.55 * len(shown), "Spatial cross-attention: where one BEV cell samples the images", subtitle)
    spec = figure.add_gridspec(len(shown), 2, wspace=0.03, hspace=0.14, bottom=0.02, left=0.012, right=0.935)
    largest = max(part.weights.max() for part in samples.values())
    for row, name in enumerate(shown):
        size = np.array([trace.frame.rig[name].width, trace.frame.rig[name].height])
        inside = ((samples[name].pixels >= 0) & (samples[name].pixels < size)).all(-1)
        pixels, weights = samples[name].pixels[inside], samples[name].weights[inside]
        center = np.average(pixels, axis=0, weights=weights)
        window = 0.4 * size
        left, top = np.clip(center - window / 2, 0, size - window)
        own, visible = in_image(trace, name, trace.grid.pillars()[trace.row, trace.column])
        for column, (title, scale) in enumerate(((name, 30), ("enlarged", 160))):
            axes = figure.add_subplot(spec[row, column])
            camera(axes, trace.frame, name, title)
            axes.scatter(*own[visible].T, marker="x", s=2.4 * scale, c=BLUE, linewidths=1 + 0.014 * scale, zorder=3)
            order, look = np.argsort(weights), {"cmap": "viridis", "vmin": 0, "vmax": largest, "edgecolors": "white"}
            sizes = scale * (0.12 + weights[order] / largest)
            dots = axes.scatter(*pixels[order].T, s=sizes, c=weights[order], linewidths=0.6, zorder=4, **look)
            if title == "enlarged":
                axes.set(xlim=(left, left + window[0]), ylim=(top + window[1], top))
            else:
                axes.add_patch(Rectangle((left, top), *window, fc="none", ec=ORANGE, lw=1.6, zorder=2))
    figure.colorbar(dots, cax=figure.add_axes((0.944, 0.08, 0.011, 0.6)), label="attention weight")
    return figure


def temporal_attention(trace: Trace) -> Figure:
    before, attention = trace.recent[-2][1], trace.prediction.attention
    assert before.bev is not None
    assert attention is not None
    moved = trace.shift * trace.extent_m
    subtitle = (
        "Colours: PCA of the BEV features. Outlines: boxes predicted in the current frame, dashed: in the previous one."
    )
    figure = titled(5.3, "Temporal self-attention: the previous BEV map, aligned by ego-motion", subtitle)
    spec = figure.add_gridspec(1, 4, wspace=0.1, left=0.04, right=0.955, bottom=0.06)
    titles = ("1  Previous map", "2  Rotated and shifted", "3  Current map", "4  Weight of history")
    panels = [bev_axes(figure.add_subplot(spec[i]), trace, title, y_labels=i == 0) for i, title in enumerate(titles)]
    now, history, aligned = colors_of([trace.layers[-1], trace.as_map(before.bev), trace.history])
    show(panels[0], trace, history)
    boxes(panels[0], before.boxes.scored(SHOWN_SCORE), INK, style="--", halo=True)
    (x0, x1), (y0, y1) = trace.grid.x_range_m, trace.grid.y_range_m
    extent = (x0 - moved[0], x1 - moved[0], y0 - moved[1], y1 - moved[1])
    panels[1].imshow(aligned, extent=extent, origin="lower", interpolation="nearest", zorder=0)
    panels[1].set(xlim=(x0, x1), ylim=(y0, y1))
    show(panels[2], trace, now)
    image = show(panels[3], trace, attention.history_weight, cmap="RdBu_r", vmin=0, vmax=1)
    for axes in panels[1:]:
        boxes(axes, trace.boxes, INK, width=1.3, halo=axes is not panels[3])
    bar = figure.colorbar(image, cax=figure.add_axes((0.963, 0.18, 0.009, 0.44)), ticks=(0, 0.5, 1))
    bar.ax.set_yticklabels(["0 current", "0.5", "1 history"], fontsize=9, color=GREY, rotation=90, va="center")
    return figure


def encoder_layers(trace: Trace) -> Figure:
    maps = [trace.as_map(trace.network.bev_queries.embedding), *trace.layers]
    subtitle = (
        "Top: BEV features as colours (PCA). Bottom: cosine similarity of each cell to the followed cell (square)."
    )
    figure = titled(8.4, "Encoder: the BEV map after each layer", subtitle)
    spec = figure.add_gridspec(2, len(maps), wspace=0.06, hspace=0.16, left=0.05, right=0.95, bottom=0.06)
    for column, features in enumerate(maps):
        title = f"After layer {column}" if column else "Before: BEV queries"
        top = bev_axes(figure.add_subplot(spec[0, column]), trace, title, y_labels=column == 0)
        bottom = bev_axes(figure.add_subplot(spec[1, column]), trace, y_labels=column == 0)
        show(top, trace, colors_of([features])[0])
        shown = show(bottom, trace, similarity(features, trace), cmap="RdBu_r", vmin=-1, vmax=1)
        top.set_xlabel("")
        for axes in (top, bottom):
            mark_cell(axes, trace)
            if column:
                boxes(axes, trace.boxes, INK, width=1.0, halo=axes is top)
    figure.colorbar(shown, cax=figure.add_axes((0.958, 0.12, 0.01, 0.24)), ticks=(-1, 0, 1))
    return figure


def recurrence(trace: Trace) -> Figure:
    subtitle = (
        "Bottom: BEV features as colours (PCA) and boxes. Only the last map and pose are kept between two frames."
    )
    figure = titled(7.0, "The recurrence: each BEV map is the history of the next frame", subtitle)
    spec = figure.add_gridspec(2, RECENT, height_ratios=(0.6, 1), wspace=0.1, hspace=0.16, left=0.04, bottom=0.06)
    front = min(trace.frame.rig.cameras, key=lambda one: abs(one.yaw)).name
    images = colors_of(trace.as_map(prediction.bev) for _, prediction in trace.recent if prediction.bev is not None)
    for column, ((frame, prediction), image) in enumerate(zip(trace.recent, images, strict=True)):
        seconds = (frame.stamp.timestamp_ns - trace.frame.stamp.timestamp_ns) / 1e9
        title = f"frame {frame.stamp.index}   t = {seconds:.1f} s"
        camera(figure.add_subplot(spec[0, column]), frame, front, title)
        axes = bev_axes(figure.add_subplot(spec[1, column]), trace, y_labels=column == 0)
        show(axes, trace, image)
        boxes(axes, prediction.boxes.scored(SHOWN_SCORE), INK, halo=True)
        if column:
            arrow = {"arrowstyle": "simple,head_width=1.1,head_length=0.8", "fc": ORANGE, "ec": "white"}
            axes.annotate("", (0.0, 0.5), (-0.13, 0.5), xycoords="axes fraction", zorder=30, arrowprops=arrow)
    return figure


def decoder(trace: Trace) -> Figure:
    scores, points = trace.scores, trace.places
    chosen = np.flatnonzero(scores[-1].max(-1) >= SHOWN_SCORE)
    subtitle = f"{points.shape[1]} queries. Coloured: the {len(chosen)} with a final score of at least {SHOWN_SCORE:g}."
    figure = titled(7.35, "Object decoder: reference points move to the objects", subtitle)
    spec = figure.add_gridspec(1, 2, wspace=0.1, bottom=0.075)
    axes = bev_axes(figure.add_subplot(spec[0]), trace, "Reference points from the start to the last layer")
    axes.plot(*points[0].T, "o", color="#b9bec8", ms=4, zorder=2, label="start of a query")
    axes.plot(*points[0, chosen].T, "o", mfc="white", mec=INK, ms=6, zorder=4, label="start of a coloured query")
    for layer, shade in enumerate(np.linspace(0.4, 1.0, len(scores)), start=1):
        ways = points[layer - 1 : layer + 1, chosen].swapaxes(0, 1)
        axes.add_collection(LineCollection(list(ways), colors=ORANGE, alpha=shade, linewidths=2, zorder=4))
        dots = {"color": ORANGE, "alpha": shade, "ms": 7 if layer == len(scores) else 4.5, "zorder": 5}
        axes.plot(*points[layer, chosen].T, "o", label=f"after layer {layer}", **dots)
    axes.legend(loc="lower right", fontsize=11)
    title = f"Boxes with a score of at least {SHOWN_SCORE:g}; arrows: velocity"
    axes = bev_axes(figure.add_subplot(spec[1]), trace, title)
    truth(axes, trace)
    boxes(axes, trace.boxes, ORANGE, width=2.0)
    axes.plot([], [], "-", color=ORANGE, lw=2, label="prediction")
    look: dict[str, Any] = {"color": BLUE, "angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.003, "zorder": 9}
    axes.quiver(*trace.boxes.centers[:, :2].T, *trace.boxes.velocities.T, **look)
    labelled = np.zeros((0, 2))
    for center, name, score in zip(trace.boxes.centers[:, :2], trace.boxes.classes, trace.boxes.scores, strict=True):
        if not (np.abs(labelled - center) < (12, 2)).all(-1).any():
            labelled = np.append(labelled, center[None], axis=0)
            axes.text(*center + (1, 1.5), f"{name} {score:.2f}", fontsize=9, color=INK, zorder=10, clip_on=True)
    axes.legend(loc="lower right", fontsize=11)
    return figure


def box_code(trace: Trace) -> Figure:
    scores, codes, points = trace.scores, trace.codes, trace.places
    distances = np.where(scores[-1].max(-1) >= SHOWN_SCORE, np.hypot(*(codes[-1, :, :2] - trace.center).T), np.inf)
    query = int(np.where(distances < distances.min() + 0.5, scores[-1].max(-1), 0).argmax())
    label = int(scores[-1, query].argmax())
    name, code = trace.network.config.classes[label], codes[:, query]
    found = boxes_of_codes(code, np.full(len(code), name), scores[:, query, label])
    subtitle = f"Query {query}, class {name}: code and box after each decoder layer. Cross: the first reference point."
    figure = titled(6.1, "Box code: ten numbers per object query", subtitle)
    spec = figure.add_gridspec(1, 2, width_ratios=(1.75, 1), wspace=0.09, left=0.015, bottom=0.085)
    (length, width, height), last = found.sizes_lwh[-1], code[-1]
    meanings = {
        "cx": f"centre at x = {last[0]:.1f} m", "cy": f"centre at y = {last[1]:.1f} m",
        "log w": f"width {width:.2f} m", "log l": f"length {length:.2f} m",
        "cz": f"centre at z = {last[4]:.2f} m", "log h": f"height {height:.2f} m",
        "sin": f"angle from -y, clockwise: yaw = {np.degrees(found.yaws[-1]):.0f}°", "cos": "the same angle",
        "vx": f"velocity in x {last[8]:+.2f} m/s", "vy": f"velocity in y {last[9]:+.2f} m/s",
        "score": f"sigmoid of the logit of class {name}",
    }  # fmt: skip
    values = np.column_stack([code, found.scores]).T  # (11, L)
    rows = [[*(f"{value:+.2f}" for value in row), text] for row, text in zip(values, meanings.values(), strict=True)]
    heads = [*(f"layer {layer + 1}" for layer in range(len(code))), "meaning of the last layer"]
    axes = figure.add_subplot(spec[0])
    axes.axis("off")
    look: dict[str, Any] = {"cellLoc": "left", "edges": "horizontal", "bbox": (0.1, 0, 0.9, 1)}
    cells = axes.table(rows, rowLabels=list(meanings), colLabels=heads, colWidths=[0.14] * len(code) + [0.5], **look)
    cells.set_fontsize(12)
    axes = bev_axes(figure.add_subplot(spec[1]), trace, "Box after each layer")
    truth(axes, trace)
    boxes(axes, found[:-1], BLUE, width=1.4, style=":")
    boxes(axes, found[-1:], ORANGE, width=2.4)
    axes.plot(*points[:, query].T, "-", color=GREY, lw=1, zorder=5)
    axes.plot(*points[0, query], "x", color=INK, ms=9, mew=2, zorder=9)
    reach = max(8.0, 1.15 * np.abs(points[:, query] - last[:2]).max())
    axes.set(xlim=(last[0] - reach, last[0] + reach), ylim=(last[1] - reach, last[1] + reach))
    axes.plot([], [], ":", color=BLUE, label="earlier layers")
    axes.plot([], [], "-", color=ORANGE, label="last layer")
    axes.legend(loc="lower right", fontsize=11)
    return figure


def segmentation(trace: Trace) -> Figure:
    outputs, stuff = trace.calls["segmentation_head"][2], len(STUFF_CLASSES)
    masks = outputs.mask_logits[-1, 0].sigmoid() * outputs.class_logits[-1, 0].sigmoid()[:, None]
    subtitle = f"Top: mask times class probability; the maximum of {len(masks) - stuff} vehicle queries. Bottom: maps."
    figure = titled(8.9, "Segmentation head: each query paints one mask on the BEV grid", subtitle)
    spec = figure.add_gridspec(1, 4, wspace=0.1, left=0.045, right=0.94, top=0.805, bottom=0.52)
    layers = torch.cat([masks[:stuff], masks[stuff:].amax(0, keepdim=True)])
    for column, (name, layer) in enumerate(zip((*STUFF_CLASSES, THING_CLASS), layers, strict=True)):
        axes = bev_axes(figure.add_subplot(spec[column]), trace, name.replace("_", " "), y_labels=column == 0)
        image = show(axes, trace, trace.as_map(layer)[..., 0], cmap="magma", vmin=0, vmax=1)
        axes.set_xlabel("")
    figure.colorbar(image, cax=figure.add_axes((0.95, 0.55, 0.01, 0.22)), ticks=(0, 0.5, 1))
    lower = figure.add_gridspec(1, 3, wspace=0.1, left=0.045, right=1.06, top=0.445, bottom=0.06)
    maps = {"Merged map of the model": trace.prediction.segmentation, "Ground truth": trace.frame.ground_truth_map}
    for column, (title, bev_map) in enumerate(maps.items()):
        show_map(bev_axes(figure.add_subplot(lower[column]), trace, title), trace, bev_map)
    axes = figure.add_subplot(lower[2])
    axes.axis("off")
    handles = [Patch(fc=np.array(color) / 255, label=name.replace("_", " ")) for name, color in MAP_COLORS.items()]
    axes.legend(handles=handles, loc="center left", fontsize=13, frameon=False)
    return figure


FIGURES = (
    overview, image_features, bev_queries, can_bus, pillars, spatial_attention, temporal_attention, encoder_layers,
    recurrence, decoder, box_code, segmentation,
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drive", type=Path, default=ROOT / "samples/street")
    parser.add_argument("--frame", type=int, default=10, help="index of the frame, not the first of its scene")
    parser.add_argument(
        "--cell", type=float, nargs=2, default=(-7.5, 13.5), metavar=("X", "Y"), help="the cell to follow"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "docs/images")
    given = parser.parse_args()
    trace = Trace(bevcli.open_sequence(given.drive, frames=slice(0, given.frame + 1)), tuple(given.cell))
    given.out.mkdir(parents=True, exist_ok=True)
    for draw in FIGURES:
        path = given.out / f"bevformer-{draw.__name__.replace('_', '-')}.jpg"
        draw(trace).savefig(path, pil_kwargs={"quality": 86, "optimize": True})
        print(path)


if __name__ == "__main__":
    main()
