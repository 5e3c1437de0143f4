"""The report of a mounting from flatness: in a browser, and as text."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarpose.model.spun_scan import MountingRun
from lidarpose.report.mounting_page import mounting_page, mounting_verdict
from lidarpose.workflows.self_calibration import axis_in_fan, calibrate_by_flatness
from tests_support.browser import Browser
from tests_support.page_checks import assert_sound, scene_ink, scene_middle
from tests_support.rooms import mounting, sweep_room


@pytest.fixture(scope="module")
def runs() -> dict[str, MountingRun]:
    """A sound room, and one whose beam angles are off by a factor."""
    start = axis_in_fan(np.pi / 2.0)
    truth = mounting((1.8, -1.3), (0.03, -0.02), start)
    readings, beams = np.arange(0.0, 360.0, 4.0), np.arange(-90.0, 90.0, 2.0)
    recordings = {
        "good": sweep_room(truth, readings, beams, seed=1),
        "doubtful": sweep_room(truth, readings, beams, seed=1, angle_factor=1.03),
    }
    return {
        name: calibrate_by_flatness(recording, start, provenance={"command": "calibrate"})
        for name, recording in recordings.items()
    }


@pytest.mark.parametrize("size", [(1280, 900), (390, 844)], ids=["desktop", "phone"])
@pytest.mark.parametrize("name", ["good", "doubtful"])
def test_page_in_a_browser(
    browser: Browser, runs: dict[str, MountingRun], tmp_path: Path, name: str, size: tuple[int, int]
) -> None:
    (tmp_path / "page.html").write_text(mounting_page(runs[name], "a room"), encoding="utf-8")
    page = browser.open(tmp_path / "page.html", width=size[0], height=size[1], dark=name == "doubtful")
    assert_sound(page)
    x, y = scene_middle(page)
    before = scene_ink(page)
    assert before[0] > 0.002
    drag = page.drag if size[0] > 600 else page.swipe
    drag((x, y), (x + 80.0, y - 30.0))
    assert scene_ink(page)[1] != before[1]
    page.close()


def test_a_good_page_tells_its_numbers(runs: dict[str, MountingRun]) -> None:
    run = runs["good"]
    text = mounting_page(run, "a <room>")
    assert "Good: use this calibration" in text
    assert "What to do" not in text
    assert "a &lt;room&gt;" in text
    assert "at reading 0 (z along its axis), which files call camera" in text
    assert "cv2.projectPoints" not in text
    for number in run.calibration.pose(0.0).translation:
        assert f"{number:.6f}" in text
    for words in ("Tilt against the axis", "Surface 6", "off the plane, mm", "left alone", "What no scene can tell"):
        assert words in text
    for surface in run.estimate.surfaces:
        assert f">{surface.returns}<" in text
    assert len(text) < 1e6


def test_a_doubtful_page_says_why_and_what_to_do(runs: dict[str, MountingRun]) -> None:
    run = runs["doubtful"]
    text = mounting_page(run, "room")
    assert "Doubtful: read the reasons first" in text
    assert "--estimate beam-angle-scale" in text
    assert "seems to be missing" in text
    assert mounting_verdict(run).todo


def test_points_lie_on_their_surfaces(runs: dict[str, MountingRun]) -> None:
    run = runs["good"]
    assert run.seen is not None
    for k, surface in enumerate(run.estimate.surfaces):
        mine = run.seen.surface == k
        assert mine.sum() == surface.returns
        off = run.seen.points[mine] @ surface.plane.normal - surface.plane.offset
        np.testing.assert_allclose(off, run.seen.off_m[mine], atol=1e-12)
        assert np.median(np.abs(off)) < 0.01


def test_a_run_without_points_has_a_page_too(runs: dict[str, MountingRun]) -> None:
    text = mounting_page(replace(runs["good"], seen=None), "room")
    assert "Good" in text
    assert "off the plane" not in text
