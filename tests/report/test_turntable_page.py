"""The turntable report: in a browser, and as text."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarpose.errors import InputError
from lidarpose.geometry.se3 import Pose
from lidarpose.model.image import GrayImage
from lidarpose.model.scan import Scan
from lidarpose.model.turntable_result import ResidualGroup
from lidarpose.model.turntable_run import Deviation, TruthError, TurntableRun
from lidarpose.report.turn_numbers import arc_deg, turn_numbers
from lidarpose.report.turntable_page import turntable_page
from lidarpose.report.turntable_scene import turntable_scene
from tests_support.browser import Browser
from tests_support.page_checks import assert_sound, scene_ink, scene_middle
from tests_support.turntable_runs import turntable_run

DESK, PHONE = (1280, 900), (390, 844)
_TWO_FRAMES = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
_TURN_TABLE = (
    "(() => { const s = document.getElementById('scene-angle'); s.value = 180;"
    " s.dispatchEvent(new Event('input')); })()"
)


def some_image(run: TurntableRun) -> GrayImage:
    """Noise of the camera's size: harder to compress than any board."""
    camera = run.observations.camera
    return np.random.default_rng(0).integers(0, 255, (camera.height, camera.width), dtype=np.uint8)


@pytest.fixture(scope="session")
def pages(good_run: TurntableRun, bad_run: TurntableRun, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    runs = {
        "good": good_run,
        "bad": bad_run,
        "paper": turntable_run(places=20, joint=False),
        "two placements": turntable_run("mixed", placements=2, places=16),
    }
    error = Deviation(0.0123, 0.0456)
    for name, run in runs.items():
        image = some_image(run) if name != "paper" else None
        truth = TruthError(error, error, error, error) if name == "good" else None
        (folder / f"{name}.html").write_text(turntable_page(run, image, truth=truth), encoding="utf-8")
    return {name: folder / f"{name}.html" for name in runs}


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desktop", "phone"])
@pytest.mark.parametrize("name", ["good", "bad", "paper", "two placements"])
def test_page_in_a_browser(browser: Browser, pages: dict[str, Path], name: str, size: tuple[int, int]) -> None:
    page = browser.open(pages[name], width=size[0], height=size[1], dark=name == "good")
    assert_sound(page)
    share, _ = scene_ink(page)
    assert share > 0.01
    page.close()


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["mouse", "finger"])
def test_scene_turns(browser: Browser, pages: dict[str, Path], size: tuple[int, int]) -> None:
    page = browser.open(pages["good"], width=size[0], height=size[1])
    x, y = scene_middle(page)
    before, look = scene_ink(page), page.run("document.getElementById('scene').dataset.view")
    drag = page.drag if size == DESK else page.swipe
    drag((x, y), (x + 90.0, y + 40.0))
    assert page.run("document.getElementById('scene').dataset.view") != look
    assert scene_ink(page)[1] != before[1]
    page.run("document.querySelector('[data-scene=reset]').click()")
    page.run(_TWO_FRAMES)
    assert page.run("document.getElementById('scene').dataset.view") == look
    assert scene_ink(page)[0] == pytest.approx(before[0], rel=0.02)
    assert page.errors == []
    page.close()


def test_slider_moves_the_lidar(browser: Browser, pages: dict[str, Path], good_run: TurntableRun) -> None:
    page = browser.open(pages["good"], width=DESK[0], height=DESK[1])
    _, before = scene_ink(page)
    page.run(_TURN_TABLE)
    page.run(_TWO_FRAMES)
    assert scene_ink(page)[1] != before
    told = page.run("document.getElementById('scene-angle-text').textContent")
    assert good_run.estimate is not None
    sigma = 1e3 * np.sqrt(np.trace(good_run.estimate.uncertain_pose(np.pi).centre_covariance()))
    assert told.startswith("180°")
    assert f"{sigma:.2f} mm" in told
    page.close()


def test_light_and_dark_differ(browser: Browser, pages: dict[str, Path]) -> None:
    colours = []
    for dark in (False, True):
        page = browser.open(pages["good"], width=PHONE[0], height=PHONE[1], dark=dark)
        colours.append(page.run("getComputedStyle(document.body).backgroundColor"))
        page.close()
    assert colours[0] != colours[1]


def test_page_is_small_and_whole(pages: dict[str, Path]) -> None:
    for page in pages.values():
        text = page.read_text(encoding="utf-8")
        assert len(text.encode()) < 5e6
        assert_well_formed(text)
        body = re.sub(r"data:image/jpeg[^\"]*", "", text.split("<body>")[1].split("<script")[0])
        assert not re.search(r"\b(nan|inf)\b", body, re.IGNORECASE)


def test_same_run_same_page(bad_run: TurntableRun) -> None:
    image = some_image(bad_run)[::4, ::4]
    assert turntable_page(bad_run, image) == turntable_page(bad_run, image)


def test_good_page_tells_its_numbers(good_run: TurntableRun) -> None:
    text = turntable_page(good_run, None)
    assert "Good: use this calibration" in text
    assert "What to do" not in text
    assert good_run.estimate is not None
    figures = good_run.estimate.quality.figures
    numbers = turn_numbers(good_run)
    assert numbers is not None
    inside, around = numbers.worst(numbers.centre_mm)
    assert inside == pytest.approx(figures["sigma_inside_arc_mm"], rel=0.02)
    assert around >= figures["sigma_half_a_turn_away_mm"] * 0.999
    for words in ("87 of 87", "within the wish", "Table 1 of the turntable paper", "SHA-256", "scans/000.csv"):
        assert words in text


def test_the_pose_on_the_page_is_that_of_the_calibration(good_run: TurntableRun) -> None:
    """The matrix as it is copied from the page, against the calibration; the quaternion against SciPy."""
    text = turntable_page(good_run, None)
    low, high = arc_deg(good_run)
    pose = good_run.calibration.pose(np.deg2rad(0.5 * (low + high)))
    assert f"T_camera_lidar while the turntable reads {0.5 * (low + high):.2f}" in text
    matrices = [np.loadtxt(block.splitlines()) for block in re.findall(r"<pre>(.*?)</pre>", text, re.DOTALL)]
    np.testing.assert_allclose(matrices[0], pose.matrix, rtol=0.0, atol=6e-7)
    motion = good_run.calibration.motion
    np.testing.assert_allclose(matrices[1], motion.T_camera_turntable.matrix, rtol=0.0, atol=6e-7)
    np.testing.assert_allclose(matrices[2], motion.T_turntable_lidar.matrix, rtol=0.0, atol=6e-7)
    found = re.search(r"quaternion x y z w</td><td><code>(.*?)</code>", text)
    assert found is not None
    R = Rotation.from_quat([float(word) for word in found[1].split()]).as_matrix()
    np.testing.assert_allclose(R, pose.rotation, rtol=0.0, atol=3e-6)


def test_bad_page_says_what_is_wrong_and_what_to_do(bad_run: TurntableRun) -> None:
    text = turntable_page(bad_run, None)
    assert "Rejected: do not use this calibration" in text
    verdict = text[text.index('id="verdict"') : text.index('class="tiles"')]
    assert "What to do" in verdict
    assert "readings in positions.csv are not true" in verdict
    assert "4 of 12 places could not be used" in verdict
    assert "the scan has no straight line where panel 1 should be" in verdict
    assert "do not measure with this calibration.json" in verdict


def test_names_from_files_stay_text(bad_run: TurntableRun) -> None:
    text = turntable_page(bad_run, None)
    assert "<img src=x" not in text
    assert "&lt;img src=x" in text


def test_truth_is_shown_where_it_is_known(good_run: TurntableRun) -> None:
    d = Deviation(0.0123, 0.0456)
    text = turntable_page(good_run, None, truth=TruthError(d, d, d, d))
    assert "Error against the truth" in text
    assert "0.046" in text


def test_point_uncertainty_against_sampling(good_run: TurntableRun) -> None:
    """The standard deviation of a point 3 m away, against poses drawn from the covariance of the ten numbers."""
    numbers = turn_numbers(good_run)
    covariance = good_run.calibration.motion_covariance
    assert numbers is not None
    assert covariance is not None
    motion = good_run.calibration.motion
    k = len(numbers.reading_deg) // 3
    turn = Pose.rot_z(float(np.deg2rad(numbers.reading_deg[k])))
    azimuths = np.deg2rad(np.arange(-180.0, 180.0, 15.0))
    points = 3.0 * np.column_stack([np.cos(azimuths), np.sin(azimuths), np.zeros(24)])
    moved = []
    for step in np.random.default_rng(1).multivariate_normal(np.zeros(10), covariance, 1500):
        rotation = Pose.exp([0.0, 0.0, 0.0, *step[7:]]).rotation @ motion.T_turntable_lidar.rotation
        mounting = Pose(rotation, motion.T_turntable_lidar.translation + [step[6], 0.0, 0.0])
        moved.append(Pose.exp(step[:6]) @ motion.T_camera_turntable @ turn @ (mounting @ points))
    spread = 1e3 * np.sqrt(np.var(np.stack(moved), axis=0).sum(axis=1))
    assert numbers.point_mm[3.0][k] == pytest.approx(spread.max(), rel=0.06)


def test_the_scene_turns_by_where_the_table_stands(good_run: TurntableRun) -> None:
    """Of readings that are off by a factor the slider shows readings; the arc is where the LiDAR's centre was."""
    motion = replace(good_run.calibration.motion, reading_scale=1.5, reading_origin_rad=0.2)
    run = replace(good_run, calibration=replace(good_run.calibration, motion=motion))
    scene = turntable_scene(run)
    assert scene["motion"]["scale"] == 1.5
    assert scene["motion"]["origin"] == pytest.approx(np.degrees(0.2))
    ends = [motion.pose(run.session.places[k].turntable_angle_rad).translation for k in (0, -1)]
    arc = next(item for item in scene["items"] if item.get("width") == 4)
    for end in ends:
        assert np.abs(np.asarray(arc["points"]) - end).max(axis=1).min() < 1e-3


def test_report_without_covariance(good_run: TurntableRun) -> None:
    """The paper's method knows no covariance; the page says so instead of inventing one."""
    calibration = replace(good_run.calibration, parameter_covariance=None, quality=None)
    text = turntable_page(replace(good_run, method="paper", estimate=None, calibration=calibration), None)
    assert "No verdict" in text
    assert "This method gives no standard deviations" in text


class _MissingScan:
    name = "scans/000.csv"

    def load(self) -> Scan:
        raise InputError(self.name, "is missing")


def _with_estimate(run: TurntableRun, **changes: Any) -> TurntableRun:
    assert run.estimate is not None
    return replace(run, estimate=replace(run.estimate, **changes))


def _each_residual(run: TurntableRun, change: Callable[[ResidualGroup], ResidualGroup]) -> TurntableRun:
    assert run.estimate is not None
    return _with_estimate(run, residuals=tuple(change(group) for group in run.estimate.residuals))


def _one_panel(run: TurntableRun) -> TurntableRun:
    def only(found: Mapping[int, Any]) -> dict[int, Any]:
        return {k: v for k, v in found.items() if k == 0}

    places = tuple(replace(p, stripes=only(p.stripes), scan_lines=only(p.scan_lines)) for p in run.observations.places)
    assert run.estimate is not None
    residuals = tuple(g for g in run.estimate.residuals if g.panel == 0)
    poses = {name: (found[0], None) for name, found in run.estimate.panel_poses.items()}
    changed = _with_estimate(run, residuals=residuals, panel_poses=poses)
    return replace(changed, observations=replace(run.observations, places=places))


def _lost_scans(run: TurntableRun) -> TurntableRun:
    places = tuple(replace(p, scan=_MissingScan()) for p in run.session.places)
    return replace(run, session=replace(run.session, places=places))


ODD_RUNS: dict[str, Callable[[TurntableRun], TurntableRun]] = {
    "no residuals": lambda run: _with_estimate(run, residuals=()),
    "no directions, no extras": lambda run: _with_estimate(run, directions=(), extras=()),
    "nothing has weight": lambda run: _each_residual(run, lambda g: replace(g, weights=0.0 * g.weights)),
    "residuals are exactly zero": lambda run: _each_residual(run, lambda g: replace(g, values=0.0 * g.values)),
    "residuals are not finite": lambda run: _each_residual(run, lambda g: replace(g, values=np.nan * g.values)),
    "no places": lambda run: replace(run, observations=replace(run.observations, places=()), samples={}),
    "one panel": _one_panel,
    "the scans are gone": _lost_scans,
    "covariance is zero": lambda run: _with_estimate(run, parameter_covariance=np.zeros((22, 22))),
    "covariance is huge": lambda run: _with_estimate(run, parameter_covariance=1e9 * np.eye(22)),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("odd", ODD_RUNS)
def test_odd_runs_have_a_page(bad_run: TurntableRun, odd: str) -> None:
    """A report never fails a calibration, whatever is missing from it."""
    text = turntable_page(ODD_RUNS[odd](bad_run), None)
    assert_well_formed(text)
    assert not re.search(r"\b(nan|inf)\b", text.split("<body>")[1].split("<script")[0], re.IGNORECASE)


def assert_well_formed(text: str) -> None:
    """Every element is closed where it has to be."""

    class Checker(HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.open: list[str] = []

        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            if tag not in ("meta", "link", "br", "input", "img"):
                self.open.append(tag)

        def handle_endtag(self, tag: str) -> None:
            assert self.open.pop() == tag

    checker = Checker()
    checker.feed(text)
    assert checker.open == []
