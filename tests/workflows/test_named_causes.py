"""Sessions in which nothing fits: the message names the mistake, not only that there is one."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from lidarpose.errors import UndeterminedError
from lidarpose.model.scan import Scan
from lidarpose.model.session import ScanSource
from lidarpose.simulate.corruption import Mistake, corrupt
from lidarpose.simulate.rig import draw_rig
from lidarpose.simulate.session import SimulatedSession, simulate_session
from lidarpose.workflows.turntable import calibrate_turntable


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
