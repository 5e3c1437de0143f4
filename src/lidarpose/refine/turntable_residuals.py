"""Residuals and derivatives of corners, stripe pixels and ranges at a state of the estimate.

A measured line (a stripe or a scan line on one panel at one place) lies on a plane, so the derivatives of all its
residuals are combinations of a few basis columns: they collapse into small moment matrices, one a line, and a step of
the estimate costs one pass over the rows whatever the number of parameters.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.se3 import Pose, skew
from lidarpose.model.camera import Camera
from lidarpose.refine.least_squares import line_columns
from lidarpose.refine.turntable_layout import JointData, StripeRows, stripe_rays
from lidarpose.refine.turntable_parameters import (
    BEAM,
    BLACK,
    CAMERA_EXTRAS,
    FOCAL,
    N_GLOBAL,
    N_MOTION,
    OFFSET,
    RANGE_EXTRAS,
    RANGE_SCALE,
)
from lidarpose.refine.turntable_state import JointState


@dataclass(frozen=True, eq=False)
class LineResiduals:
    """Residuals (N,) of lines of one kind, the basis of their derivatives, and how it maps to the parameters.

    ``d residual = basis @ to_parameters[line] @ step``: basis (N, b), to_parameters (S, b, N_GLOBAL + 6), whose last
    six columns are of the line's own panel. The basis stands in the first of `columns`, see `line_columns`. It may
    lack what only parameters need that are held.
    """

    residual: FloatArray
    columns: FloatArray
    to_parameters: FloatArray
    valid: BoolArray

    @property
    def basis(self) -> FloatArray:
        return self.columns[:, :-3]

    def shift_by(self, step: FloatArray, slot: IntArray) -> FloatArray:
        """By how much a step (n,) of all parameters moves the basis' coefficients (S, b) of lines on panels (S,)."""
        of_panel = step[N_GLOBAL:].reshape(-1, 6)[slot]
        return np.asarray(self.to_parameters[:, :, :N_GLOBAL] @ step[:N_GLOBAL]) + np.asarray(
            (self.to_parameters[:, :, N_GLOBAL:] @ of_panel[:, :, None])[:, :, 0]
        )

    def moved(self, shift: FloatArray, line_of_row: IntArray) -> LineResiduals:
        """The same after a small step, its coefficients (S, b) given, to first order."""
        residual = self.residual.copy()
        for k in range(shift.shape[1]):
            residual += self.columns[:, k] * shift[line_of_row, k]
        columns = self.columns.copy()
        columns[:, -1] = residual
        return LineResiduals(residual, columns, self.to_parameters, self.valid)


@dataclass(frozen=True, eq=False)
class CornerResiduals:
    """Of one panel: residuals (2N,) and derivatives (2N, 9) by the panel's six numbers and the camera's extras."""

    residual: FloatArray
    jacobian: FloatArray

    def moved(self, step: FloatArray, k: int) -> CornerResiduals:
        """Those of panel k after a small step (n,) of all parameters, to first order."""
        own = np.concatenate([step[N_GLOBAL + 6 * k : N_GLOBAL + 6 * k + 6], step[np.array(CAMERA_EXTRAS)]])
        return CornerResiduals(self.residual + self.jacobian @ own, self.jacobian)


def corner_residuals(data: JointData, state: JointState, k: int) -> CornerResiduals:
    """Measured less predicted pixels of panel k, x and y in turn."""
    corners, pose = data.corners[k], state.panels[k]
    camera = corrected_camera(data.camera, state.extras)
    points = pose @ corners.corners_panel
    predicted, J_point = camera.project_with_jacobian(points)
    local = points - pose @ data.centres[k]
    # A local perturbation at the panel's centre moves a point by R (v + w x (X - centre)).
    J_pose = np.concatenate([np.broadcast_to(np.eye(3), (len(points), 3, 3)), -skew(local)], axis=2)
    R2 = np.zeros((6, 6))
    R2[:3, :3] = R2[3:, 3:] = pose.rotation
    J = np.zeros((len(points), 2, 9))
    J[:, :, :6] = -(J_point @ J_pose @ R2)
    J[:, :, 6] = -(predicted - camera.K[:2, 2]) / (1.0 + state.extras[FOCAL - N_MOTION])
    J[:, 0, 7] = J[:, 1, 8] = -1.0
    residual = corners.pixels - predicted
    return CornerResiduals(np.where(np.isfinite(residual), residual, 1e6).ravel(), J.reshape(-1, 9))


def corrected_camera(camera: Camera, extras: FloatArray) -> Camera:
    """The camera with the camera's extras applied."""
    focal, x, y = (float(extras[p - N_MOTION]) for p in CAMERA_EXTRAS)
    if focal == x == y == 0.0:
        return camera
    K = camera.K.copy()
    K[:2, :2] *= 1.0 + focal
    K[:2, 2] += x, y
    return replace(camera, K=K)


@dataclass(frozen=True, eq=False)
class Frames:
    """Where places and panels are at a state, with derivatives: see `JointState.turned`, `_panel_geometry` and
    `panel_jacobians`."""

    R_place: FloatArray
    t_place: FloatArray
    J_place: FloatArray
    R_panel: FloatArray
    t_panel: FloatArray
    map_panel: FloatArray
    J_panel: FloatArray

    @staticmethod
    def at(data: JointData, state: JointState) -> Frames:
        places = state.turned(data.angles_rad, data.reference_rad)
        return Frames(*places, *_panel_geometry(data, state), panel_jacobians(state, data))


def _panel_geometry(data: JointData, state: JointState) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of each panel: rotation (K, 3, 3), centre (K, 3) in the camera frame, and the maps (K, 6, 3).

    Map column 0 is (n, t x n), 1 and 2 are (0, r1 x n) and (0, r2 x n): with coordinates X, Y of a point P from the
    centre along the panel's axes, the three combine with 1, X, Y to (n, P x n).
    """
    R = np.array([p.rotation for p in state.panels])
    t = np.array([p @ c for p, c in zip(state.panels, data.centres, strict=True)])
    return R, t, _moment_map(R[:, :, 2], R, t)


def _moment_map(direction: FloatArray, R: FloatArray, t: FloatArray) -> FloatArray:
    """(S, 6, 3): combines with (1, X, Y) to (direction, P x direction), where P = t + X r1 + Y r2."""
    out = np.zeros((len(direction), 6, 3))
    out[:, :3, 0] = direction
    out[:, 3:, 0] = np.cross(t, direction)
    out[:, 3:, 1] = np.cross(R[:, :, 0], direction)
    out[:, 3:, 2] = np.cross(R[:, :, 1], direction)
    return out


def panel_jacobians(state: JointState, data: JointData) -> FloatArray:
    """(K, 6, 6): left perturbation in the camera frame by the local one at the panel's centre."""
    adjoints = [(p @ Pose(np.eye(3), c)).adjoint() for p, c in zip(state.panels, data.centres, strict=True)]
    return np.array(adjoints).reshape(-1, 6, 6)


def stripe_residuals(data: JointData, state: JointState, frames: Frames, *, of_camera: bool) -> LineResiduals:
    """Distance in pixels of each stripe point from the predicted stripe, along its measured normal.

    `of_camera`: whether the basis is to hold what the camera's extra parameters need.

    The ray through the pixel meets the panel in P; its distance from the light plane, over the rate at which that
    distance changes per pixel across the stripe, is to first order the pixel distance from the intersection curve.
    """
    rows, lines = data.stripes, data.stripes.lines
    of_row = lines.line_of_row
    R_place, t_place, R_panel, t_panel = frames.R_place, frames.t_place, frames.R_panel, frames.t_panel
    if np.any(state.extras[np.array(CAMERA_EXTRAS) - N_MOTION] != 0.0):
        rows = stripe_rays(corrected_camera(data.camera, state.extras), lines, rows.pixels, rows.normals)
    offset = np.einsum("ki,ki->k", R_panel[:, :, 2], t_panel)[lines.slot][of_row]
    height = np.einsum("mi,mi->m", R_place[:, :, 2], t_place)[lines.place][of_row]
    products = _stripe_products(rows, R_panel[lines.slot], R_place[lines.place][:, :, 2], 5 if of_camera else 2)
    ray_x, ray_y, px_x, px_y, ray_n, ray_m, px_n, px_m = products[:8]
    with np.errstate(divide="ignore", invalid="ignore"):
        # From the measured pixel to the stripe, then once more from the point found there: the residual is exact to
        # second order, and the derivatives, taken on the stripe, do not depend on the pixel's own noise.
        residual = np.zeros_like(ray_n)
        for _ in range(2):
            depth = offset / (ray_n - residual * px_n)
            alpha = (ray_m - residual * px_m) / (ray_n - residual * px_n)
            per_pixel = depth * (px_m - alpha * px_n)
            step = ((ray_m - residual * px_m) * depth - height) / per_pixel
            if not residual.any():
                residual = np.clip(np.nan_to_num(step), -_LARGEST_STEP_PX, _LARGEST_STEP_PX)
        residual = residual + step
        inverse = 1.0 / per_pixel
    valid = np.isfinite(inverse) & np.isfinite(residual) & (depth > 0.0) & np.isfinite(lines.sigma)
    # Where the measured normal runs along the predicted stripe, a pixel across it says nothing.
    valid &= np.abs(per_pixel) > 0.02 * depth * rows.ray_size_px
    centre = np.einsum("kij,ki->kj", R_panel, t_panel)[lines.slot][of_row]
    inverse = np.where(valid, inverse, 0.0)
    depth = np.where(valid, depth, 0.0)
    alpha = np.where(valid, alpha, 0.0)
    on_stripe = np.where(valid, residual, 0.0)
    by_light = (
        inverse,
        inverse * (depth * (ray_x - on_stripe * px_x) - centre[:, 0]),
        inverse * (depth * (ray_y - on_stripe * px_y) - centre[:, 1]),
    )
    basis = [*by_light, *(alpha * column for column in by_light)]
    if of_camera:
        focal_n, focal_m, x_n, x_m, y_n, y_m = products[8:]
        # Of the point on the stripe too: at the measured pixel the focal length would take the noise's square for
        # signal.
        focal_m, focal_n = focal_m + on_stripe * px_m, focal_n + on_stripe * px_n
        basis += [inverse * depth * (m - alpha * n) for m, n in ((focal_m, focal_n), (x_m, x_n), (y_m, y_n))]
    to = np.zeros((lines.count, len(basis), N_GLOBAL + 6))
    light = _moment_map(R_place[lines.place, :, 2], R_panel[lines.slot], t_panel[lines.slot])
    to[:, :3, : N_MOTION + 1] = -np.swapaxes(light, 1, 2) @ frames.J_place[lines.place]
    to[:, 3:6, N_GLOBAL:] = np.swapaxes(frames.map_panel[lines.slot], 1, 2) @ frames.J_panel[lines.slot]
    if of_camera:
        for column, p in enumerate(CAMERA_EXTRAS, start=6):
            to[:, column, p] = 1.0
    return LineResiduals(on_stripe, line_columns(basis, lines.along, on_stripe), to, valid)


_LARGEST_STEP_PX = 100.0


def _stripe_products(rows: StripeRows, R_panel: FloatArray, light_normal: FloatArray, count: int) -> FloatArray:
    """Products (4 + 2 count, N) of each row's ray and its derivatives with its line's vectors.

    First the ray and its derivative by a pixel with the panel's two axes; then of the first `count` (two at least) of
    the ray and its derivatives by a pixel, the focal scale and the principal point each with the panel's normal and
    with the light plane's (S, 3). One small matrix product a line.
    """
    joined = rows.joined[:, : 3 * count]
    factors = np.zeros((rows.lines.count, 3 * count, 4 + 2 * count))
    factors[:, :3, :2] = factors[:, 3:6, 2:4] = R_panel[:, :, :2]
    for k in range(count):
        factors[:, 3 * k : 3 * k + 3, 4 + 2 * k] = R_panel[:, :, 2]
        factors[:, 3 * k : 3 * k + 3, 5 + 2 * k] = light_normal
    out = np.empty((len(joined), factors.shape[2]))
    start = rows.lines.start.tolist()
    for j in range(rows.lines.count):
        np.matmul(joined[start[j] : start[j + 1]], factors[j], out=out[start[j] : start[j + 1]])
    return np.ascontiguousarray(out.T)


def range_residuals(
    data: JointData, state: JointState, frames: Frames, *, extras: Collection[int] = RANGE_EXTRAS
) -> LineResiduals:
    """Measured range less the beam's distance to the panel's plane, along the beam.

    `extras`: those of `RANGE_EXTRAS` whose derivatives the basis is to hold.
    """
    rows, lines = data.ranges, data.ranges.lines
    of_row = lines.line_of_row
    R_place, t_place, R_panel, t_panel = frames.R_place, frames.t_place, frames.R_panel, frames.t_panel
    offset_m, scale, beam, black = state.extras[np.array([OFFSET, RANGE_SCALE, BEAM, BLACK]) - N_MOTION]
    angle = (1.0 + beam) * rows.angle_rad
    c, s = rows.beams if beam == 0.0 else (np.cos(angle), np.sin(angle))
    # The panel's normal in the LiDAR frame, one a line: beams then need two products each.
    n_lidar = np.einsum("sij,si->sj", R_place[lines.place], R_panel[lines.slot, :, 2])[of_row]
    height = np.einsum("si,si->s", R_panel[lines.slot, :, 2], t_panel[lines.slot] - t_place[lines.place])[of_row]
    along = c * n_lidar[:, 0] + s * n_lidar[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        predicted = height / along
        inverse = 1.0 / along
    valid = np.isfinite(predicted) & (predicted > 0.0) & (np.abs(along) > 1e-3)
    predicted, inverse = np.where(valid, predicted, 0.0), np.where(valid, inverse, 0.0)
    # Coordinates on the panel are linear in the beam's foot: origin and two directions, one each a line.
    to_panel = np.swapaxes(R_panel[lines.slot], 1, 2)
    start = np.einsum("sij,sj->si", to_panel, t_place[lines.place] - t_panel[lines.slot])
    axes = to_panel @ R_place[lines.place]
    X, Y = (start[:, k][of_row] + predicted * (c * axes[:, k, 0][of_row] + s * axes[:, k, 1][of_row]) for k in range(2))
    grow = inverse * (1.0 + scale)
    basis, flag = [grow, grow * X, grow * Y], valid.astype(np.float64)
    kept = [p for p in RANGE_EXTRAS if p in extras]
    for p in kept:
        if p == OFFSET:
            basis.append(-flag)
        elif p == RANGE_SCALE:
            basis.append(-predicted)
        elif p == BEAM:
            basis.append(predicted * (-s * n_lidar[:, 0] + c * n_lidar[:, 1]) * grow * rows.angle_rad)
        else:
            basis.append(-flag * rows.darkness)
    to = np.zeros((lines.count, len(basis), N_GLOBAL + 6))
    plane = np.swapaxes(frames.map_panel[lines.slot], 1, 2)
    to[:, :3, : N_MOTION + 1] = plane @ frames.J_place[lines.place]
    to[:, :3, N_GLOBAL:] = -plane @ frames.J_panel[lines.slot]
    for row, column in enumerate(kept, start=3):
        to[:, row, column] = 1.0
    residual = rows.range_m - (1.0 + scale) * predicted - offset_m - black * rows.darkness
    residual = np.where(valid, residual, 0.0)
    return LineResiduals(residual, line_columns(basis, lines.along, residual), to, valid)
