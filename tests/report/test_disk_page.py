"""The report of a measured disk: in a browser, and what it rests on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.geometry.arrays import perpendicular_pair
from lidarpose.model.round_view import RoundView
from lidarpose.report.disk_page import disk_page
from tests_support.browser import Browser
from tests_support.page_checks import assert_sound, scene_ink, scene_middle


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulated, measured and reported by the commands."""
    folder = tmp_path_factory.mktemp("disk")
    assert run(["simulate", "disk", str(folder / "d")]) == 0
    calibration = str(folder / "d.calibration.json")
    assert run(["measure", "disk", str(folder / "d"), calibration, "--report", str(folder / "disk.html")]) == 0
    return folder / "disk.html"


@pytest.mark.parametrize("size", [(1280, 900), (390, 844)], ids=["desktop", "phone"])
def test_page_in_a_browser(browser: Browser, page_file: Path, size: tuple[int, int]) -> None:
    page = browser.open(page_file, width=size[0], height=size[1])
    assert_sound(page)
    x, y = scene_middle(page)
    before = scene_ink(page)
    assert before[0] > 0.002
    drag = page.drag if size[0] > 600 else page.swipe
    drag((x, y), (x + 80.0, y - 30.0))
    assert scene_ink(page)[1] != before[1]
    page.close()


def test_page_tells_diameter_and_parts(page_file: Path) -> None:
    text = page_file.read_text(encoding="utf-8")
    assert "Diameter 140.0" in text
    assert "Circle of the outermost points" in text
    assert "standard deviation of the diameter" in text
    assert len(text) < 1e6


def test_decimals_follow_the_standard_deviation() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.07, 0.07, (400, 2))
    axes = np.stack(perpendicular_pair([0.0, 0.0, -1.0]))
    view = RoundView(
        "hole",
        "<b>plate</b>.ply",
        "camera",
        0.12345678,
        0.00234,
        {"edge": 0.002, "plane": 0.001},
        0.125,
        np.array([0.0, 0.0, 1.0]),
        np.array([0.0, 0.0, -1.0]),
        0.8,
        0.001,
        points[:200],
        points[200:],
        np.column_stack([points, np.ones(400)]),
        axes,
        ("part of the edge is hidden",),
    )
    text = disk_page(view)
    assert "Diameter 123.5 mm, ±2.3 mm" in text
    assert "Part of the edge is hidden" in text
    assert "<b>plate" not in text
