"""The measuring house itself: the list, the page, the comparison, the limits. Nothing here is timed."""

from typing import Any

import numpy as np
import pytest
from benchmarks.limits import motion_bound, pose_limits
from benchmarks.metrics import BY_KEY, METRICS, Metric
from benchmarks.page import markdown, page
from benchmarks.report import Curve, Report, Table
from benchmarks.run import SUITES, compare
from benchmarks.suites.growth import memory_exponent
from benchmarks.timing import beside, exponent, interleaved, processor_seconds

from lidarpose.simulate.rig import draw_rig


def results(value: float, load: float = 0.1, pace_s: float | None = None) -> dict[str, Any]:
    report = Report(
        {"start.help_s": value},
        [Table("Starting", ["process", "s"], [["lidarpose", 0.1234], ["open3d", None]])],
        [Curve("drawn", "Drawn", "size", "s", [1.0, 10.0], {"ours": [0.1, 1.0], "theirs": [float("nan"), 3.0]})],
        pace_s=pace_s,
    )
    machine = {"cores": 2, "load": load, "versions": {"Python": "3.11"}}
    return {"machine": machine, "quick": False, "suites": {"starting": report.as_json()}}


def test_every_metric_has_its_own_name_and_a_tolerance() -> None:
    assert len(BY_KEY) == len(METRICS)
    assert all(0.0 < m.tolerance < 1.0 and m.what for m in METRICS)
    assert len(set(SUITES)) == len(SUITES)


def test_a_target_is_met_on_its_own_side() -> None:
    low, high = Metric("a", "a", "s", 0.1, 2.0), Metric("b", "b", "x", 0.1, 2.0, "higher")
    assert (low.met(1.9), low.met(2.1), high.met(1.9), high.met(2.1)) == (True, False, False, True)
    assert Metric("c", "c", "s", 0.1).met(1.0) is None


def test_the_page_says_what_was_met_missed_not_measured_and_not_installed() -> None:
    met, missed = page(results(0.1)), page(results(0.3))
    assert "| `lidarpose --help`, warm | 0.1 s | at most 0.2 s | met | 30 % |" in met
    assert "**missed**" not in met
    assert "| `lidarpose --help`, warm | 0.3 s | at most 0.2 s | **missed** | 30 % |" in missed
    assert "not measured" in met
    assert "| open3d | not installed |" in met
    assert "images/bench-drawn.svg" in met


def test_what_bounds_several_figures_is_told_once() -> None:
    told = results(0.1)
    told["suites"]["starting"]["figures"] = {"calibrate.plain": 9.0, "calibrate.report": 8.0}
    lines = page(told).splitlines()
    first = lines.index("Missed, and what bounds them:") + 2
    report, plain = BY_KEY["calibrate.report"], BY_KEY["calibrate.plain"]
    assert lines[first] == f"- {report.what}: 8 x; {plain.what}: 9 x"
    assert " ".join(line.removeprefix("  - ") for line in lines[first + 1 :] if line.startswith("  - ")) == " ".join(
        plain.bound.splitlines()
    )


def test_a_busy_machine_is_told() -> None:
    told = page(results(0.9, load=7.0))
    assert "The machine was busy" in told
    assert "| 0.9 s | at most 0.2 s | not judged |" in told
    assert "**missed**" not in told
    assert "busy" not in page(results(0.1))


def test_two_runs_are_compared_within_the_tolerance() -> None:
    same = compare(results(0.1), results(0.12))
    assert same.lines() == ["1 of 1 figures are the same within their tolerances."]
    slower, faster = compare(results(0.1), results(0.2)), compare(results(0.2), results(0.1))
    (line,) = slower.worse
    assert line.startswith("start.help_s: 0.1 before, 0.2 now")
    assert slower.lines()[-1].startswith("0 of 1")
    assert len(faster.better) == 1
    assert not faster.worse


def test_seconds_are_compared_in_units_of_the_pace() -> None:
    # A machine half as fast: twice the seconds are the same figure, and the same seconds a better one.
    before, now = results(0.1, pace_s=0.03), results(0.2, pace_s=0.06)
    assert compare(before, now).agree == 1
    assert len(compare(before, results(0.1, pace_s=0.06)).better) == 1
    assert len(compare(before, results(0.2, pace_s=0.03)).worse) == 1
    # An earlier run without it is compared as it is.
    assert len(compare(results(0.1), now).worse) == 1


def test_an_exponent_is_held_to_a_difference() -> None:
    metric = BY_KEY["growth.frames_mb"]
    assert metric.tolerance_text == "± 0.15"
    assert metric.agrees(0.02, 0.12)
    assert not metric.agrees(0.02, 0.22)
    assert "± 0.15 |" in page(results(0.1))


def test_what_cannot_be_compared_is_said() -> None:
    seconds_of_a_busy_machine = compare(results(0.1), results(0.9, load=7.0))
    assert not seconds_of_a_busy_machine.worse
    assert len(seconds_of_a_busy_machine.unjudged) == 1
    less = results(0.1)
    less["suites"]["starting"]["figures"] = {}
    assert compare(results(0.1), less).alone == ["start.help_s: before"]
    # A suite that was not run again is no difference.
    less["suites"] = {}
    assert compare(results(0.1), less).lines() == ["0 of 0 figures are the same within their tolerances."]
    with pytest.raises(ValueError, match="quick"):
        compare(results(0.1), {**results(0.1), "quick": True})


def test_a_drawing_is_well_formed() -> None:
    from xml.etree import ElementTree

    from benchmarks.drawing import svg

    curve = Curve("n", "A < B", "x", "y", [1.0, 10.0, 100.0], {"one & two": [1.0, 2.0, float("nan")]})
    root = ElementTree.fromstring(svg(curve))
    assert len(root.findall(".//{http://www.w3.org/2000/svg}circle")) == 2


def test_ways_are_interleaved_and_a_slow_one_stops() -> None:
    order: list[str] = []
    times = interleaved({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 3)
    assert order == ["a", "b"] * 3
    assert set(times) == {"a", "b"}
    order.clear()
    interleaved({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 3, budget_s=0.0)
    assert order == ["a", "b"]


def test_each_way_stands_between_two_runs_of_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    # A clock of its own: the machine gets slower by a tenth with each run, the way takes three times the reference.
    order: list[str] = []
    now = 0.0

    def work(name: str, cost: float) -> None:
        nonlocal now
        order.append(name)
        now += cost * 1.1 ** len([one for one in order if one != "clean"])

    monkeypatch.setattr("benchmarks.timing.time.perf_counter", lambda: now)
    found = beside(
        lambda: work("reference", 1.0),
        {"way": lambda: work("way", 3.0)},
        2,
        before_each=lambda: order.append("clean"),
        least_s=0.0,
    )
    assert order == ["clean", "reference", *["clean", "way", "clean", "reference"] * 2]
    assert found.over["way"] == pytest.approx(3.0, rel=0.01)
    assert found.seconds["way"] > 3.0


def test_short_runs_beside_a_reference_are_repeated() -> None:
    counted = {"reference": 0, "way": 0}

    def work(name: str) -> None:
        counted[name] += 1

    beside(lambda: work("reference"), {"way": lambda: work("way")}, 1, least_s=1.0)
    assert counted == {"reference": 100, "way": 50}


def test_processor_time_holds_that_of_child_processes() -> None:
    import subprocess
    import sys

    child = [sys.executable, "-c", "import time\nwhile time.process_time() < 0.2: pass"]
    assert processor_seconds(lambda: subprocess.run(child, check=True)) > 0.15
    assert processor_seconds(lambda: None) < 0.1


def test_exponents_of_powers() -> None:
    assert exponent([1, 2, 4], [3, 12, 48]) == pytest.approx(2.0)


def test_a_table_in_markdown() -> None:
    assert markdown(["a", "b"], [[1, 0.12345]]) == ["| a | b |", "|---|---|", "| 1 | 0.123 |"]


def test_the_bound_falls_with_more_data_and_without_noise() -> None:
    few, many = draw_rig(1, places=6), draw_rig(1, places=24)
    middle = float(few.turntable_angle_rad.mean())
    limits = [pose_limits(rig, motion_bound(rig), middle)[0] for rig in (few, many)]
    # Four times the places: nearly half the standard deviation; corners are the same.
    assert 0.45 < limits[1] / limits[0] < 0.8
    more = draw_rig(1, places=6, placements=3)
    with_stripe, without = (pose_limits(more, motion_bound(more, with_stripe=s), middle)[0] for s in (True, False))
    assert without > 2.0 * with_stripe


def test_memory_in_stock_tells_nothing_of_growth() -> None:
    slope, first = memory_exponent((10, 100, 1000, 3000), (0.5, 9.0, 100.0, 300.0))
    assert slope == pytest.approx(1.0)
    assert first == 1000
    # What never takes much is fitted whole.
    slope, first = memory_exponent((10, 100), (1.0, 4.0))
    assert slope == pytest.approx(np.log10(4.0))
    assert first == 10
