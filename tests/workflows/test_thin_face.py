"""Boxes before a 16-line LiDAR whose top one scan line or two cross at each place."""

import numpy as np
import pytest

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.se3 import Pose
from lidarpose.simulate.corner_scene import CornerSceneSpec, paper_rotation, simulate_corner_session
from lidarpose.workflows.thin_face import with_thin_face
from lidarpose.workflows.world import calibrate_world, locate_target


@pytest.mark.parametrize(("seed", "by_edges"), [(9, False), (10, True)])
def test_a_face_of_single_lines_is_found_by_all_places_together(seed: int, by_edges: bool) -> None:
    pose = Pose(paper_rotation(20.0, 20.0, 0.0), np.array([0.0, 0.0, 1.3]))
    spec = CornerSceneSpec(pose=pose, target="cube", lidar="vlp16", places=4, frames=1, seed=seed, size_m=0.42)
    session, truth = simulate_corner_session(spec)
    located = locate_target(session)
    assert located.found.by_edges == by_edges
    mended = with_thin_face(located.found, located.crops)
    assert mended is not None
    for sighting, corner in zip(mended.sightings, truth.corners_lidar, strict=True):
        assert sighting is not None
        assert np.linalg.norm(sighting.corner - corner) < 0.02
    result = calibrate_world(session, located=located)
    xi = result.T_world_source.minus(truth.T_world_lidar)
    assert np.linalg.norm(xi[:3]) < 0.005
    assert result.covariance is not None
    assert xi @ np.linalg.solve(result.covariance, xi) < 22.5  # 99.9 % of chi-square with six degrees
    if by_edges:
        with pytest.raises(UndeterminedError, match="two faces"):
            calibrate_world(session, "paper", located=located)
