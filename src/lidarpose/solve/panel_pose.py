"""A panel's pose from its corners in one image (turntable paper, section 1.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray, unit
from lidarpose.geometry.robust import huber_weights, mad_sigma
from lidarpose.geometry.se3 import Pose, nearest_rotation, skew
from lidarpose.model.camera import Camera
from lidarpose.model.observation import PanelCorners

MAX_ITERATIONS = 60
# A second minimum this little worse than the first is no evidence against it.
CLOSE_RATIO = 1.5


@dataclass(frozen=True, eq=False)
class PanelPose:
    """A panel's pose in the camera frame.

    Attributes
    ----------
    T_camera_panel
        The pose with the smaller reprojection error.
    covariance : (6, 6)
        Of its left perturbation, m and rad; from the corners' stated standard deviations, widened where the residuals
        exceed them.
    rms_px
        Root mean square of the residual coordinates, in distorted pixels.
    other
        The second minimum that a plane seen from afar has (mirrored about the line of sight), or None.
    other_rms_px
        Its residual; infinite where there is none.
    """

    T_camera_panel: Pose
    covariance: FloatArray
    rms_px: float
    other: Pose | None = None
    other_rms_px: float = float("inf")

    @property
    def ambiguous(self) -> bool:
        """True where the second minimum explains the corners about as well."""
        return self.other_rms_px <= CLOSE_RATIO * self.rms_px


def panel_pose(camera: Camera, corners: PanelCorners) -> PanelPose:
    """Pose of a flat panel from its corners.

    Zhang's homography on ideal coordinates and the nearest rotation give the start; Levenberg and Marquardt minimise
    the reprojection error in distorted pixels (eqs. (1) and (2)), robustly. Both minima of the planar pose problem
    are tried (Schweighofer and Pinz, 2006; Collins and Bartoli, "Infinitesimal plane-based pose estimation", 2014).

    Raises
    ------
    ValueError
        If fewer than four corners can be used, or they lie on one line.
    """
    ideal = camera.undistort(corners.pixels)
    usable = np.isfinite(ideal).all(axis=1)
    if usable.sum() < 4:
        raise ValueError("a panel's pose needs four corners")
    kept = PanelCorners(corners.corners_panel[usable], corners.pixels[usable], corners.sigma_px[usable])
    start = pose_from_homography(fit_homography(kept.corners_panel[:, :2], ideal[usable]), kept.corners_panel)
    found = [_refine(camera, kept, start)]
    mirrored = _mirrored(found[0][0], kept.corners_panel)
    if mirrored is not None:
        found.append(_refine(camera, kept, mirrored))
        found.sort(key=lambda item: item[1])
    (pose, cost, covariance), rest = found[0], found[1:]
    if rest and _same(pose, rest[0][0], kept.corners_panel):
        rest = []
    rms = _rms(camera, kept, pose)
    if not (np.isfinite(cost) and np.isfinite(covariance).all()):
        raise ValueError("the corners determine no pose")
    if not rest or not np.isfinite(rest[0][1]):
        return PanelPose(pose, covariance, rms)
    return PanelPose(pose, covariance, rms, rest[0][0], _rms(camera, kept, rest[0][0]))


def fit_homography(points: FloatArray, ideal: FloatArray) -> FloatArray:
    """Homography (3, 3) from plane points (N, 2) to ideal image coordinates (N, 2), eq. (2) with K = identity.

    Direct linear transform with Hartley's normalisation. Raises ValueError for points on one line.
    """
    A, a = _normalise(points)
    B, b = _normalise(ideal)
    zero, ones = np.zeros((len(a), 3)), np.column_stack([a, np.ones(len(a))])
    rows = np.vstack([np.hstack([ones, zero, -b[:, :1] * ones]), np.hstack([zero, ones, -b[:, 1:] * ones])])
    values, vectors = np.linalg.eigh(rows.T @ rows)
    if values[1] < 1e-13 * values[-1]:
        raise ValueError("points on one line determine no homography")
    return np.asarray(np.linalg.solve(B, vectors[:, 0].reshape(3, 3)) @ A)


def pose_from_homography(H: FloatArray, points: FloatArray) -> Pose:
    """The pose whose first two columns and translation are nearest to a homography's (Zhang, 2000, section 3.1)."""
    scale = 2.0 / (np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1]))
    in_front = float((H @ np.array([*points[:, :2].mean(axis=0), 1.0]))[2])
    columns = H * scale * (1.0 if in_front > 0.0 else -1.0)
    rotation = nearest_rotation(np.column_stack([columns[:, 0], columns[:, 1], np.cross(columns[:, 0], columns[:, 1])]))
    return Pose(rotation, columns[:, 2])


def _normalise(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    mean = points.mean(axis=0)
    scale = np.sqrt(2.0) / max(float(np.sqrt(((points - mean) ** 2).sum(axis=1).mean())), 1e-300)
    T = np.array([[scale, 0.0, -scale * mean[0]], [0.0, scale, -scale * mean[1]], [0.0, 0.0, 1.0]])
    return T, (points - mean) * scale


def _mirrored(pose: Pose, points: FloatArray) -> Pose | None:
    """Start for the second minimum: the panel mirrored in the plane through its middle across the line of sight."""
    middle_panel = points.mean(axis=0)
    middle = pose @ middle_panel
    if not middle[2] > 0.0:
        return None
    sight = unit(middle)
    mirror = np.eye(3) - 2.0 * np.outer(sight, sight)
    rotation = mirror @ pose.rotation @ np.diag([1.0, 1.0, -1.0])
    return Pose(rotation, middle - rotation @ middle_panel)


def _same(a: Pose, b: Pose, points: FloatArray) -> bool:
    """True if the two poses put the points at the same places, to a thousandth of their extent."""
    extent = np.linalg.norm(np.ptp(points, axis=0))
    return bool(np.abs((a @ points) - (b @ points)).max() < 1e-3 * extent)


def _rms(camera: Camera, corners: PanelCorners, pose: Pose) -> float:
    residuals = camera.project(pose @ corners.corners_panel) - corners.pixels
    return float(np.sqrt(np.mean(residuals**2)))


def _refine(camera: Camera, corners: PanelCorners, start: Pose) -> tuple[Pose, float, FloatArray]:
    """Robust Levenberg-Marquardt: pose, weighted cost and covariance. Infinite cost where nothing is in view."""
    sigma = np.maximum(corners.sigma_px, 1e-9)
    pose, cost, _ = _minimise(camera, corners, start, 1.0 / sigma)
    if not np.isfinite(cost):
        return pose, cost, np.full((6, 6), np.nan)
    standardised = np.linalg.norm(camera.project(pose @ corners.corners_panel) - corners.pixels, axis=1) / sigma
    # The length of a two-dimensional normal residual has the median 1.18; the scale never sinks below the stated one.
    scale = max(1.0, mad_sigma(standardised, centred=True) / 1.7456)
    weight = np.sqrt(huber_weights(standardised / scale, 2.5)) / sigma
    pose, cost, information = _minimise(camera, corners, pose, weight)
    excess = max(1.0, cost / max(1, 2 * len(sigma) - 6))
    try:
        covariance = np.linalg.inv(information) * excess
    except np.linalg.LinAlgError:
        covariance = np.full((6, 6), np.nan)
    return pose, cost, np.asarray(covariance)


def _minimise(camera: Camera, corners: PanelCorners, pose: Pose, weight: FloatArray) -> tuple[Pose, float, FloatArray]:
    """Levenberg-Marquardt on the left perturbation: pose, cost, information (6, 6)."""
    residual, J = _linearise(camera, corners, pose, weight)
    cost, damping = float(residual @ residual), 1e-4
    for _ in range(MAX_ITERATIONS):
        if not np.isfinite(cost):
            return pose, float("inf"), np.full((6, 6), np.nan)
        H, g = J.T @ J, J.T @ residual
        step = -np.linalg.solve(H + damping * np.diag(np.maximum(np.diag(H), 1e-300)), g)
        candidate = Pose.exp(step) @ pose
        candidate = Pose(nearest_rotation(candidate.rotation), candidate.translation)
        new_residual, new_J = _linearise(camera, corners, candidate, weight)
        new_cost = float(new_residual @ new_residual)
        # Not "smaller": at the rounding floor a cost may rise by its last digit.
        if new_cost <= cost * (1.0 + 1e-12):
            pose, residual, J, cost = candidate, new_residual, new_J, new_cost
            damping = max(damping * 0.1, 1e-15)
            if np.abs(step).max() < 1e-13:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    return pose, cost, np.asarray(J.T @ J)


def _linearise(camera: Camera, corners: PanelCorners, pose: Pose, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weighted residuals (2N,) and their derivative (2N, 6) by the left perturbation."""
    points = pose @ corners.corners_panel
    pixels, J_point = camera.project_with_jacobian(points)
    J_pose = np.concatenate([np.broadcast_to(np.eye(3), (len(points), 3, 3)), -skew(points)], axis=2)
    J = weight[:, None, None] * (J_point @ J_pose)
    return ((pixels - corners.pixels) * weight[:, None]).ravel(), J.reshape(-1, 6)
