"""What the literature's methods see of a session: flat boards with scan points on them, nothing of the stripe.

Their common cost is that of points on planes, ``n . (R p + t) = d``, a square of the ten numbers (r1, r2, t, 1), where
r1 and r2 are R's first columns: the points of one view collapse into three pseudo-points with the same moments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.se3 import Pose, exp_so3, nearest_rotation, skew
from lidarpose.model.observation import TurntableObservations
from lidarpose.solve.panel_pose import panel_pose


@dataclass(frozen=True, eq=False)
class PlaneView:
    """One board at one reading.

    Attributes
    ----------
    T_camera_panel, panel
        The board's pose from its corners, and which one it is (0 or 1).
    points : (N, 2)
        Scan points on it, LiDAR frame, in order of the beams.
    rows : (3, 3)
        Pseudo-points (x, y, 1 each times a weight): ``rows.T @ rows`` are the points' moments.
    """

    T_camera_panel: Pose
    panel: int
    placement: str
    points: FloatArray
    rows: FloatArray

    @property
    def plane(self) -> Plane:
        """In the camera frame."""
        return Plane.from_pose(self.T_camera_panel)


def views_by_reading(observations: TurntableObservations) -> dict[float, list[PlaneView]]:
    """All views of a session, by the turntable's reading; one board pose a placement, as everybody estimates it."""
    poses: Mapping[str, list[Pose]] = {
        name: [panel_pose(observations.camera, c).T_camera_panel for c in corners]
        for name, corners in observations.corners.items()
    }
    found: dict[float, list[PlaneView]] = {}
    for place in observations.places:
        views = found.setdefault(place.turntable_angle_rad, [])
        for k, line in place.scan_lines.items():
            points = line.points_lidar()
            rows = np.linalg.qr(np.column_stack([points, np.ones(len(points))])).R
            views.append(PlaneView(poses[place.placement][k], k, place.placement, points, rows))
    return found


@dataclass(frozen=True, eq=False)
class Constraints:
    """Views stacked: unit normals (V, 3), offsets (V,), pseudo-points (V, 3, 3)."""

    normals: FloatArray
    offsets: FloatArray
    rows: FloatArray

    @staticmethod
    def of(views: Sequence[PlaneView]) -> Constraints:
        planes = [v.plane for v in views]
        return Constraints(
            np.stack([p.normal for p in planes]),
            np.array([p.offset for p in planes]),
            np.stack([v.rows for v in views]),
        )

    def linear(self) -> tuple[FloatArray, FloatArray]:
        """Rows (3 V, 9) and right sides (3 V,) of the constraint in (r1, r2, t)."""
        A = np.einsum("vkj,vi->vkji", self.rows, self.normals).reshape(-1, 9)
        return A, (self.rows[:, :, 2] * self.offsets[:, None]).ravel()

    def residuals(self, R: FloatArray, t: FloatArray) -> FloatArray:
        """Distances (..., 3 V) of the pseudo-points for rotations (..., 3, 3) and translations (..., 3)."""
        columns = np.concatenate([R[..., :2], t[..., None]], axis=-1)
        height = np.einsum("vi,...ij,vkj->...vk", self.normals, columns, self.rows)
        return np.asarray((height - self.offsets[:, None] * self.rows[:, :, 2]).reshape(*R.shape[:-2], -1))

    def jacobian(self, R: FloatArray, t: FloatArray) -> FloatArray:
        """Derivative (..., 3 V, 6) of the residuals by a shift and a turn of the LiDAR about its own centre."""
        weight = self.rows[:, :, 2]
        moved = np.einsum("...ij,vkj->...vki", R[..., :2], self.rows[:, :, :2])
        turned = np.cross(moved, self.normals[:, None, :])
        shifted = np.broadcast_to(weight[:, :, None] * self.normals[:, None, :], turned.shape)
        J = np.concatenate([shifted, turned], axis=-1)
        return np.asarray(J.reshape(*R.shape[:-2], -1, 6))


def refined(
    constraints: Constraints, R: FloatArray, t: FloatArray, iterations: int = 12
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gauss-Newton on all starts (K, 3, 3), (K, 3) at once: rotations, translations, costs (K,)."""
    for _ in range(iterations):
        e, J = constraints.residuals(R, t), constraints.jacobian(R, t)
        H = np.swapaxes(J, -1, -2) @ J
        H = H + 1e-12 * np.trace(H, axis1=-2, axis2=-1)[..., None, None] * np.eye(6)
        step = -np.linalg.solve(H, np.swapaxes(J, -1, -2) @ e[..., None])[..., 0]
        # A turn of more than half a radian a step leaves the region where the linear model holds.
        step = step * np.minimum(1.0, 0.5 / np.maximum(np.linalg.norm(step[..., 3:], axis=-1), 1e-12))[..., None]
        R, t = exp_so3(step[..., 3:]) @ R, t + step[..., :3]
    R = nearest_rotation(R)
    return R, t, np.asarray((constraints.residuals(R, t) ** 2).sum(axis=-1))


def pose_jacobian_columns(centre: FloatArray) -> FloatArray:
    """(6, 6): from a left perturbation of the pose to (shift of the LiDAR's centre, turn)."""
    out = np.eye(6)
    out[:3, 3:] = -skew(centre)
    return out
