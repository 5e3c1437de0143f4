"""Charts and markup: ticks, scales, ellipses, escaping."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose.report.markup import Markup, el, join, json_script
from lidarpose.report.numbers import fixed, plural, short
from lidarpose.report.svg import Axis, Chart, log_ticks, path_data, round_ticks, tick_text

_LIMITS = st.tuples(st.floats(-1e4, 1e4), st.floats(1e-2, 1e5)).map(lambda pair: (pair[0], pair[0] + pair[1]))


@settings(max_examples=60)
@given(_LIMITS, st.integers(3, 12))
def test_ticks_are_few_round_and_inside(limits: tuple[float, float], most: int) -> None:
    low, high = limits
    ticks = round_ticks(low, high, most)
    step = (high - low) / most
    assert 1 <= len(ticks) <= most + 1
    assert all(low - 1e-6 * (high - low) <= t <= high + 1e-6 * (high - low) for t in ticks)
    if len(ticks) > 1:
        steps = np.diff(ticks)
        assert np.ptp(steps) <= 1e-6 * steps[0]
        assert steps[0] >= 0.5 * step


@settings(max_examples=60)
@given(_LIMITS, st.integers(3, 9))
def test_tick_texts_differ(limits: tuple[float, float], most: int) -> None:
    ticks = round_ticks(*limits, most)
    texts = [tick_text(t, ticks) for t in ticks]
    assert len(set(texts)) == len(texts)
    assert not any(text.startswith("-") for text in texts)


def test_log_ticks_stay_inside() -> None:
    assert log_ticks(0.03, 40.0, 8) == [0.1, 1.0, 10.0] or len(log_ticks(0.03, 40.0, 8)) <= 8
    assert all(0.03 <= t <= 40.0 for t in log_ticks(0.03, 40.0, 8))


def test_chart_puts_points_where_its_axes_say() -> None:
    chart = Chart(400.0, 300.0, Axis("x", 0.0, 10.0), Axis("y", -1.0, 1.0, reverse=True), "test")
    left, top, right, bottom = chart.inner
    np.testing.assert_allclose(chart.px([0.0, 10.0]), [left, right])
    np.testing.assert_allclose(chart.py([-1.0, 1.0]), [top, bottom])


def test_equal_axes_have_one_scale() -> None:
    chart = Chart(500.0, 200.0, Axis("x", 0.0, 1.0), Axis("y", 0.0, 3.0), "test", equal=True)
    per_x = float(np.ptp(chart.px([0.0, 1.0])))
    per_y = float(np.ptp(chart.py([0.0, 1.0])))
    assert per_x == pytest.approx(per_y)


def test_ellipse_holds_the_right_share_of_samples() -> None:
    """One sigma in two dimensions holds 1 - exp(-1/2) of the samples."""
    covariance = np.array([[2.0, 0.9], [0.9, 0.7]])
    chart = Chart(600.0, 600.0, Axis("x", -6.0, 6.0), Axis("y", -6.0, 6.0), "test", equal=True)
    chart.ellipse([0.0, 0.0], covariance, "p1")
    found = re.search(r'd="([^"]*)"', chart.parts[-1])
    assert found is not None
    outline = np.array([[float(v) for v in pair.split()] for pair in re.findall(r"[ML]([^MLZ]*)", found.group(1))])
    samples = np.random.default_rng(0).multivariate_normal([0.0, 0.0], covariance, 4000)
    seen = np.stack([chart.px(samples[:, 0]), chart.py(samples[:, 1])], axis=1)
    assert np.mean(_inside(outline, seen)) == pytest.approx(1.0 - np.exp(-0.5), abs=0.02)


def _inside(outline: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Even-odd rule."""
    a, b = outline, np.roll(outline, -1, axis=0)
    crosses = (a[:, 1] > points[:, 1:]) != (b[:, 1] > points[:, 1:])
    with np.errstate(divide="ignore", invalid="ignore"):
        x = a[:, 0] + (points[:, 1:] - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
    return np.asarray((crosses & (points[:, :1] < x)).sum(axis=1) % 2 == 1)


def test_paths_break_at_nan() -> None:
    assert path_data([0.0, 1.0, np.nan, 3.0], [0.0, 1.0, 2.0, 3.0]) == "M0.0 0.0L1.0 1.0M3.0 3.0"


@pytest.mark.parametrize(("low", "high", "log"), [(np.nan, 1.0, False), (2.0, 1.0, False), (0.0, 1.0, True)])
def test_impossible_axes_are_refused(low: float, high: float, log: bool) -> None:
    with pytest.raises(ValueError, match="cannot be drawn"):
        Axis("x", low, high, log)


@settings(max_examples=60)
@given(st.text())
def test_text_cannot_become_markup(text: str) -> None:
    inside = str(el("td", text, title=text))
    assert inside.count("<") == 2
    assert inside.count('"') == 2
    assert "</script" not in str(json_script("x", {"a": text}))[:-9]


def test_markup_is_kept_and_joined() -> None:
    assert join([Markup("<b>x</b>"), "<"], ", ") == "<b>x</b>, &lt;"
    assert el("br") == "<br>"
    assert el("a", class_="x", data_scene="y", hidden=True, title=None) == '<a class="x" data-scene="y" hidden></a>'
    with pytest.raises(ValueError, match="JSON"):
        json_script("x", float("nan"))


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0996, "0.10"), (0.00045, "0.00045"), (123.4, "120"), (9.99, "10"), (-0.5, "−0.50"), (0.0, "0")],
)
def test_short_numbers(value: float, text: str) -> None:
    assert short(value) == text


def test_fixed_and_plural() -> None:
    assert fixed(-0.0001, 2) == "0.00"
    assert fixed(-1.255, 1) == "−1.3"
    assert (plural(1, "place"), plural(3, "place")) == ("1 place", "3 places")
