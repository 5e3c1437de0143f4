"""Poses against scipy's matrix exponential, numerical derivatives and the group's axioms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from lidarpose.geometry.se3 import Pose, UncertainPose, exp_so3, log_so3, nearest_rotation, skew

components = st.floats(-3.0, 3.0)
twists = st.lists(components, min_size=6, max_size=6).map(np.array).filter(lambda xi: np.linalg.norm(xi[3:]) < 3.1)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.00999, 0.01001, 1.0, 3.0, np.pi - 1e-9])
def test_exp_agrees_with_the_matrix_exponential(angle: float) -> None:
    rng = np.random.default_rng(3)
    w = rng.normal(size=3)
    w *= angle / np.linalg.norm(w)
    v = rng.normal(size=3)
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(w), v
    pose = Pose.exp(np.r_[v, w])
    np.testing.assert_allclose(pose.matrix, expm(generator), atol=1e-14)
    np.testing.assert_allclose(pose.log(), np.r_[v, w], atol=1e-13)


def test_log_at_half_a_turn_has_the_right_axis_up_to_sign() -> None:
    axis = np.array([0.6, 0.0, 0.8])
    w = log_so3(Rotation.from_rotvec(np.pi * axis).as_matrix())
    assert np.linalg.norm(w) == pytest.approx(np.pi, abs=1e-12)
    assert abs(w @ axis) == pytest.approx(np.pi, abs=1e-12)


@given(twists, twists, twists)
def test_group_axioms(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    A, B, C = Pose.exp(a), Pose.exp(b), Pose.exp(c)
    np.testing.assert_allclose(((A @ B) @ C).matrix, (A @ (B @ C)).matrix, atol=1e-10)
    np.testing.assert_allclose((A @ A.inverse()).matrix, np.eye(4), atol=1e-12)
    np.testing.assert_allclose((A @ B).matrix, A.matrix @ B.matrix, atol=1e-12)


@given(twists, twists)
def test_adjoint_moves_a_perturbation_from_right_to_left(a: np.ndarray, xi: np.ndarray) -> None:
    T = Pose.exp(a)
    small = 0.1 * xi
    np.testing.assert_allclose((T @ Pose.exp(small)).matrix, (Pose.exp(T.adjoint() @ small) @ T).matrix, atol=1e-9)


@given(twists)
def test_quaternions_round_trip_and_agree_with_scipy(xi: np.ndarray) -> None:
    T = Pose.exp(xi)
    again = Pose.from_quaternion_xyzw(T.quaternion_xyzw, T.translation)
    np.testing.assert_allclose(again.matrix, T.matrix, atol=1e-12)
    theirs = Rotation.from_matrix(T.rotation).as_quat()
    assert abs(theirs @ T.quaternion_xyzw) == pytest.approx(1.0, abs=1e-12)


def test_batches_equal_single_calls() -> None:
    w = np.random.default_rng(0).normal(size=(4, 5, 3))
    batch = exp_so3(w)
    np.testing.assert_allclose(batch[2, 3], exp_so3(w[2, 3]), atol=1e-15)
    np.testing.assert_allclose(log_so3(batch)[2, 3], w[2, 3], atol=1e-12)


def test_nearest_rotation_of_a_reflection_is_proper() -> None:
    R = nearest_rotation(np.diag([1.0, 1.0, -0.9]))
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_an_improper_rotation_is_refused() -> None:
    with pytest.raises(ValueError, match="not a proper rotation"):
        Pose(np.diag([1.0, 1.0, -1.0]), np.zeros(3))


def test_covariances_of_composition_inverse_and_centre_agree_with_sampling() -> None:
    rng = np.random.default_rng(11)
    A, B = Pose.exp(rng.normal(size=6)), Pose.exp(rng.normal(size=6))
    roots = [1e-4 * rng.normal(size=(6, 6)) for _ in range(2)]
    uncertain = [UncertainPose(T, L @ L.T) for T, L in zip((A, B), roots, strict=True)]
    composed, inverse = uncertain[0] @ uncertain[1], uncertain[0].inverse()
    draws_ab, draws_inverse, draws_centre = [], [], []
    for _ in range(6000):
        a = Pose.exp(roots[0] @ rng.normal(size=6)) @ A
        b = Pose.exp(roots[1] @ rng.normal(size=6)) @ B
        draws_ab.append((a @ b).minus(A @ B))
        draws_inverse.append(a.inverse().minus(A.inverse()))
        draws_centre.append(a.translation)
    for draws, predicted in (
        (draws_ab, composed.covariance),
        (draws_inverse, inverse.covariance),
        (draws_centre, uncertain[0].centre_covariance()),
    ):
        sampled = np.cov(np.array(draws).T)
        scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
        np.testing.assert_allclose(sampled / scale, predicted / scale, atol=0.07)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_turn_or_twist_that_is_not_finite_is_no_pose(bad: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        Pose.rot_z(bad)
    with pytest.raises(ValueError, match="finite"):
        Pose.exp([0.0, 0.0, 0.0, 0.0, bad, 0.0])
