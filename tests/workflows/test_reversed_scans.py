"""Scans written in reverse, one or many, are found and named by the whole job."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lidarpose.errors import UndeterminedError
from lidarpose.model.scan import Scan
from lidarpose.model.session import TurntableSession
from lidarpose.simulate.corruption import MappedScan
from lidarpose.simulate.rig import draw_rig
from lidarpose.simulate.session import SimulatedSession, simulate_session
from lidarpose.workflows.turntable import calibrate_turntable

PLACES = 8


@pytest.fixture(scope="module")
def simulated() -> SimulatedSession:
    return simulate_session(draw_rig(1, places=PLACES))


def reverse_ranges(scan: Scan) -> Scan:
    intensity = None if scan.intensity is None else scan.intensity[::-1]
    return Scan(scan.angle_rad, scan.range_m[::-1], intensity, scan.sweep)


def negate_angles(scan: Scan) -> Scan:
    intensity = None if scan.intensity is None else scan.intensity[::-1]
    return Scan(-scan.angle_rad[::-1], scan.range_m[::-1], intensity, scan.sweep)


def spoiled(session: TurntableSession, which: list[int], change: Callable[[Scan], Scan]) -> TurntableSession:
    places = list(session.places)
    for k in which:
        places[k] = replace(places[k], scan=MappedScan(places[k].scan, change))
    return replace(session, places=tuple(places))


@pytest.mark.parametrize("change", [reverse_ranges, negate_angles])
def test_one_reversed_scan_is_named_and_spoils_the_verdict(
    simulated: SimulatedSession, change: Callable[[Scan], Scan]
) -> None:
    run = calibrate_turntable(spoiled(simulated.session, [5], change))
    quality = run.calibration.quality
    assert quality is not None
    assert quality.verdict == "doubtful"
    assert any("the scan of position 005 runs the other way round" in reason for reason in quality.reasons)
    # The rest of the session is right without it.
    metres, radians = run.calibration.pose(0.1).distance(simulated.rig.motion.pose(0.1))
    assert metres < 2e-3
    assert radians < np.deg2rad(0.1)


@pytest.mark.parametrize("which", [[4, 5, 6, 7], [1, 3, 5, 7]], ids=["second half", "to and fro"])
def test_half_of_the_scans_reversed_are_named(simulated: SimulatedSession, which: list[int]) -> None:
    try:
        run = calibrate_turntable(spoiled(simulated.session, which, reverse_ranges))
    except UndeterminedError as error:
        said = str(error)
    else:
        assert run.calibration.quality is not None
        assert run.calibration.quality.verdict == "rejected"
        said = "; ".join(run.calibration.quality.reasons)
    assert "the other way round" in said
    assert ", ".join(f"{k:03d}" for k in which) in said
