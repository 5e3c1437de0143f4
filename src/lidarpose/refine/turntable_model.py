"""The measurement model of a turntable session: residuals and derivatives of corners, stripe pixels and ranges.

Inside, the motion is ``T_camera_lidar(reading) = G Rz(reading - reference) G^-1 T_reference``: the LiDAR's pose at a
reading amid the data (6 numbers) and the axis as a line (2 shifts, 2 tilts of the frame G that has it as its z).
Nothing in it is singular where the LiDAR's centre lies on the axis, and on a short arc the first six are well
determined whatever the axis is. `to_motion` and `motion_map` lead to the fixed frames.

A measured line (a stripe or a scan line on one panel at one place) lies on a plane, so the derivatives of all its
residuals are combinations of a few basis columns: they collapse into small moment matrices, one a line, and a step of
the estimate costs one pass over the rows whatever the number of parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.se3 import Pose, skew
from lidarpose.model.camera import Camera
from lidarpose.model.observation import LeftOut, PanelCorners, ScanLine, StripePoints, TurntableObservations
from lidarpose.model.turntable import TurntableMotion

EXTRAS = (
    "encoder_scale",
    "range_offset_m",
    "range_scale",
    "beam_angle_scale",
    "black_bias_m",
    "focal_scale",
    "centre_x_px",
    "centre_y_px",
)
"""Further parameters, each zero where it is not estimated (scales are the excess over 1):
true angle = (1 + encoder_scale) * reading; measured range = (1 + range_scale) * distance + range_offset_m, and
black_bias_m more on black; true beam angle = (1 + beam_angle_scale) * stated one; true focal length =
(1 + focal_scale) * stated one, true principal point = stated one + (centre_x_px, centre_y_px)."""

N_MOTION = 10
N_GLOBAL = N_MOTION + len(EXTRAS)
_ENCODER, _OFFSET, _RANGE_SCALE, _BEAM, _BLACK, _FOCAL, _CENTRE_X, _CENTRE_Y = range(N_MOTION, N_GLOBAL)
CAMERA_EXTRAS = [_FOCAL, _CENTRE_X, _CENTRE_Y]


@dataclass(frozen=True)
class Slot:
    """One panel in one placement: six numbers of the estimate."""

    placement: str
    panel: int


@dataclass(frozen=True, eq=False)
class Lines:
    """Measured lines of one kind, row after row; `start[j]:start[j + 1]` are the rows of line j.

    Attributes
    ----------
    place, slot : (S,)
        Which place and which panel each line belongs to.
    along : (N,)
        Where a row is on its line, from -1 to 1.
    sigma : (N,)
        Stated standard deviations, px or m.
    """

    place: IntArray
    slot: IntArray
    start: IntArray
    along: FloatArray
    sigma: FloatArray

    @property
    def count(self) -> int:
        return len(self.place)

    @property
    def line_of_row(self) -> IntArray:
        return np.repeat(np.arange(self.count), np.diff(self.start))


@dataclass(frozen=True, eq=False)
class StripeRows:
    """Stripe pixels as rays (z = 1), with their derivatives by a pixel across the stripe and by the camera's extras."""

    lines: Lines
    pixels: FloatArray
    normals: FloatArray
    rays: FloatArray
    ray_per_px: FloatArray
    ray_per_focal: FloatArray
    ray_per_x: FloatArray
    ray_per_y: FloatArray

    @property
    def ray_size_px(self) -> FloatArray:
        """Length (N,) of the ray's derivative by a pixel."""
        return np.asarray(np.linalg.norm(self.ray_per_px, axis=1))


RAY_DERIVATIVES = ("ray_per_px", "ray_per_focal", "ray_per_x", "ray_per_y")


@dataclass(frozen=True, eq=False)
class RangeRows:
    """Beams: angle, range, and how dark the target is (0 white, 1 black; NaN-free, zero where unknown)."""

    lines: Lines
    angle_rad: FloatArray
    range_m: FloatArray
    darkness: FloatArray


@dataclass(frozen=True, eq=False)
class JointData:
    """Observations laid out for the estimate."""

    camera: Camera
    slots: tuple[Slot, ...]
    corners: tuple[PanelCorners, ...]
    centres: FloatArray
    positions: tuple[str, ...]
    angles_rad: FloatArray
    reference_rad: float
    stripes: StripeRows
    ranges: RangeRows
    has_intensity: bool
    left_out: tuple[LeftOut, ...]


@dataclass(frozen=True, eq=False)
class JointState:
    """Where the estimate stands."""

    T_camera_lidar: Pose
    T_camera_axis: Pose
    panels: tuple[Pose, ...]
    extras: FloatArray

    def turned(self, angles_rad: FloatArray, reference_rad: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rotations (M, 3, 3) and centres (M, 3) of the LiDAR at readings (M,), and derivatives (M, 6, 11).

        The derivatives are of the left perturbation in the camera frame, by the ten numbers and the encoder's scale.
        """
        delta = (1.0 + self.extras[0]) * (angles_rad - reference_rad)
        G, T = self.T_camera_axis, self.T_camera_lidar
        c, s = np.cos(delta), np.sin(delta)
        turn = np.zeros((len(delta), 3, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = c
        turn[:, 0, 1], turn[:, 1, 0], turn[:, 2, 2] = -s, s, 1.0
        R_move = G.rotation @ turn @ G.rotation.T
        t_move = G.translation - R_move @ G.translation
        moved = np.zeros((len(delta), 6, 6))
        moved[:, :3, :3] = moved[:, 3:, 3:] = R_move
        moved[:, :3, 3:] = skew(t_move) @ R_move
        axis = G.adjoint()
        J = np.empty((len(delta), 6, 11))
        J[:, :, :6] = moved
        J[:, :, 6:10] = (np.eye(6) - moved) @ axis[:, [0, 1, 3, 4]]
        J[:, :, 10] = (angles_rad - reference_rad)[:, None] * axis[:, 5]
        return R_move @ T.rotation, R_move @ T.translation + t_move, J

    def moved(self, step: FloatArray, centres: FloatArray) -> JointState:
        """The state after a step (N_GLOBAL + 6 * panels,)."""
        axis_step = np.zeros(6)
        axis_step[[0, 1, 3, 4]] = step[6:10]
        panels = []
        for k, pose in enumerate(self.panels):
            to_centre = Pose(np.eye(3), centres[k])
            at = step[N_GLOBAL + 6 * k : N_GLOBAL + 6 * k + 6]
            panels.append(_tidy(pose @ to_centre @ Pose.exp(at) @ to_centre.inverse()))
        return JointState(
            _tidy(Pose.exp(step[:6]) @ self.T_camera_lidar),
            _tidy(self.T_camera_axis @ Pose.exp(axis_step)),
            tuple(panels),
            self.extras + step[N_MOTION:N_GLOBAL],
        )

    def to_motion(self, reference_rad: float) -> TurntableMotion:
        """The motion in the fixed frames; readings are to be multiplied by 1 + the encoder's scale."""
        G = self.T_camera_axis
        zero = Pose.rot_z(-(1.0 + self.extras[0]) * reference_rad)
        return regular_motion(G, zero @ G.inverse() @ self.T_camera_lidar)


SMALLEST_RADIUS_M = 1e-5


def regular_motion(T_camera_table: Pose, T_table_lidar: Pose) -> TurntableMotion:
    """`TurntableMotion.from_any_frame`, with the radius kept from vanishing.

    In the fixed frame a centre that lies on the axis cannot move sideways, so that the covariance of its position
    would be lost. A centre closer to the axis than 0.01 mm is therefore put at 0.01 mm, on the side of its own
    x axis (of its y axis where x is along the turntable's axis): far below what anybody can measure.
    """
    x, y, z = T_table_lidar.translation
    if np.hypot(x, y) < SMALLEST_RADIUS_M:
        candidates = T_table_lidar.rotation[:2, :2].T
        side = candidates[0] if np.linalg.norm(candidates[0]) > 0.1 else candidates[1]
        x, y = SMALLEST_RADIUS_M * side / np.linalg.norm(side)
        T_table_lidar = Pose(T_table_lidar.rotation, np.array([x, y, z]))
    return TurntableMotion.from_any_frame(T_camera_table, T_table_lidar)


def start_state(data: JointData, motion: TurntableMotion, panels: Mapping[str, tuple[Pose | None, ...]]) -> JointState:
    """The state of a start in the fixed frames. Raises ValueError where a needed panel has no pose."""
    poses = []
    for slot in data.slots:
        of_placement = panels.get(slot.placement, ())
        pose = of_placement[slot.panel] if slot.panel < len(of_placement) else None
        if pose is None:
            raise ValueError(f"no start pose for panel {slot.panel} of placement {slot.placement!r}")
        poses.append(pose)
    at = motion.T_camera_turntable @ Pose.rot_z(data.reference_rad)
    return JointState(motion.pose(data.reference_rad), at, tuple(poses), np.zeros(len(EXTRAS)))


def motion_map(state: JointState, motion: TurntableMotion, reference_rad: float) -> FloatArray:
    """Derivative (10, 11) of `PARAMETER_NAMES` by the internal ten numbers and the encoder's scale.

    Both describe the same poses, so it follows from the poses' derivatives at three readings.
    """
    scale = 1.0 + state.extras[0]
    readings = reference_rad + np.array([-2.1, 0.0, 2.1]) / scale
    _, _, J_inside = state.turned(readings, reference_rad)
    # Inside, the scale turns the LiDAR from the reference reading on; in the fixed frames from reading 0 on.
    J_inside[:, :, 10] = -reference_rad * state.T_camera_axis.adjoint()[:, 5]
    outside = [motion.pose_jacobian(float(scale * reading)) for reading in readings]
    J_outside = np.concatenate(outside)
    return np.asarray(np.linalg.lstsq(J_outside, np.concatenate(list(J_inside)), rcond=None)[0])


# --- layout ---------------------------------------------------------------------------------------------------------


def lay_out(observations: TurntableObservations, *, use_stripes: bool = True) -> JointData:
    """Rows of all measurements. Lines on panels without corners, and rows that are not finite, are left out."""
    slots = _slots(observations)
    index = {slot: k for k, slot in enumerate(slots)}
    left_out: list[LeftOut] = []
    stripes, ranges = [], []
    for i, place in enumerate(observations.places):
        for panel, stripe in place.stripes.items() if use_stripes else ():
            k = index.get(Slot(place.placement, panel))
            if k is None:
                left_out.append(LeftOut(f"stripe of {place.position} on panel {panel}", "the panel has no corners"))
            elif len(stripe) >= 2:
                stripes.append((i, k, stripe))
        for panel, line in place.scan_lines.items():
            k = index.get(Slot(place.placement, panel))
            if k is None:
                left_out.append(LeftOut(f"scan line of {place.position} on panel {panel}", "the panel has no corners"))
            elif len(line) >= 2:
                ranges.append((i, k, line))
    corners = tuple(observations.corners[s.placement][s.panel] for s in slots)
    angles = np.array([p.turntable_angle_rad for p in observations.places], dtype=np.float64)
    has_intensity = bool(ranges) and all(line.intensity is not None for _, _, line in ranges)
    return JointData(
        camera=observations.camera,
        slots=slots,
        corners=corners,
        centres=np.array([c.corners_panel.mean(axis=0) for c in corners]).reshape(-1, 3),
        positions=tuple(p.position for p in observations.places),
        angles_rad=angles,
        reference_rad=float(0.5 * (angles.min() + angles.max())) if len(angles) else 0.0,
        stripes=_stripe_rows(observations.camera, stripes),
        ranges=_range_rows(ranges, has_intensity),
        has_intensity=has_intensity,
        left_out=tuple(left_out),
    )


def thinned(data: JointData, rows_a_line: int) -> JointData:
    """The same with at most so many rows of each line, evenly spread."""
    stripes, ranges = data.stripes, data.ranges
    s_keep, s_lines = _thin_lines(stripes.lines, rows_a_line)
    r_keep, r_lines = _thin_lines(ranges.lines, rows_a_line)
    return replace(
        data,
        stripes=StripeRows(
            s_lines,
            *(getattr(stripes, name)[s_keep] for name in ("pixels", "normals", "rays", *RAY_DERIVATIVES)),
        ),
        ranges=RangeRows(r_lines, *(getattr(ranges, n)[r_keep] for n in ("angle_rad", "range_m", "darkness"))),
    )


def _thin_lines(lines: Lines, rows_a_line: int) -> tuple[IntArray, Lines]:
    keep = [np.zeros(0, dtype=np.int64)]
    for a, b in zip(lines.start[:-1], lines.start[1:], strict=True):
        n = min(int(b - a), rows_a_line)
        keep.append(a + (np.arange(n) * (b - a)) // max(n, 1))
    index = np.concatenate(keep)
    start = np.cumsum([len(k) for k in keep], dtype=np.int64)
    return index, Lines(lines.place, lines.slot, start, lines.along[index], lines.sigma[index])


def _slots(observations: TurntableObservations) -> tuple[Slot, ...]:
    used = {(p.placement, k) for p in observations.places for k in (*p.stripes, *p.scan_lines)}
    return tuple(
        Slot(placement, k)
        for placement, corners in observations.corners.items()
        for k in range(len(corners))
        if (placement, k) in used and len(corners[k].pixels) >= 4
    )


def _lines(items: list[tuple[int, int, FloatArray, FloatArray]]) -> Lines:
    """`items`: place, slot, coordinate along the line, sigma."""
    start = np.concatenate([[0], np.cumsum([len(item[2]) for item in items], dtype=np.int64)]).astype(np.int64)
    along = []
    for _, _, coordinate, _ in items:
        low, high = coordinate.min(), coordinate.max()
        along.append((2.0 * coordinate - low - high) / max(high - low, 1e-12))
    return Lines(
        np.array([item[0] for item in items], dtype=np.int64),
        np.array([item[1] for item in items], dtype=np.int64),
        start,
        np.concatenate([*along, np.zeros(0)]),
        np.concatenate([*(item[3] for item in items), np.zeros(0)]),
    )


def _stripe_rows(camera: Camera, items: list[tuple[int, int, StripePoints]]) -> StripeRows:
    kept: list[tuple[int, int, FloatArray, FloatArray]] = []
    pixels: list[FloatArray] = [np.zeros((0, 2))]
    normals: list[FloatArray] = [np.zeros((0, 2))]
    for place, slot, stripe in items:
        good = np.isfinite(stripe.pixels).all(1) & np.isfinite(stripe.normals).all(1) & (stripe.sigma_px > 0.0)
        good &= np.isfinite(stripe.sigma_px)
        if good.sum() < 2:
            continue
        normal = stripe.normals[good]
        main = np.linalg.eigh(normal.T @ normal)[1][:, 0]
        kept.append((place, slot, stripe.pixels[good] @ main, stripe.sigma_px[good]))
        pixels.append(stripe.pixels[good])
        normals.append(normal)
    return stripe_rays(camera, _lines(kept), np.concatenate(pixels), np.concatenate(normals))


def stripe_rays(camera: Camera, lines: Lines, pixels: FloatArray, normals: FloatArray) -> StripeRows:
    """The rays of stripe pixels; pixels outside the distortion model's valid region get a direction without weight."""
    ideal = camera.undistort(pixels)
    lost = np.asarray(~np.isfinite(ideal).all(axis=1))
    ideal = np.where(lost[:, None], 0.0, ideal)
    rays = np.column_stack([ideal, np.ones(len(ideal))])
    _, J = camera.project_with_jacobian(rays) if len(rays) else (None, np.zeros((0, 2, 3)))
    inverse = np.linalg.inv(J[:, :, :2]) if len(rays) else np.zeros((0, 2, 2))
    per_px = np.einsum("nij,nj->ni", inverse, normals)
    per_focal = np.einsum("nij,nj->ni", inverse, -(pixels - camera.K[:2, 2]))
    flat = np.zeros((len(rays), 1))
    if lost.any():
        lines = replace(lines, sigma=np.where(lost, np.inf, lines.sigma))
    derivatives = [per_px, per_focal, -inverse[:, :, 0], -inverse[:, :, 1]]
    return StripeRows(lines, pixels, normals, rays, *(np.hstack([d, flat]) for d in derivatives))


def _range_rows(items: list[tuple[int, int, ScanLine]], has_intensity: bool) -> RangeRows:
    kept: list[tuple[int, int, FloatArray, FloatArray]] = []
    angles: list[FloatArray] = [np.zeros(0)]
    ranges: list[FloatArray] = [np.zeros(0)]
    intensities: list[FloatArray] = [np.zeros(0)]
    for place, slot, line in items:
        good = np.isfinite(line.angle_rad) & np.isfinite(line.range_m) & (line.range_m > 0.0)
        good &= np.isfinite(line.sigma_m) & (line.sigma_m > 0.0)
        if good.sum() < 2:
            continue
        kept.append((place, slot, line.angle_rad[good], line.sigma_m[good]))
        angles.append(line.angle_rad[good])
        ranges.append(line.range_m[good])
        intensities.append(np.zeros(int(good.sum())) if line.intensity is None else line.intensity[good])
    intensity = np.concatenate(intensities)
    darkness = _darkness(intensity) if has_intensity else np.zeros(len(intensity))
    return RangeRows(_lines(kept), np.concatenate(angles), np.concatenate(ranges), darkness)


def _darkness(intensity: FloatArray) -> FloatArray:
    """0 for the brighter of two classes of beams (Otsu's threshold), 1 for the darker; in between for mixed ones."""
    finite = np.isfinite(intensity)
    if finite.sum() < 10:
        return np.zeros(len(intensity))
    values = np.sort(intensity[finite])
    n = len(values)
    below = np.cumsum(values)[:-1]
    count = np.arange(1, n)
    between = (below / count - (below[-1] + values[-1] - below) / (n - count)) ** 2 * count * (n - count)
    cut = int(np.argmax(between)) + 1
    # Within a class brightness still varies with distance and slant; only what lies between the classes is mixed.
    dark, bright = float(np.quantile(values[:cut], 0.95)), float(np.quantile(values[cut:], 0.05))
    if not bright > dark:
        return np.asarray(np.where(finite, intensity < values[cut], 0.0))
    return np.asarray(np.where(finite, np.clip((bright - intensity) / (bright - dark), 0.0, 1.0), 0.0))


# --- residuals ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LineResiduals:
    """Residuals (N,) of lines of one kind, the basis of their derivatives, and how it maps to the parameters.

    ``d residual = basis @ to_parameters[line] @ step``: basis (N, b), to_parameters (S, b, N_GLOBAL + 6), whose last
    six columns are of the line's own panel.
    """

    residual: FloatArray
    basis: FloatArray
    to_parameters: FloatArray
    valid: BoolArray


@dataclass(frozen=True, eq=False)
class CornerResiduals:
    """Of one panel: residuals (2N,) and derivatives (2N, 9) by the panel's six numbers and the camera's extras."""

    residual: FloatArray
    jacobian: FloatArray


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
    J[:, :, 6] = -(predicted - camera.K[:2, 2]) / (1.0 + state.extras[_FOCAL - N_MOTION])
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


def stripe_residuals(data: JointData, state: JointState) -> LineResiduals:
    """Distance in pixels of each stripe point from the predicted stripe, along its measured normal.

    The ray through the pixel meets the panel in P; its distance from the light plane, over the rate at which that
    distance changes per pixel across the stripe, is to first order the pixel distance from the intersection curve.
    """
    rows, lines = data.stripes, data.stripes.lines
    of_row = lines.line_of_row
    R_place, t_place, J_place = state.turned(data.angles_rad, data.reference_rad)
    R_panel, t_panel, map_panel = _panel_geometry(data, state)
    if np.any(state.extras[np.array(CAMERA_EXTRAS) - N_MOTION] != 0.0):
        rows = stripe_rays(corrected_camera(data.camera, state.extras), lines, rows.pixels, rows.normals)
    offset = np.einsum("ki,ki->k", R_panel[:, :, 2], t_panel)[lines.slot][of_row]
    height = np.einsum("mi,mi->m", R_place[:, :, 2], t_place)[lines.place][of_row]
    products = _stripe_products(rows, R_panel[lines.slot], R_place[lines.place][:, :, 2])
    ray_n, ray_m, px_n, px_m, focal_n, focal_m, x_n, x_m, y_n, y_m, ray_x, ray_y, px_x, px_y = products
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
    basis = np.empty((len(valid), 9))
    basis[:, 0] = np.where(valid, inverse, 0.0)
    depth = np.where(valid, depth, 0.0)
    alpha = np.where(valid, alpha, 0.0)
    on_stripe = np.where(valid, residual, 0.0)
    basis[:, 1] = basis[:, 0] * (depth * (ray_x - on_stripe * px_x) - centre[:, 0])
    basis[:, 2] = basis[:, 0] * (depth * (ray_y - on_stripe * px_y) - centre[:, 1])
    basis[:, 3:6] = alpha[:, None] * basis[:, :3]
    # Of the point on the stripe too: at the measured pixel the focal length would take the noise's square for signal.
    focal_m, focal_n = focal_m + on_stripe * px_m, focal_n + on_stripe * px_n
    for column, (by_m, by_n) in enumerate(((focal_m, focal_n), (x_m, x_n), (y_m, y_n)), start=6):
        basis[:, column] = basis[:, 0] * depth * (by_m - alpha * by_n)
    to = np.zeros((lines.count, 9, N_GLOBAL + 6))
    light = _moment_map(R_place[lines.place, :, 2], R_panel[lines.slot], t_panel[lines.slot])
    to[:, :3, : N_MOTION + 1] = -np.swapaxes(light, 1, 2) @ J_place[lines.place]
    J_panel = panel_jacobians(state, data)
    to[:, 3:6, N_GLOBAL:] = np.swapaxes(map_panel[lines.slot], 1, 2) @ J_panel[lines.slot]
    for column, p in enumerate(CAMERA_EXTRAS, start=6):
        to[:, column, p] = 1.0
    return LineResiduals(np.where(valid, residual, 0.0), basis, to, valid)


_LARGEST_STEP_PX = 100.0


def _stripe_products(rows: StripeRows, R_panel: FloatArray, light_normal: FloatArray) -> FloatArray:
    """Products (14, N) of each row's ray and its derivatives with its line's vectors.

    The ray and its derivatives by a pixel, the focal scale and the principal point, each with the panel's normal and
    with the light plane's (S, 3); last the ray and its derivative by a pixel with the panel's two axes. One small
    matrix product a line.
    """
    joined = np.concatenate([rows.rays, *(getattr(rows, name) for name in RAY_DERIVATIVES)], axis=1)
    factors = np.zeros((rows.lines.count, 15, 14))
    for k in range(5):
        factors[:, 3 * k : 3 * k + 3, 2 * k] = R_panel[:, :, 2]
        factors[:, 3 * k : 3 * k + 3, 2 * k + 1] = light_normal
    factors[:, :3, 10:12] = factors[:, 3:6, 12:] = R_panel[:, :, :2]
    out = np.empty((len(joined), 14))
    start = rows.lines.start
    for j in range(rows.lines.count):
        np.matmul(joined[start[j] : start[j + 1]], factors[j], out=out[start[j] : start[j + 1]])
    return np.ascontiguousarray(out.T)


def range_residuals(data: JointData, state: JointState) -> LineResiduals:
    """Measured range less the beam's distance to the panel's plane, along the beam."""
    rows, lines = data.ranges, data.ranges.lines
    of_row = lines.line_of_row
    R_place, t_place, J_place = state.turned(data.angles_rad, data.reference_rad)
    R_panel, t_panel, map_panel = _panel_geometry(data, state)
    offset_m, scale, beam, black = state.extras[np.array([_OFFSET, _RANGE_SCALE, _BEAM, _BLACK]) - N_MOTION]
    angle = (1.0 + beam) * rows.angle_rad
    c, s = np.cos(angle), np.sin(angle)
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
    start = np.einsum("sij,sj->si", to_panel, t_place[lines.place] - t_panel[lines.slot])[of_row]
    axes = (to_panel @ R_place[lines.place])[of_row]
    X = start[:, 0] + predicted * (c * axes[:, 0, 0] + s * axes[:, 0, 1])
    Y = start[:, 1] + predicted * (c * axes[:, 1, 0] + s * axes[:, 1, 1])
    grow = inverse * (1.0 + scale)
    d_angle = -predicted * (-s * n_lidar[:, 0] + c * n_lidar[:, 1]) * grow
    flag = valid.astype(np.float64)
    basis = np.stack(
        [grow, grow * X, grow * Y, -flag, -predicted, -d_angle * rows.angle_rad, -flag * rows.darkness], axis=1
    )
    to = np.zeros((lines.count, 7, N_GLOBAL + 6))
    plane = np.swapaxes(map_panel[lines.slot], 1, 2)
    to[:, :3, : N_MOTION + 1] = plane @ J_place[lines.place]
    to[:, :3, N_GLOBAL:] = -plane @ panel_jacobians(state, data)[lines.slot]
    for row, column in zip(range(3, 7), (_OFFSET, _RANGE_SCALE, _BEAM, _BLACK), strict=True):
        to[:, row, column] = 1.0
    residual = rows.range_m - (1.0 + scale) * predicted - offset_m - black * rows.darkness
    return LineResiduals(np.where(valid, residual, 0.0), basis, to, valid)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ni,ni->n", a, b))


def _tidy(pose: Pose) -> Pose:
    """The same pose with its rotation orthogonal to rounding, so that many steps do not add up."""
    from lidarpose.geometry.se3 import nearest_rotation

    return Pose(nearest_rotation(pose.rotation), pose.translation)
