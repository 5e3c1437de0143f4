"""Sessions in which nothing fits: the message names the mistake, not only that there is one."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from lidarpose.errors import AmbiguousError, UndeterminedError
from lidarpose.model.calibration import Quality
from lidarpose.model.scan import Scan
from lidarpose.model.session import ScanSource
from lidarpose.simulate.corruption import Mistake, corrupt
from lidarpose.simulate.rig import draw_rig
from lidarpose.simulate.session import SimulatedSession, simulate_session
from lidarpose.workflows.named_causes import stands_still, with_cause_named
from lidarpose.workflows.reversed_scans import Solved
from lidarpose.workflows.turntable import _doubt_order, calibrate_turntable, detect_features


@pytest.fixture(scope="module")
def simulated() -> SimulatedSession:
    return simulate_session(draw_rig(5, family="mixed", places=7))


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        ("millimetre-scans", "ranges are in millimetres"),
        ("turntable-stands-still", "did not turn"),
        ("turntable-steps-twice-as-far", "half of what they should be"),
        ("empty-scans", "no beam of its scan has a return"),
    ],
)
def test_the_mistake_is_named(simulated: SimulatedSession, mistake: Mistake, words: str) -> None:
    with pytest.raises(UndeterminedError, match=words):
        calibrate_turntable(corrupt(simulated, mistake))


def test_a_stripe_that_stays_on_a_table_that_turns_is_no_table_that_stands_still(simulated: SimulatedSession) -> None:
    first = detect_features(simulated.session).places[0]
    turned = 0.1
    lines = tuple(replace(line, angle_rad=line.angle_rad - turned) for line in first.lines)
    later = replace(first, turntable_angle_rad=first.turntable_angle_rad + turned)
    assert stands_still([first, later])
    assert not stands_still([first, replace(later, lines=lines)])


@dataclass(frozen=True)
class TakenForDegrees:
    """A scan whose beam angles are radians in a file that is to hold degrees."""

    source: ScanSource

    @property
    def name(self) -> str:
        return self.source.name

    def load(self) -> Scan:
        scan = self.source.load()
        return replace(scan, angle_rad=np.radians(scan.angle_rad))


def test_beam_angles_in_radians_are_named(simulated: SimulatedSession) -> None:
    session = simulated.session
    places = tuple(replace(place, scan=TakenForDegrees(place.scan)) for place in session.places)
    with pytest.raises(UndeterminedError, match="look like radians"):
        calibrate_turntable(replace(session, places=places))


def nothing_solves(_: object) -> Solved:
    raise UndeterminedError("no motion", remedy="")


@pytest.mark.parametrize(
    ("misfit_sigmas", "mended", "named"), [(0.9, 0.2, False), (50.0, 40.0, False), (50.0, 1.0, True)]
)
def test_a_factor_is_named_only_where_the_ambiguous_solutions_fit_far_worse(
    simulated: SimulatedSession, misfit_sigmas: float, mended: float, named: bool
) -> None:
    places = detect_features(simulated.session).places
    error = AmbiguousError("two mirrored solutions", remedy="--first-panel", misfit_sigmas=misfit_sigmas)
    found = with_cause_named(error, simulated.session, places, (), lambda tried: (len(tried), mended), nothing_solves)
    assert ("millimetres" in found.what) == named
    assert (found is error) != named


def test_an_order_stated_against_the_evidence_is_doubted() -> None:
    quality = Quality("good", ("sound",))
    doubted = _doubt_order(quality, "the motion of all places")
    assert doubted is not None
    assert doubted.verdict == "doubtful"
    assert "taken at its word" in doubted.reasons[-1]
