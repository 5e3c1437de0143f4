"""The literature's methods as implemented here: exact on exact observations, and no better than the bound."""

import numpy as np
import pytest
from benchmarks.peers.plane_views import Constraints, PlaneView, views_by_reading
from benchmarks.peers.rigid_methods import dong_isler, guo_roumeliotis, zhang_pless, zhang_pless_linear
from benchmarks.peers.turning_methods import circle_of_poses, points_on_planes

from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.simulate.observations import simulate_observations
from lidarpose.simulate.rig import TurntableRig, draw_rig


@pytest.fixture(scope="module")
def rig() -> TurntableRig:
    return draw_rig(1, places=4, placements=4)


@pytest.fixture(scope="module")
def views(rig: TurntableRig) -> dict[float, list[PlaneView]]:
    exact = simulate_observations(rig, corner_sigma_px=0.0, stripe_sigma_px=0.0, range_sigma_m=0.0, with_stripe=False)
    return views_by_reading(exact)


@pytest.mark.parametrize("method", [zhang_pless_linear, zhang_pless, guo_roumeliotis])
def test_a_rigid_method_is_exact_without_noise(
    method: object, rig: TurntableRig, views: dict[float, list[PlaneView]]
) -> None:
    assert callable(method)
    for reading, boards in views.items():
        metres, radians = method(boards).distance(rig.motion.pose(reading))
        assert metres < 1e-5
        assert radians < 1e-5


def test_edges_move_the_answer_by_less_than_a_beam_apart(
    rig: TurntableRig, views: dict[float, list[PlaneView]]
) -> None:
    for reading, boards in views.items():
        start = guo_roumeliotis(boards)
        assert start is not None
        pose = dong_isler(boards, start, rig.panels, rig.margin_m, 0.004)
        assert pose.distance(rig.motion.pose(reading))[0] < 2e-3


def test_the_motion_is_exact_without_noise(rig: TurntableRig, views: dict[float, list[PlaneView]]) -> None:
    poses = [rig.motion.pose(reading) for reading in views]
    circle = circle_of_poses(list(views), poses)
    off = Pose.exp([0.004, -0.003, 0.002, 0.003, -0.004, 0.002])
    start = circle_of_poses(list(views), [off @ pose for pose in poses])
    for motion in (circle, points_on_planes(views, start)):
        for reading in (0.0, 1.0, 4.0):
            metres, radians = motion.pose(reading).distance(rig.motion.pose(reading))
            assert metres < 1e-5
            assert radians < 1e-5


def test_the_constraints_derivative(rig: TurntableRig, views: dict[float, list[PlaneView]]) -> None:
    constraints = Constraints.of(next(iter(views.values())))
    pose = rig.motion.pose(0.1)
    J = constraints.jacobian(pose.rotation, pose.translation)
    h = 1e-6
    for k in range(6):
        step = np.zeros(6)
        step[k] = h
        ends = [
            constraints.residuals(exp_so3(s * step[3:]) @ pose.rotation, pose.translation + s * step[:3])
            for s in (1.0, -1.0)
        ]
        np.testing.assert_allclose(J[:, k], (ends[0] - ends[1]) / (2.0 * h), atol=1e-6)


def test_too_few_boards_are_refused(views: dict[float, list[PlaneView]]) -> None:
    boards = next(iter(views.values()))
    assert zhang_pless_linear(boards[:4]) is None
    assert guo_roumeliotis(boards[:2]) is None
