"""A curve as a small SVG file: both axes logarithmic, a line with marks for each contestant, names beside them."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from benchmarks.report import Curve
from lidarpose.report.svg import Axis

WIDTH, HEIGHT, LEFT, TOP, BOTTOM, LEGEND = 930, 380, 62, 18, 48, 420
COLOURS = ("#0b6e4f", "#c8553d", "#3d5a98", "#b8860b", "#7a4e8a", "#5b7c85", "#9c3848", "#4d4d4d", "#88a04b")


class _Pen(NamedTuple):
    """How a line is drawn."""

    colour: str
    dash: str


def svg(curve: Curve) -> str:
    """The drawing, readable on light and dark pages (it brings its own white ground)."""
    values = np.array([v for s in curve.series.values() for v in s if np.isfinite(v) and v > 0.0])
    x_axis = Axis(curve.x_label, min(curve.x) / 1.05, max(curve.x) * 1.05, log=True)
    y_axis = Axis(curve.y_label, float(values.min()) / 1.2, float(values.max()) * 1.2, log=True)
    parts = [_grid(x_axis, y_axis, curve.x)]
    for k, (name, series) in enumerate(curve.series.items()):
        # A limit, not a contestant, is black and dashed.
        limit = name.startswith("bound")
        pen = _Pen("#222" if limit else COLOURS[k % len(COLOURS)], ' stroke-dasharray="5 3"' if limit else "")
        parts.append(_line(x_axis, y_axis, curve.x, series, pen))
        y = TOP + 14 + 20 * k
        u = WIDTH - LEGEND + 16
        parts.append(f'<path d="M{u} {y - 4}h20" stroke="{pen.colour}" stroke-width="2.2"{pen.dash}/>')
        parts.append(f'<text x="{u + 27}" y="{y}">{escape(name)}</text>')
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}" '
        'font-family="system-ui, sans-serif" font-size="12.5" fill="#222">'
        f"<title>{escape(curve.title)}</title>"
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>{"".join(parts)}</svg>\n'
    )


def _u(axis: Axis, x: Sequence[float]) -> list[float]:
    return [LEFT + float(s) * (WIDTH - LEGEND - LEFT) for s in axis.share(list(x))]


def _v(axis: Axis, y: Sequence[float]) -> list[float]:
    return [HEIGHT - BOTTOM - float(s) * (HEIGHT - BOTTOM - TOP) for s in axis.share(list(y))]


def _grid(x_axis: Axis, y_axis: Axis, x: Sequence[float]) -> str:
    parts = []
    for value, v in zip(ticks := y_axis.tick_values(7), _v(y_axis, ticks), strict=True):
        parts.append(f'<path d="M{LEFT} {v:.1f}H{WIDTH - LEGEND}" stroke="#ddd"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{v + 4:.1f}" text-anchor="end">{value:g}</text>')
    for value, u in zip(x, _u(x_axis, x), strict=True):
        parts.append(f'<path d="M{u:.1f} {TOP}V{HEIGHT - BOTTOM}" stroke="#eee"/>')
        parts.append(f'<text x="{u:.1f}" y="{HEIGHT - BOTTOM + 17}" text-anchor="middle">{value:g}</text>')
    middle = (LEFT + WIDTH - LEGEND) / 2
    parts.append(f'<text x="{middle}" y="{HEIGHT - 10}" text-anchor="middle">{escape(x_axis.label)}</text>')
    parts.append(
        f'<text transform="translate(14 {(TOP + HEIGHT - BOTTOM) / 2}) rotate(-90)" text-anchor="middle">'
        f"{escape(y_axis.label)}</text>"
    )
    return "".join(parts)


def _line(x_axis: Axis, y_axis: Axis, x: Sequence[float], y: Sequence[float], pen: _Pen) -> str:
    known = [(a, b) for a, b in zip(x, y, strict=True) if np.isfinite(b) and b > 0.0]
    if not known:
        return ""
    us, vs = _u(x_axis, [a for a, _ in known]), _v(y_axis, [b for _, b in known])
    path = "M" + "L".join(f"{u:.1f} {v:.1f}" for u, v in zip(us, vs, strict=True))
    marks = "".join(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="3"/>' for u, v in zip(us, vs, strict=True))
    line = f'<path d="{path}" fill="none" stroke="{pen.colour}" stroke-width="2"{pen.dash}/>'
    return f'{line}<g fill="{pen.colour}">{marks}</g>'
