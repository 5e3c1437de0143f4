"""The world report: in a browser, and as text."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarpose.model.world_run import WorldRun
from lidarpose.report.world_page import world_page
from lidarpose.simulate.corner_scene import CornerSceneSpec, simulate_corner_session
from lidarpose.workflows.world import world_run
from tests_support.browser import Browser
from tests_support.page_checks import assert_sound, scene_ink, scene_middle
from tests_support.world_runs import simulated_world_run


@pytest.fixture(scope="module")
def runs() -> dict[str, WorldRun]:
    return {
        "good": simulated_world_run(CornerSceneSpec(frames=5)),
        "bad": simulated_world_run(CornerSceneSpec(frames=2, places=5), moved_place=2, moved_m=0.06),
        "paper": simulated_world_run(CornerSceneSpec(frames=2), "paper"),
    }


@pytest.fixture(scope="module")
def pages(runs: dict[str, WorldRun], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("world")
    for name, run in runs.items():
        (folder / f"{name}.html").write_text(world_page(run), encoding="utf-8")
    return {name: folder / f"{name}.html" for name in runs}


@pytest.mark.parametrize("size", [(1280, 900), (390, 844)], ids=["desktop", "phone"])
@pytest.mark.parametrize("name", ["good", "bad", "paper"])
def test_page_in_a_browser(browser: Browser, pages: dict[str, Path], name: str, size: tuple[int, int]) -> None:
    page = browser.open(pages[name], width=size[0], height=size[1], dark=name == "bad")
    assert_sound(page)
    x, y = scene_middle(page)
    before = scene_ink(page)
    assert before[0] > 0.002
    drag = page.drag if size[0] > 600 else page.swipe
    drag((x, y), (x + 80.0, y - 30.0))
    assert scene_ink(page)[1] != before[1]
    page.close()


def test_good_page_tells_its_numbers(runs: dict[str, WorldRun]) -> None:
    text = world_page(runs["good"])
    assert "Good: use this calibration" in text
    assert "What to do" not in text
    for words in ("6 of 6", "Corners of single frames", "Place p03, face 1", "Alignment with the world", "5 of 5"):
        assert words in text


def test_the_matrix_on_the_page_holds_the_scale(runs: dict[str, WorldRun]) -> None:
    calibration = replace(runs["good"].calibration, scale=1.002)
    text = world_page(replace(runs["good"], calibration=calibration))
    found = re.search(r"<pre>(.*?)</pre>", text, re.DOTALL)
    assert found is not None
    T = np.loadtxt(found[1].splitlines())
    np.testing.assert_allclose(T[:3, :3], 1.002 * calibration.T_world_source.rotation, rtol=0.0, atol=6e-7)
    np.testing.assert_allclose(T[:3, 3], calibration.T_world_source.translation, rtol=0.0, atol=6e-7)
    assert "--to ros2" not in text
    assert "--to ros2" in world_page(runs["good"])


def test_bad_page_names_the_place_at_fault(runs: dict[str, WorldRun]) -> None:
    text = world_page(runs["bad"])
    verdict = text[text.index('id="verdict"') : text.index('class="tiles"')]
    assert "Doubtful" in verdict
    assert "P02 is left out" in verdict
    assert "row 3 of the positions would fit with -60, +0, -0 mm" in verdict


def test_rejected_page_names_the_swapped_rows() -> None:
    session, _ = simulate_corner_session(CornerSceneSpec(frames=1, places=5))
    first, second, *others = session.places
    swapped = (
        replace(first, corner_world=second.corner_world),
        replace(second, corner_world=first.corner_world),
        *others,
    )
    text = world_page(world_run(replace(session, places=swapped)))
    verdict = text[text.index('id="verdict"') : text.index('class="tiles"')]
    assert "Rejected" in verdict
    assert "The rows 1 and 2 of the positions look swapped" in verdict


def test_kept_run_holds_the_faces_and_their_corner(runs: dict[str, WorldRun]) -> None:
    """Points lie on the common planes through their place's corner; frames scatter about it."""
    run = runs["good"]
    assert run.normals is not None
    for place in run.places:
        for face, points in place.faces.items():
            off = (points - place.corner) @ run.normals[face]
            assert abs(np.median(off)) < 0.002
            assert np.std(off) < 0.012
        assert np.nanmax(np.abs(place.frame_corners - place.corner)) < 0.02
        assert np.linalg.norm(place.residual_world(run.calibration)) < 0.002


def _faceless(run: WorldRun) -> WorldRun:
    places = tuple(replace(p, faces={k: v for k, v in p.faces.items() if k < 2}) for p in run.places)
    return replace(run, places=places)


def _frames_unknown(run: WorldRun) -> WorldRun:
    places = tuple(replace(p, frame_corners=np.full_like(p.frame_corners, np.nan)) for p in run.places)
    return replace(run, places=places)


def _no_verdict(run: WorldRun) -> WorldRun:
    return replace(run, calibration=replace(run.calibration, quality=None, covariance=None))


def _all_frames_left_out(run: WorldRun) -> WorldRun:
    return replace(run, places=tuple(replace(p, frame_used=np.zeros_like(p.frame_used)) for p in run.places))


ODD_RUNS: dict[str, Callable[[WorldRun], WorldRun]] = {
    "no places": lambda run: replace(run, places=()),
    "two faces a place": _faceless,
    "no frame shows a corner": _frames_unknown,
    "all frames left out": _all_frames_left_out,
    "no verdict": _no_verdict,
    "another scale": lambda run: replace(run, calibration=replace(run.calibration, scale=1.01, source="camera")),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("odd", ODD_RUNS)
def test_odd_runs_have_a_page(runs: dict[str, WorldRun], odd: str) -> None:
    """A report never fails a calibration, whatever is missing from it."""
    text = world_page(ODD_RUNS[odd](runs["good"]))
    assert not re.search(r"\b(nan|inf)\b", text.split("<body>")[1].split("<script")[0], re.IGNORECASE)
    assert "To repeat this run" in text
