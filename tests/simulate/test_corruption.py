"""Mistakes change what they say and nothing else."""

import numpy as np
import pytest

from lidarpose.model.session import TurntableSession
from lidarpose.simulate.corruption import MISTAKES, Mistake, corrupt
from lidarpose.simulate.rig import draw_rig, paper_camera
from lidarpose.simulate.session import SimulatedSession, simulate_session


@pytest.fixture(scope="module")
def simulated() -> SimulatedSession:
    return simulate_session(draw_rig(1, places=3, camera=paper_camera(203, 154)))


@pytest.fixture(scope="module")
def recorded(simulated: SimulatedSession) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return images(simulated.session), scans(simulated.session)


def images(session: TurntableSession) -> list[np.ndarray]:
    board = [shot.load() for shots in session.board_images.values() for shot in shots]
    return board + [p.stripe_image.load() for p in session.places if p.stripe_image is not None]


def scans(session: TurntableSession) -> list[np.ndarray]:
    return [p.scan.load().range_m for p in session.places]


CHANGES_IMAGES = {
    "turntable-stands-still",
    "two-places",
    "board-moved-between-shots",
    "board-moved-halfway",
    "board-moved-before-the-stripes",
    "images-one-place-late",
    "no-stripe",
    "stripe-on-one-panel",
    "dark-board-images",
    "overexposed-board-images",
}
CHANGES_SCANS = {
    "millimetre-scans",
    "empty-scans",
    "reversed-scan",
    "turntable-stands-still",
    "two-places",
    "board-moved-halfway",
    "board-moved-before-the-stripes",
    "images-one-place-late",
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_changes_what_it_says(
    simulated: SimulatedSession, recorded: tuple[list[np.ndarray], list[np.ndarray]], mistake: Mistake
) -> None:
    before, after = simulated.session, corrupt(simulated, mistake)
    same_images, same_scans = (
        len(a) == len(b) and all(np.array_equal(x, y, equal_nan=True) for x, y in zip(a, b, strict=True))
        for a, b in zip(recorded, (images(after), scans(after)), strict=True)
    )
    assert same_images == (mistake not in CHANGES_IMAGES)
    assert same_scans == (mistake not in CHANGES_SCANS)
    if same_images and same_scans and mistake != "swapped-panels":
        angles = [[p.turntable_angle_rad for p in s.places] for s in (before, after)]
        assert angles[0] != angles[1] or before.panels != after.panels or before.camera is not after.camera


def test_panels_of_one_plane_can_be_asked_for() -> None:
    first, second = draw_rig(0, places=3, dihedral_deg=180.0).T_camera_panel[""]
    assert first.rotation[:, 2] @ second.rotation[:, 2] == pytest.approx(1.0)


def test_the_second_panel_stays_dark() -> None:
    simulated = simulate_session(draw_rig(1, places=3, camera=paper_camera(406, 308)))
    session = corrupt(simulated, "stripe-on-one-panel")
    rig = simulated.rig
    image = session.places[1].stripe_image
    assert image is not None
    levels = image.load()
    brightest = []
    for k in (0, 1):
        ends = rig.chord(1, k)
        assert ends is not None
        share = np.linspace(0.1, 0.9, 60)[:, None]
        line = rig.T_camera_panel[""][k] @ ((1 - share) * ends[0] + share * ends[1])
        u, v = np.round(rig.camera.project(line)).astype(int).T
        brightest.append(levels[v, u].max())
    assert brightest[0] > 60 > 30 > brightest[1]
