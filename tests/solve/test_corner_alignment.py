"""The corner paper's closed forms: exact on exact corners, from no turn to half a turn, and never mirrored."""

import numpy as np
import pytest

from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.solve.corner_alignment import (
    cayley_pose,
    cayley_rotation,
    pair_scale,
    svd_pose,
)

CORNERS = np.random.default_rng(5).uniform(-2.0, 2.0, (6, 3))


def test_cayleys_form_is_a_rotation_and_agrees_with_the_exponential() -> None:
    a, b, c = 0.3, -0.2, 0.5
    R = cayley_rotation(a, b, c)
    # S is the cross product matrix of (a, -b, c); Cayley's form turns by twice the arc tangent of its length.
    axis = np.array([a, -b, c])
    angle = 2.0 * np.arctan(np.linalg.norm(axis))
    np.testing.assert_allclose(R, exp_so3(angle * axis / np.linalg.norm(axis)), atol=1e-12)


@pytest.mark.parametrize("turn", [0.0, 1.0, 3.0, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 0, 0), (0.6, 0.0, 0.8), (0.48, 0.6, 0.64)])
def test_exact_corners_give_the_exact_pose_up_to_half_a_turn(turn: float, axis: tuple[float, float, float]) -> None:
    T = Pose(exp_so3(turn * np.array(axis)), np.array([0.3, -1.0, 1.5]))
    for estimate in (cayley_pose(T @ CORNERS, CORNERS), svd_pose(T @ CORNERS, CORNERS)):
        metres, radians = estimate.distance(T)
        assert metres < 1e-9
        assert radians < 1e-9


def test_noise_near_half_a_turn_costs_cayley_no_accuracy() -> None:
    rng = np.random.default_rng(2)
    errors: dict[float, list[float]] = {0.3: [], np.pi: []}
    for turn, found in errors.items():
        T = Pose(exp_so3([0.0, 0.0, turn]), np.zeros(3))
        for _ in range(100):
            noisy = CORNERS + rng.normal(0.0, 0.003, CORNERS.shape)
            found.append(cayley_pose(T @ CORNERS, noisy, iterations=3).distance(T)[1])
    assert np.mean(errors[np.pi]) == pytest.approx(np.mean(errors[0.3]), rel=0.25)


def test_places_in_one_plane_are_not_mirrored() -> None:
    flat = CORNERS * [1.0, 1.0, 0.0]
    T = Pose(exp_so3([0.1, 0.2, 2.0]), np.array([1.0, 2.0, 3.0]))
    noisy = flat + np.random.default_rng(1).normal(0.0, 1e-3, flat.shape)
    estimate = svd_pose(T @ flat, noisy)
    assert estimate.distance(T)[1] < 0.01


def test_millimetres_for_metres_show_in_the_scale() -> None:
    T = Pose(exp_so3([0.1, 0.2, 2.0]), np.array([1.0, 2.0, 3.0]))
    assert pair_scale(1000.0 * (T @ CORNERS), CORNERS) == pytest.approx(1000.0)
