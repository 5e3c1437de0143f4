"""Charts as SVG text: scales with round ticks, axes with units, lines, points, boxes, bands, ellipses.

Colours come from the page's style sheet through classes, so that one drawing serves light and dark. Text has one size,
in CSS pixels of the width that the chart is drawn for: a figure is drawn once for a desktop and once for a phone.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.geometry.arrays import FloatArray
from lidarpose.report.markup import AttributeValue, Markup, el, join

FONT_PX = 12.5
_CHARACTER_PX = 7.0
_TOP_PX, _BOTTOM_PX, _RIGHT_PX = 30.0, 40.0, 14.0


def text_width(text: str) -> float:
    """Width of a chart's text in pixels, estimated on the safe side."""
    return _CHARACTER_PX * len(text)


@dataclass(frozen=True)
class Axis:
    """What is drawn along one axis: its name with the unit, its limits, how it is divided, and if it runs backwards."""

    label: str
    low: float
    high: float
    log: bool = False
    ticks: tuple[float, ...] | None = None
    reverse: bool = False

    def __post_init__(self) -> None:
        low, high = float(self.low), float(self.high)
        if not (np.isfinite(low) and np.isfinite(high)) or high < low or (self.log and low <= 0.0):
            raise ValueError(f"an axis from {low} to {high} cannot be drawn")
        if high == low:
            spread = abs(low) * 0.1 or 1.0
            low, high = (low / 2.0, high * 2.0) if self.log else (low - spread, high + spread)
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    def share(self, values: ArrayLike) -> FloatArray:
        """Where values lie between the limits, 0 to 1."""
        v = np.asarray(values, dtype=np.float64)
        if self.log:
            with np.errstate(divide="ignore", invalid="ignore"):
                return np.asarray(np.log(v / self.low) / np.log(self.high / self.low))
        share = (v - self.low) / (self.high - self.low)
        return np.asarray(1.0 - share if self.reverse else share)

    def tick_values(self, most: int) -> list[float]:
        """Round numbers within the limits, no more than about `most`."""
        if self.ticks is not None:
            inside = [t for t in self.ticks if self.low <= t <= self.high]
            stride = 1
            while len(inside) > stride * (most + 1):
                stride *= 2
            # Of the thinned ticks zero is one, if it is a tick at all.
            return inside[(inside.index(0.0) if 0.0 in inside else 0) % stride :: stride]
        return log_ticks(self.low, self.high, most) if self.log else round_ticks(self.low, self.high, most)


def round_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten in [low, high]."""
    power = 10.0 ** np.floor(np.log10((high - low) / max(1, most)))
    for multiple in (1.0, 2.0, 5.0, 10.0, 20.0):
        step = float(multiple * power)
        first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
        if last - first < most:
            break
    return [float(f"{k * step:.12g}") for k in range(first, last + 1)]


def log_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """1, 2, 5 times powers of ten in [low, high], or powers alone where those are many."""
    powers = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 1)
    for digits in ((1, 2, 5), (1, 3), (1,)):
        ticks = [d * 10.0**p for p in powers for d in digits]
        ticks = [float(f"{t:.6g}") for t in ticks if low * (1 - 1e-9) <= t <= high * (1 + 1e-9)]
        if len(ticks) <= most:
            return ticks
    return ticks[:: max(1, -(-len(ticks) // most))]


def padded(values: ArrayLike, share: float = 0.06, least: float = 0.0) -> tuple[float, float]:
    """Limits of the finite values with some air around them, at least `least` apart."""
    v = np.asarray(values, dtype=np.float64)
    v = v[np.isfinite(v)]
    if v.size == 0:
        return 0.0, 1.0
    low, high = float(v.min()), float(v.max())
    air = max(share * (high - low), (least - (high - low)) / 2.0, 0.0)
    return low - air, high + air


def tick_text(value: float, ticks: Sequence[float]) -> str:
    """A tick's number with as many decimals as the division needs, and a true minus sign."""
    steps = np.diff(sorted(ticks)) if len(ticks) > 1 else np.array([abs(value) or 1.0])
    decimals = max(0, -int(np.floor(np.log10(max(float(steps.min()), 1e-9)) + 1e-9)))
    text = f"{value:.{min(decimals, 9)}f}"
    return text.replace("-", "\u2212") if float(text) else text.lstrip("-")


@dataclass
class Chart:
    """One chart of a given size in pixels: two axes, and marks in their units.

    `equal` makes a unit as long on both axes, by widening one of them.
    """

    width: float
    height: float
    x: Axis
    y: Axis
    description: str
    equal: bool = False
    parts: list[Markup] = field(default_factory=list)
    labels: list[Markup] = field(default_factory=list)
    _left_px: float = 0.0

    def __post_init__(self) -> None:
        # The height fixes the y ticks, and their text the room on the left.
        ticks = self.y.tick_values(self._most_y_ticks())
        self._left_px = 12.0 + max((text_width(tick_text(t, ticks)) for t in ticks), default=0.0)
        if self.equal:
            self._equalise()

    @property
    def inner(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom of the area within the axes, pixels."""
        return self._left_px, _TOP_PX, self.width - _RIGHT_PX, self.height - _BOTTOM_PX

    def px(self, x: ArrayLike) -> FloatArray:
        left, _, right, _ = self.inner
        return np.asarray(left + (right - left) * self.x.share(x))

    def py(self, y: ArrayLike) -> FloatArray:
        _, top, _, bottom = self.inner
        return np.asarray(bottom - (bottom - top) * self.y.share(y))

    def line(self, x: ArrayLike, y: ArrayLike, class_: str) -> None:
        """A polyline; NaN breaks it."""
        data = path_data(self.px(x), self.py(y))
        if data:
            self.parts.append(el("path", d=data, class_=f"line {class_}"))

    def area(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, class_: str) -> None:
        """A filled band between two curves."""
        px = np.concatenate([self.px(x), self.px(x)[::-1]])
        py = np.concatenate([self.py(low), self.py(high)[::-1]])
        self.parts.append(el("path", d=path_data(px, py) + "Z", class_=f"area {class_}"))

    def points(self, x: ArrayLike, y: ArrayLike, class_: str, radius: float = 2.0) -> None:
        """Dots, as one path: thousands of them stay small. The dot's size is its stroke's."""
        px, py = self.px(x), self.py(y)
        ok = np.isfinite(px) & np.isfinite(py)
        data = "".join(f"M{u:.1f} {v:.1f}h0" for u, v in zip(px[ok].tolist(), py[ok].tolist(), strict=True))
        if data:
            self.parts.append(el("path", d=data, class_=f"dots {class_}", stroke_width=2.0 * radius))

    def crosses(self, x: ArrayLike, y: ArrayLike, class_: str, size: float = 3.0) -> None:
        """Crosses, for what was left out."""
        px, py = self.px(x), self.py(y)
        ok = np.isfinite(px) & np.isfinite(py)
        data = "".join(
            f"M{u - size:.1f} {v - size:.1f}l{2 * size:g} {2 * size:g}m0 {-2 * size:g}l{-2 * size:g} {2 * size:g}"
            for u, v in zip(px[ok], py[ok], strict=True)
        )
        if data:
            self.parts.append(el("path", d=data, class_=f"line {class_}"))

    def sticks(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, class_: str, width_px: float) -> None:
        """Vertical bars from `low` to `high`, clipped to the axes; for the boxes of box plots."""
        px = self.px(x)
        top, bottom = (np.clip(self.py(v), self.inner[1], self.inner[3]) for v in (high, low))
        data = "".join(
            f"M{u:.1f} {b:.1f}V{min(t, b - 0.5):.1f}" for u, b, t in zip(px, bottom, top, strict=True) if np.isfinite(u)
        )
        if data:
            self.parts.append(el("path", d=data, class_=f"sticks {class_}", stroke_width=float(width_px)))

    def bars(self, edges: ArrayLike, heights: ArrayLike, class_: str) -> None:
        """A histogram: N + 1 edges, N heights, standing on the axis."""
        px, py = self.px(edges), self.py(heights)
        floor = self.inner[3]
        data = "".join(
            f"M{a + 0.5:.1f} {floor:.1f}V{h:.1f}H{b - 0.5:.1f}V{floor:.1f}Z"
            for a, b, h in zip(px[:-1], px[1:], py, strict=True)
            if h < floor
        )
        if data:
            self.parts.append(el("path", d=data, class_=f"area {class_}"))

    def level(self, y: float, class_: str, label: str = "", below: bool = False) -> None:
        """A horizontal line across the chart, with a label at its right end."""
        left, top, right, bottom = self.inner
        at = float(self.py(y))
        if not top - 0.5 <= at <= bottom + 0.5:
            return
        self.parts.append(el("path", d=f"M{left:.1f} {at:.1f}H{right:.1f}", class_=f"line {class_}"))
        if label:
            self.text_px(right - 4.0, at + (FONT_PX + 2.0 if below else -5.0), label, class_, anchor="end")

    def span(self, low: float, high: float, class_: str) -> None:
        """A vertical band across the whole height."""
        _, top, _, bottom = self.inner
        a, b = (float(v) for v in self.px([low, high]))
        self.parts.append(
            el("rect", x=round(a, 1), y=top, width=round(max(b - a, 1.0), 1), height=bottom - top, class_=class_)
        )

    def ellipse(self, centre: ArrayLike, covariance: ArrayLike, class_: str, sigmas: float = 1.0) -> None:
        """The error ellipse of a 2x2 covariance in the axes' units."""
        values, vectors = np.linalg.eigh(np.asarray(covariance, dtype=np.float64))
        turn = np.linspace(0.0, 2.0 * np.pi, 61)
        circle = np.stack([np.cos(turn), np.sin(turn)]) * np.sqrt(np.maximum(values, 0.0))[:, None] * sigmas
        outline = (vectors @ circle).T + np.asarray(centre)
        self.parts.append(el("path", d=path_data(*self._to_px(outline)) + "Z", class_=f"line {class_}"))

    def text_px(
        self, u: float, v: float, text: str, class_: str = "", anchor: Literal["start", "middle", "end"] = "start"
    ) -> None:
        self.labels.append(_text(u, v, text, class_, anchor))

    def render(self) -> Markup:
        """The chart as one SVG element; marks are clipped to the axes, text is not."""
        left, top, right, bottom = self.inner
        name = f"c{zlib.crc32(f'{self.description}|{self.width}|{self.height}'.encode()):08x}"
        window = el("rect", x=left, y=top - 1.0, width=right - left + 1.0, height=bottom - top + 2.0)
        clip = el("clipPath", window, id=name)
        marks = el("g", *self.parts, clip_path=f"url(#{name})")
        return drawing(self.width, self.height, [clip, self._frame(), marks, *self.labels], self.description)

    def _to_px(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.px(points[:, 0]), self.py(points[:, 1])

    def _most_y_ticks(self) -> int:
        return max(3, int((self.height - _TOP_PX - _BOTTOM_PX) / 34.0))

    def _most_x_ticks(self) -> int:
        left, _, right, _ = self.inner
        return max(3, int((right - left) / 64.0))

    def _equalise(self) -> None:
        left, top, right, bottom = self.inner
        per_px = max((self.x.high - self.x.low) / (right - left), (self.y.high - self.y.low) / (bottom - top))
        self.x = _widened(self.x, per_px * (right - left))
        self.y = _widened(self.y, per_px * (bottom - top))

    def _frame(self) -> Markup:
        """Grid, tick labels and the axes' names: y above its axis and horizontal, x below."""
        left, _, right, bottom = self.inner
        xs, ys = self.x.tick_values(self._most_x_ticks()), self.y.tick_values(self._most_y_ticks())
        grid = "".join(f"M{left:.1f} {v:.1f}H{right:.1f}" for v in self.py(ys))
        marks = "".join(f"M{u:.1f} {bottom:.1f}v4" for u in self.px(xs))
        parts = [
            el("path", d=grid, class_="grid"),
            el("path", d=f"M{left:.1f} {bottom:.1f}H{right:.1f}{marks}", class_="axis"),
        ]
        parts += [
            _text(left - 6.0, float(v) + 4.0, tick_text(t, ys), "tick", "end")
            for t, v in zip(ys, self.py(ys), strict=True)
        ]
        for t, u in zip(xs, self.px(xs), strict=True):
            label = tick_text(t, xs)
            half = text_width(label) / 2.0
            parts.append(_text(min(float(u), self.width - half), bottom + 17.0, label, "tick", "middle"))
        parts.append(_text(2.0, 13.0, self.y.label, "name"))
        parts.append(_text(right, bottom + 34.0, self.x.label, "name", "end"))
        return join(parts)


def drawing(width: float, height: float, parts: Sequence[Markup], description: str) -> Markup:
    """An SVG element that fills its column and is described to those who cannot see it."""
    return el(
        "svg",
        *parts,
        viewbox=f"0 0 {width:g} {height:g}",
        role="img",
        aria_label=description,
    )


def path_data(x: ArrayLike, y: ArrayLike) -> str:
    """Path commands through points; NaN breaks the line."""
    px, py = (np.asarray(values, dtype=float).ravel() for values in (x, y))
    fine = (np.isfinite(px) & np.isfinite(py)).tolist()
    out: list[str] = []
    pen = "M"
    # Python's own numbers, which are written ten times as fast as NumPy's.
    for u, v, ok in zip(px.tolist(), py.tolist(), fine, strict=True):
        if ok:
            out.append(f"{pen}{u:.1f} {v:.1f}")
            pen = "L"
        else:
            pen = "M"
    return "".join(out)


def columns_of(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (N, 2) as what charts take: x (N,) and y (N,)."""
    return points[:, 0], points[:, 1]


def _text(u: float, v: float, text: str, class_: str, anchor: AttributeValue = "start") -> Markup:
    return el(
        "text",
        text,
        x=round(u, 1),
        y=round(v, 1),
        class_=class_ or None,
        text_anchor=None if anchor == "start" else anchor,
    )


def _widened(axis: Axis, length: float) -> Axis:
    middle = (axis.low + axis.high) / 2.0
    return Axis(axis.label, middle - length / 2.0, middle + length / 2.0, axis.log, axis.ticks, axis.reverse)
