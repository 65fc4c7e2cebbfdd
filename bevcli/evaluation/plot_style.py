"""Colours and headings that the plots share."""

from __future__ import annotations

from matplotlib.figure import Figure

GRID = "#e6e6e6"
CLASS_COLORS = {
    "car": "#1f77b4", "truck": "#ff7f0e", "construction_vehicle": "#bcbd22", "bus": "#9467bd", "trailer": "#8c564b",
    "barrier": "#7f7f7f", "motorcycle": "#d62728", "bicycle": "#2ca02c", "pedestrian": "#e377c2",
    "traffic_cone": "#17becf",
}  # fmt: skip


def titled_figure(size_inches: tuple[float, float], title: str, subtitle: str) -> Figure:
    """A figure that needs no screen and touches no global state of matplotlib."""
    figure = Figure(figsize=size_inches, layout="constrained")
    figure.suptitle(f"{title}\n", fontsize=15, fontweight="bold", x=0.01, ha="left")
    figure.text(0.01, 0.955, subtitle, fontsize=10, color="#555555", ha="left", va="top")
    return figure
