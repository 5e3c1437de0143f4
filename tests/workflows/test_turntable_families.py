"""Every family of simulated rigs calibrates from its images and scans: near the truth, and within what it states."""

import numpy as np
import pytest

from lidarpose.model.rig_family import FAMILIES, Family
from lidarpose.model.turntable import TurntableMotion
from lidarpose.simulate.rig import TurntableRig, draw_rig
from lidarpose.simulate.session import simulate_session
from lidarpose.workflows.turntable import calibrate_turntable


def errors_inside_the_arc(rig: TurntableRig, motion: TurntableMotion) -> tuple[float, float]:
    """Mean error of the LiDAR's centre in mm, and of its orientation in degrees, over the places."""
    pairs = [motion.pose(a).distance(rig.motion.pose(a)) for a in rig.turntable_angle_rad]
    metres, radians = np.mean(pairs, axis=0)
    return 1e3 * float(metres), float(np.rad2deg(radians))


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_calibrates(family: Family) -> None:
    rig = draw_rig(3, family=family, places=None if family == "few-places" else 10)
    run = calibrate_turntable(simulate_session(rig).session)
    for motion in (run.calibration.motion, run.paper_motion):
        millimetres, degrees = errors_inside_the_arc(rig, motion)
        assert millimetres < 1.0
        assert degrees < 0.1
    assert run.calibration.quality is not None
    assert run.calibration.quality.verdict == "good"
    middle = float(rig.turntable_angle_rad[len(rig) // 2])
    stated = run.calibration.uncertain_pose(middle)
    assert stated is not None
    off = rig.motion.pose(middle).minus(stated.pose)
    # Chi-squared with 6 degrees of freedom: 0.99999 of all honest answers lie below 33.
    assert off @ np.linalg.solve(stated.covariance, off) < 33.0


@pytest.mark.slow
def test_the_papers_set_up_keeps_the_papers_figures() -> None:
    rig = draw_rig(0)
    session = simulate_session(rig).session
    run = calibrate_turntable(session, method="paper")
    millimetres, degrees = errors_inside_the_arc(rig, run.paper_motion)
    assert millimetres < 1.0
    assert degrees < 0.1
    assert run.deviation is not None
    assert run.deviation.centre_mm.mean <= 1.12
    assert run.deviation.z_deg.mean <= 0.203
    assert run.deviation.x_deg.mean <= 0.662
