"""The turntable motion: its frame, its function and its Jacobian."""

import numpy as np

from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.turntable import TurntableMotion


def random_motion(seed: int) -> TurntableMotion:
    rng = np.random.default_rng(seed)
    return TurntableMotion.from_any_frame(Pose.exp(rng.normal(size=6)), Pose.exp(rng.normal(size=6)))


def test_the_choice_of_frame_does_not_change_the_motion() -> None:
    rng = np.random.default_rng(0)
    T_camera_table, T_table_lidar = Pose.exp(rng.normal(size=6)), Pose.exp(rng.normal(size=6))
    motion = TurntableMotion.from_any_frame(T_camera_table, T_table_lidar)
    for angle in (-3.0, 0.0, 0.4, 9.0):
        expected = T_camera_table @ Pose.rot_z(angle) @ T_table_lidar
        np.testing.assert_allclose(motion.pose(angle).matrix, expected.matrix, atol=1e-12)
    assert motion.T_turntable_lidar.translation[1] == 0.0
    assert motion.T_turntable_lidar.translation[2] == 0.0


def test_a_lidar_on_the_axis_has_a_frame_too() -> None:
    motion = TurntableMotion.from_any_frame(Pose.identity(), Pose(exp_so3([0.1, 1.0, 0.3]), np.array([0, 0, 0.5])))
    assert motion.radius_m == 0.0
    assert np.linalg.det(motion.pose(1.0).rotation) > 0.999


def test_pose_jacobian_agrees_with_differences() -> None:
    motion = random_motion(1)
    h = 1e-6
    for angle in (0.0, 0.7, 3.0):
        numeric = np.zeros((6, 10))
        for k in range(10):
            d = np.zeros(10)
            d[k] = h
            t = motion.T_turntable_lidar
            moved = TurntableMotion(
                Pose.exp(d[:6]) @ motion.T_camera_turntable,
                Pose(exp_so3(d[7:]) @ t.rotation, t.translation + [d[6], 0.0, 0.0]),
            )
            numeric[:, k] = moved.pose(angle).minus(motion.pose(angle)) / h
        np.testing.assert_allclose(motion.pose_jacobian(angle), numeric, atol=1e-5)


def test_many_readings_at_once_are_those_of_each() -> None:
    motion, angles = random_motion(3), np.array([-2.0, 0.0, 0.4, 5.0])
    np.testing.assert_allclose(motion.centres(angles), [motion.pose(a).translation for a in angles], atol=1e-15)
    np.testing.assert_allclose(motion.pose_jacobians(angles), [motion.pose_jacobian(a) for a in angles], atol=1e-15)


def test_the_mounting_covariance_has_no_freedom_across_the_radius() -> None:
    motion = random_motion(2)
    covariances = TurntableCalibration(motion, np.diag(np.arange(1.0, 11.0))).transform_covariances()
    assert covariances is not None
    # The LiDAR's centre may move along x alone: the covariance of y and z of the centre vanishes.
    from lidarpose.geometry.se3 import UncertainPose

    centre = UncertainPose(motion.T_turntable_lidar, covariances[1]).centre_covariance()
    np.testing.assert_allclose(np.diag(centre), [7.0, 0.0, 0.0], atol=1e-12)
