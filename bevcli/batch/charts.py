"""Histograms and bars as inline SVG, for pages that need no other file. Colours come from the style of the page."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import ArrayLike

WIDTH, HEIGHT = 420, 180
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 24, 10, 36


def histogram(values: ArrayLike, label: str, bins: int = 24) -> str:
    """A histogram of numbers. label: of the horizontal axis, with its unit."""
    numbers = np.asarray(values, dtype=np.float64)
    numbers = numbers[np.isfinite(numbers)]
    if not len(numbers):
        return '<p class="none">no values</p>'
    low, high = float(numbers.min()), float(numbers.max())
    if low == high:
        low, high = (max(low - 0.5, 0) if low >= 0 else low - 0.5), high + 0.5
    counts, edges = np.histogram(numbers, bins, (low, high))
    return bars(counts.tolist(), edges, label)


def bars(counts: Sequence[float], edges: ArrayLike, label: str) -> str:
    """N bars with N + 1 edges on the horizontal axis."""
    ends = np.asarray(edges, dtype=np.float64)
    top = max(max(counts, default=0), 1)
    span = float(ends[-1] - ends[0])
    inner_width, inner_height = WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM
    base = HEIGHT - _BOTTOM

    def x_of(value: float) -> float:
        return _LEFT + (value - float(ends[0])) / span * inner_width

    parts = []
    for count, low, high in zip(counts, ends[:-1], ends[1:], strict=True):
        height = count / top * inner_height
        left, right = x_of(float(low)), x_of(float(high))
        title = f"<title>{_short(low)} to {_short(high)}: {_short(count)}</title>"
        parts.append(
            f'<rect x="{left + 0.5:.1f}" y="{base - height:.1f}" width="{max(right - left - 1, 1):.1f}" '
            f'height="{height:.1f}">{title}</rect>'
        )
    for value in np.linspace(ends[0], ends[-1], 5):
        parts.append(f'<text x="{x_of(float(value)):.1f}" y="{base + 14}" text-anchor="middle">{_short(value)}</text>')
    parts.append(f'<text x="{_LEFT - 6}" y="{_TOP + 8}" text-anchor="end">{_short(top)}</text>')
    parts.append(f'<text x="{_LEFT - 6}" y="{base}" text-anchor="end">0</text>')
    parts.append(f'<line x1="{_LEFT}" y1="{base}" x2="{WIDTH - _RIGHT}" y2="{base}"/>')
    middle = _LEFT + inner_width / 2
    parts.append(f'<text x="{middle}" y="{HEIGHT - 6}" text-anchor="middle">{escape(label)}</text>')
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(label)}">{"".join(parts)}</svg>'


def _short(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 or float(value).is_integer() else f"{value:.3g}"
