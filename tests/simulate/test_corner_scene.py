"""The corner simulator against geometry done by hand."""

import numpy as np
import pytest

from lidarpose.geometry.se3 import Pose
from lidarpose.simulate.corner_scene import PAPER_POSES, CornerSceneSpec, simulate_corner_session, upright_box
from lidarpose.simulate.multibeam import Defects, hdl32, turned_2d, vlp16


def test_rays_meet_a_box_where_they_should() -> None:
    box = upright_box([3.0, 0.0, 0.0], [2.0, 2.0, 2.0], 0.0)
    diagonal = np.array([1.0, 0.4, 0.0]) / np.hypot(1.0, 0.4)
    directions = np.array([[1.0, 0.0, 0.0], diagonal, [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    ranges = box.cast(np.zeros(3), directions)
    np.testing.assert_allclose(ranges, [2.0, 2.0 * np.hypot(1.0, 0.4), np.inf, np.inf])


def test_instruments_have_their_makers_beams() -> None:
    for table, lines, lowest in ((hdl32(), 32, -30.67), (vlp16(), 16, -15.0)):
        elevation = np.degrees(np.arcsin(table.directions[:, 2])).round(3)
        assert len(np.unique(elevation)) == lines
        assert elevation.min() == pytest.approx(lowest, abs=1e-3)
    np.testing.assert_allclose(np.linalg.norm(turned_2d().directions, axis=1), 1.0)


@pytest.mark.parametrize("pose", sorted(PAPER_POSES))
def test_without_noise_every_face_lies_in_its_true_plane(pose: str) -> None:
    spec = CornerSceneSpec(pose=pose, frames=1, defects=Defects(0.0, 0.0, False))
    session, truth = simulate_corner_session(spec)
    for place, corner in zip(session.places, truth.corners_lidar, strict=True):
        np.testing.assert_allclose(truth.T_world_lidar @ corner, place.corner_world, atol=1e-12)
        points = place.clouds[0].load().points.astype(np.float64)
        near = points[np.linalg.norm(points - corner, axis=1) < 0.3]
        height = (near - corner) @ truth.face_normals_lidar.T
        # Of a convex target nothing stands out, and each point is on one of the three faces.
        assert height.max() < 1e-5
        assert np.sum(np.abs(height) < 1e-5, axis=0).min() >= 10
        assert np.abs(height).min(axis=1).max() < 1e-5


def test_equal_seeds_give_equal_sessions_and_noise_is_as_asked() -> None:
    spec = CornerSceneSpec(places=1, frames=1, seed=4, defects=Defects(0.008, 0.0, False))
    (a, _), (b, _) = simulate_corner_session(spec), simulate_corner_session(spec)
    clean, _ = simulate_corner_session(CornerSceneSpec(places=1, frames=1, seed=4, defects=Defects(0.0, 0.0, False)))
    first, again, exact = (s.places[0].clouds[0].load().points for s in (a, b, clean))
    np.testing.assert_array_equal(first, again)
    error = np.linalg.norm(first, axis=1) - np.linalg.norm(exact, axis=1)
    assert error.std() == pytest.approx(0.008, rel=0.02)
    assert error.mean() == pytest.approx(0.0, abs=2e-4)


def test_a_pose_of_ones_own() -> None:
    pose = Pose(np.eye(3), np.array([4.0, 5.0, 1.2]))
    session, truth = simulate_corner_session(CornerSceneSpec(pose=pose, frames=1, places=3))
    np.testing.assert_allclose(truth.T_world_lidar.matrix, pose.matrix, atol=1e-12)
    assert len(session.places) == 3
    with pytest.raises(ValueError, match="no pose"):
        simulate_corner_session(CornerSceneSpec(pose="7"))
