"""The world job's covariance against the truth, where it is hardest: three boards 2 cm above the ground."""

import numpy as np
import pytest
from scipy.stats import binom, chi2

from lidarpose.errors import InputError
from lidarpose.geometry.se3 import Pose
from lidarpose.model.corner_session import CornerSession
from lidarpose.simulate.corner_scene import CornerSceneSpec, CornerTruth, paper_rotation, simulate_corner_session
from lidarpose.simulate.multibeam import INSTRUMENTS
from lidarpose.workflows.world import calibrate_world

SCENES = 24
# Chance passes each limit once in a hundred times.
CHANCE = 1e-2


def scene(seed: int) -> tuple[CornerSession, CornerTruth]:
    """A concave target among clutter, by any instrument. Raises InputError where that sees it whole from nowhere."""
    rng = np.random.default_rng([23, seed])
    turn = paper_rotation(rng.uniform(-180.0, 180.0), rng.uniform(-12.0, 28.0), rng.uniform(-10.0, 10.0))
    return simulate_corner_session(
        CornerSceneSpec(
            pose=Pose(turn, np.array([rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0), 1.5])),
            target="concave",
            ground_m=0.0,
            lidar=str(rng.choice(list(INSTRUMENTS))),
            places=int(rng.integers(3, 10)),
            frames=int(rng.choice([1, 1, 5, 10])),
            seed=seed,
            size_m=float(rng.uniform(0.3, 0.9)),
            room=bool(rng.random() < 0.5),
            clutter=int(rng.integers(0, 8)),
        )
    )


@pytest.mark.slow
def test_stated_covariances_hold_for_targets_that_lie_on_the_ground() -> None:
    distances: list[float] = []
    seed = 0
    while len(distances) < SCENES:
        seed += 1
        try:
            session, truth = scene(seed)
        except InputError:
            continue
        found = calibrate_world(session)
        assert found.covariance is not None
        xi = found.T_world_source.minus(truth.T_world_lidar)
        distances.append(float(xi @ np.linalg.solve(found.covariance, xi)))
    # Squared distances by an honest covariance are chi-squares of six degrees of freedom.
    assert chi2.ppf(CHANCE, 6 * SCENES) < np.sum(distances) < chi2.ppf(1.0 - CHANCE, 6 * SCENES)
    assert np.count_nonzero(np.array(distances) > chi2.ppf(0.95, 6)) <= binom.ppf(1.0 - CHANCE, SCENES, 0.05)
