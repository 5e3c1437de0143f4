"""One estimate of the LiDAR's pose from all returns of a three-faced target at all its places.

Model. At place i the target's corner has the measured world coordinates w_i, up to their own noise e_i; in the LiDAR's
frame it is at ``c_i = R^T (w_i + e_i - t) / s``. The target is not turned, so its three faces have the same normals
n_j at every place. A beam with direction u meets face j at the range ``n_j . c_i / (n_j . u)``; measured ranges scatter
about it with the instrument's noise, along the beam. Unknown are the pose (6), three free unit normals (6), the scale
if asked for, and the e_i, held by their prior. Directions carry no noise, so the residual is one range, and the
estimate is maximum likelihood but for a redescending loss against what is no return of the faces.

A return enters through three numbers of its face at its place, the plane's shift along its normal and its two tilts.
Each face at each place therefore collapses to a 3x3 system, and the whole estimate costs one pass over the returns for
each step, however many frames there are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, perpendicular_pair, unit
from lidarpose.geometry.robust import mad_sigma
from lidarpose.geometry.se3 import Pose, exp_so3, skew
from lidarpose.model.corner_result import CornerPlaceFaces, FaceReturns

# Tukey's biweight at 6 sigma keeps 98.8 % efficiency; what is no return of a face is tens of sigmas off.
TUKEY_K = 6.0
MIN_SIGMA_M = 1e-6
MAX_STEPS = 50
# What is left to go after the last step, in standard deviations.
SETTLED = 1e-3
# By how much weighted least squares follow normal noise under this loss: the mean slope over the mean weight. Steps are
# made longer by it, which leaves a hundredth of the way where weights alone would leave a ninth.
FOLLOWED = (1.0 - 6.0 / TUKEY_K**2 + 15.0 / TUKEY_K**4) / (1.0 - 2.0 / TUKEY_K**2 + 3.0 / TUKEY_K**4)
MIN_RETURNS = 3
# So many returns of a face tell how wide the loss has to be at first.
ENOUGH = 1000


@dataclass(frozen=True, eq=False)
class FaceSystem:
    """One face at one place, collapsed: normal equations of (shift, tilt, tilt), in units of the range noise.

    Attributes
    ----------
    information : (3, 3)
        Of the plane's shift at the corner along its normal (m) and of its two tilts about the corner (rad).
    gradient : (3,)
        Pull of the residuals on these three.
    returns
        How many returns carry weight.
    """

    information: FloatArray
    gradient: FloatArray
    returns: float


@dataclass(frozen=True, eq=False)
class CornerState:
    """The unknowns: pose, normals (3, 3) in the LiDAR frame, scale, and the world coordinates' errors (P, 3)."""

    T_world_lidar: Pose
    normals: FloatArray
    scale: float
    world_errors: FloatArray

    def corners(self, world: FloatArray) -> FloatArray:
        """The corners (P, 3) in the LiDAR frame."""
        return np.asarray(self.T_world_lidar.inverse() @ (world + self.world_errors)) / self.scale


@dataclass(frozen=True, eq=False)
class CornerFit:
    """The joint estimate and its evidence.

    Attributes
    ----------
    covariance : (n, n)
        Of all parameters in the order of `names`: pose (left perturbation), scale if estimated, normals' tilts, errors
        of the world coordinates if they are uncertain.
    range_sigma_m
        Noise of the ranges as the residuals show it.
    systems
        By (place, face): the collapsed systems at the solution.
    loss_factor
        What the loss costs: the covariance over the inverse of the information with weights.
    variance
        By (place, face): the variance of a face's returns over that of the range noise, where it is not one.
    """

    state: CornerState
    names: tuple[str, ...]
    covariance: FloatArray
    range_sigma_m: float
    systems: Mapping[tuple[int, int], FaceSystem]
    world: FloatArray
    world_sigma_m: float
    steps: int
    returns: int
    loss_factor: float = 1.0
    variance: Mapping[tuple[int, int], float] = field(default_factory=dict)

    @property
    def options(self) -> CornerOptions:
        """What was estimated."""
        return CornerOptions(self.world_sigma_m, "log_scale" in self.names)

    @cached_property
    def discrepancies(self) -> tuple[FloatArray, FloatArray, BoolArray]:
        """See `place_discrepancies`."""
        return place_discrepancies(self)

    @property
    def pose_covariance(self) -> FloatArray:
        """(6, 6) of T_world_lidar's left perturbation."""
        return self.covariance[:6, :6]


@dataclass(frozen=True)
class CornerOptions:
    """What is estimated: the scale if `estimate_scale`; world errors if `world_sigma_m` is above zero."""

    world_sigma_m: float = 0.0
    estimate_scale: bool = False


@dataclass(eq=False)
class _Face:
    place: int
    face: int
    returns: FaceReturns
    residual: FloatArray = field(default_factory=lambda: np.zeros(0))


def tangents(normal: FloatArray) -> FloatArray:
    """Two unit directions (3, 2) across a normal, along which its tilts are counted."""
    return _tangents(*normal.tolist())


@lru_cache(maxsize=64)
def _tangents(x: float, y: float, z: float) -> FloatArray:
    """All places share three normals, and each asks for them at each step."""
    pair = np.column_stack(perpendicular_pair((x, y, z)))
    pair.setflags(write=False)
    return pair


@lru_cache(maxsize=64)
def _axes(x: float, y: float, z: float) -> FloatArray:
    """A normal and its tangents as rows (3, 3)."""
    axes = np.vstack([(x, y, z), _tangents(x, y, z).T])
    axes.setflags(write=False)
    return axes


def face_residuals(returns: FaceReturns, normal: FloatArray, corner: FloatArray) -> FloatArray:
    """Measured minus expected ranges (N,), metres."""
    return np.asarray(returns.range_m - (normal @ corner) / (normal @ returns.rays))


def direction_grid(rays: FloatArray, cell_rad: float) -> IntArray:
    """Row and column (2, N), from 0, of rays (3, N) in a grid of angles about the bundle's middle."""
    local = np.linalg.svd(rays.mean(axis=1)[None])[2] @ rays
    angles = local[1:]
    angles /= np.maximum(np.abs(local[0]), 1e-12)
    np.arctan(angles, out=angles)
    angles *= 1.0 / cell_rad
    angles -= np.floor(angles.min(axis=1, keepdims=True))
    # Counted from 0 on: what is cut off is the fraction.
    return np.asarray(angles.astype(np.int64))


def direction_cells(rays: FloatArray, cell_rad: float) -> IntArray:
    """Which cell (N,) of `direction_grid` each ray (3, N) falls in, those that hold any counted from 0."""
    grid = direction_grid(rays, cell_rad)
    flat = grid[0] * (int(grid[1].max()) + 1) + grid[1]
    number = np.cumsum(np.bincount(flat) > 0) - 1
    return np.asarray(number[flat], dtype=np.int64)


def face_rows(rays: FloatArray, normal: FloatArray, corner: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Expected ranges (N,), and their derivatives (3, N) by the plane's shift and two tilts about the corner."""
    axes = _axes(*normal.tolist())
    rows = axes @ rays
    along = axes @ corner
    shift, tilts = np.divide(1.0, rows[0], out=rows[0]), rows[1:]
    expected = along[0] * shift
    tilts *= expected
    np.subtract(along[1:, None], tilts, out=tilts)
    tilts *= shift
    return expected, rows


def _weights(residual: FloatArray, sigma_m: float) -> FloatArray:
    """Tukey's weight psi(r)/r of residuals (N,)."""
    z2 = residual * (1.0 / (TUKEY_K * sigma_m))
    z2 *= z2
    np.subtract(1.0, z2, out=z2)
    np.maximum(z2, 0.0, out=z2)
    z2 *= z2
    return z2


def _system(face: _Face, normal: FloatArray, corner: FloatArray, sigma_m: float) -> FaceSystem:
    face.residual, rows, weight = weighted_rows(face.returns, normal, corner, sigma_m)
    weighted = rows * weight
    return FaceSystem(weighted @ rows.T, weighted @ face.residual, float(weight.sum()) * sigma_m**2)


def weighted_rows(
    returns: FaceReturns, normal: FloatArray, corner: FloatArray, sigma_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Measured minus expected ranges (N,), the derivatives (3, N) of the expected ones by the plane's shift and its two
    tilts about the corner, and the weights (N,), one over the noise squared times the loss's own."""
    expected, rows = face_rows(returns.rays, normal, corner)
    residual = returns.range_m - expected
    weight = _weights(residual, sigma_m)
    weight *= 1.0 / sigma_m**2
    return residual, rows, weight


def _some(returns: FaceReturns) -> FaceReturns:
    """About a thousand of the returns: enough for a first scale."""
    step = len(returns) // ENOUGH
    return returns if step < 2 else returns.subset(np.arange(0, len(returns), step))


def _wide_enough(sigma_m: float, residuals: Sequence[FloatArray]) -> float:
    """A first scale under which a poor start loses no face: the loss narrows as the fit improves."""
    return max(sigma_m, MIN_SIGMA_M, *(mad_sigma(r, centred=True) for r in residuals))


@dataclass(frozen=True, eq=False)
class FreeCorner:
    """Three free planes at one place: corner (3,), normals (3, 3), range noise, information (3, 2, 2) of the tilts."""

    corner: FloatArray
    normals: FloatArray
    sigma_m: float
    tilt_information: FloatArray

    def turn_statistic(self, normals: FloatArray) -> tuple[float, float]:
        """How far other normals (3, 3) are: the largest tilt in radians, and a chi-square of six degrees of freedom."""
        total, worst = 0.0, 0.0
        for own, other, information in zip(self.normals, normals, self.tilt_information, strict=True):
            tilt = tangents(own).T @ (other - own)
            worst = max(worst, float(np.linalg.norm(tilt)))
            total += float(tilt @ information @ tilt)
        return worst, total


def fit_corner(
    faces: Mapping[int, FaceReturns],
    normals: FloatArray,
    corner: FloatArray,
    sigma_m: float,
    *,
    tolerance_m: float = 1e-7,
) -> FreeCorner:
    """Three free planes through one place's returns.

    Parameters
    ----------
    faces
        Returns of all three faces.
    normals, corner, sigma_m
        Where to start.
    tolerance_m
        The last step of the corner.

    Raises
    ------
    UndeterminedError
        If a face's returns do not determine its plane.
    """
    first = [face_residuals(faces[j], normals[j], corner) for j in range(3)]
    sigma_m = _wide_enough(sigma_m, first)
    for _ in range(MAX_STEPS):
        residuals, moves, tilts = [], [], []
        for j in range(3):
            face = _Face(0, j, faces[j])
            system = _system(face, normals[j], corner, sigma_m)
            residuals.append(face.residual)
            tilts.append(_without_first(system.information))
            moves.append(_solve(system.information, system.gradient, f"face {j + 1} of the target"))
        tilted = np.stack([unit(n + tangents(n) @ m[1:]) for n, m in zip(normals, moves, strict=True)])
        shift = np.linalg.solve(tilted, [m[0] for m in moves])
        normals, corner = tilted, corner + shift
        sigma_m = max(mad_sigma(np.concatenate(residuals), centred=True), MIN_SIGMA_M)
        if np.linalg.norm(shift) < tolerance_m:
            break
    return FreeCorner(corner, normals, sigma_m, np.stack(tilts))


def _without_first(information: FloatArray) -> FloatArray:
    """Information (2, 2) of the last two of three unknowns, the first being free."""
    cross = information[1:, 0]
    return np.asarray(information[1:, 1:] - np.outer(cross, cross) / max(float(information[0, 0]), 1e-300))


def _solve(information: FloatArray, gradient: FloatArray, what: str) -> FloatArray:
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(scale, scale)
    if not np.all(np.isfinite(scaled)) or np.linalg.eigvalsh(scaled)[0] < 1e-10:
        raise UndeterminedError(
            f"the returns do not determine {what}",
            remedy="Bring the target nearer, or turn it so that several scan lines cross each face.",
        )
    return np.asarray(np.linalg.solve(scaled, gradient / scale) / scale)


def fit_corner_model(
    places: Sequence[CornerPlaceFaces],
    start: CornerState,
    sigma_m: float,
    options: CornerOptions | None = None,
    *,
    settled: float = SETTLED,
) -> CornerFit:
    """The joint estimate.

    Parameters
    ----------
    places
        Returns of the faces at each place; a face may be missing at some places.
    start
        Where to start: the closed forms' result.
    sigma_m
        A first guess of the range noise; it is estimated with the rest.
    settled
        What may be left to go after the last step, in standard deviations of the estimate, whatever the unit of each
        parameter.

    Raises
    ------
    UndeterminedError
        If the places do not determine the pose.
    """
    options = options or CornerOptions()
    world = np.stack([p.corner_world for p in places])
    faces = [_Face(i, j, f) for i, p in enumerate(places) for j, f in sorted(p.faces.items()) if len(f) >= MIN_RETURNS]
    names = parameter_names([p.position for p in places], options)
    corners = start.corners(world)
    first = [face_residuals(_some(f.returns), start.normals[f.face], corners[f.place]) for f in faces]
    sigma_m = _wide_enough(sigma_m, first)
    state, step, length = start, 0, np.inf
    for step in range(1, MAX_STEPS + 1):
        information, gradient, systems = _assemble(faces, state, world, sigma_m, options)
        delta = _solve(information, gradient, "the pose: too few places, or all on one line") / FOLLOWED
        state = _moved(state, delta, options)
        residuals = np.concatenate([f.residual for f in faces])
        sigma_m = max(mad_sigma(residuals, centred=True), MIN_SIGMA_M)
        before, length = length, float(np.sqrt(delta @ information @ delta))
        # Steps shrink by about as much each time.
        if step > 1 and length * min(length / before, 1.0) < settled:
            break
    information, _, systems = _assemble(faces, state, world, sigma_m, options)
    loss_factor = _loss_factor(np.concatenate([f.residual for f in faces]), sigma_m)
    return CornerFit(
        state,
        names,
        np.linalg.inv(information) * loss_factor,
        sigma_m,
        systems,
        world,
        options.world_sigma_m,
        step,
        sum(len(f.returns) for f in faces),
        loss_factor,
    )


def _loss_factor(residual: FloatArray, sigma_m: float) -> float:
    """What the loss costs: the M-estimate's variance over that of the information with weights."""
    # Of z, the residual over where weights end, and v = 1 - z^2: the weight is v^2, psi^2 is K^2 z^2 v^4, its slope
    # v (1 - 5 z^2) = 5 v^2 - 4 v. All are 0 where v is.
    v = residual * (1.0 / (TUKEY_K * sigma_m))
    v *= v
    np.subtract(1.0, v, out=v)
    np.maximum(v, 0.0, out=v)
    v2 = v * v
    first, second, fourth = float(v.sum()), float(v2.sum()), float(v2 @ v2)
    v2 *= v
    fifth = float(v2 @ (v * v))
    used = np.count_nonzero(v)
    psi2 = TUKEY_K**2 * (fourth - fifth)
    return psi2 * second / (5.0 * second - 4.0 * first) ** 2 if used else float("nan")


def parameter_names(positions: Sequence[str], options: CornerOptions) -> tuple[str, ...]:
    """Names of the estimate's parameters, in order."""
    names = [f"T_world_lidar.{k}" for k in ("tx_m", "ty_m", "tz_m", "rx_rad", "ry_rad", "rz_rad")]
    if options.estimate_scale:
        names.append("log_scale")
    names += [f"face_{j}.tilt_{k}_rad" for j in range(3) for k in "uv"]
    if options.world_sigma_m > 0.0:
        names += [f"{p}.world_{k}_m" for p in positions for k in "xyz"]
    return tuple(names)


def _columns(count: int, options: CornerOptions) -> tuple[int, int, int]:
    """Where the normals' tilts and the world errors begin, and how many parameters there are."""
    tilts = 7 if options.estimate_scale else 6
    errors = tilts + 6
    return tilts, errors, errors + (3 * count if options.world_sigma_m > 0.0 else 0)


def _corner_jacobians(state: CornerState, world: FloatArray, corners: FloatArray, options: CornerOptions) -> FloatArray:
    """Derivatives (P, 3, n) of the places' corners in the LiDAR frame by the parameters."""
    _, errors, width = _columns(len(world), options)
    Rt = state.T_world_lidar.rotation.T / state.scale
    J = np.zeros((len(world), 3, width))
    J[:, :, :3] = -Rt
    J[:, :, 3:6] = Rt @ skew(world + state.world_errors)
    if options.estimate_scale:
        J[:, :, 6] = -corners
    if options.world_sigma_m > 0.0:
        for i in range(len(world)):
            J[i, :, errors + 3 * i : errors + 3 * i + 3] = Rt
    return J


def _assemble(
    faces: Sequence[_Face], state: CornerState, world: FloatArray, sigma_m: float, options: CornerOptions
) -> tuple[FloatArray, FloatArray, dict[tuple[int, int], FaceSystem]]:
    """The normal equations of the whole, and each face's own, at a state."""
    corners = state.corners(world)
    systems = {(f.place, f.face): _system(f, state.normals[f.face], corners[f.place], sigma_m) for f in faces}
    return *_joined(systems, state, world, options), systems


def face_jacobians(
    faces: Sequence[tuple[int, int]], state: CornerState, world: FloatArray, options: CornerOptions
) -> dict[tuple[int, int], FloatArray]:
    """By (place, face): the derivative (3, n) of the plane's shift and two tilts by the estimate's parameters."""
    return dict(zip(faces, _stacked_jacobians(faces, state, world, options), strict=True))


def _stacked_jacobians(
    faces: Sequence[tuple[int, int]], state: CornerState, world: FloatArray, options: CornerOptions
) -> FloatArray:
    """The derivatives of `face_jacobians` (K, 3, n), one face after the other."""
    tilts, _, width = _columns(len(world), options)
    place, face = np.array(faces, dtype=np.int64).reshape(-1, 2).T
    of_corner = _corner_jacobians(state, world, state.corners(world), options)
    B = np.zeros((len(faces), 3, width))
    B[:, :1] = state.normals[face][:, None] @ of_corner[place]
    row = np.arange(len(faces))
    B[row, 1, tilts + 2 * face] = B[row, 2, tilts + 2 * face + 1] = 1.0
    return B


def joint_information(fit: CornerFit, systems: Mapping[tuple[int, int], FaceSystem]) -> tuple[FloatArray, FloatArray]:
    """Information (n, n) and gradient (n,) of an estimate's parameters from other systems than its own."""
    return _joined(systems, fit.state, fit.world, fit.options)


def reweighted(fit: CornerFit, variance: Mapping[tuple[int, int], float]) -> CornerFit:
    """The estimate with the variance of faces' returns, by (place, face), multiplied: one step from its systems."""
    systems = {
        key: FaceSystem(s.information / variance.get(key, 1.0), s.gradient / variance.get(key, 1.0), s.returns)
        for key, s in fit.systems.items()
    }
    information, gradient = joint_information(fit, systems)
    delta = _solve(information, gradient, "the pose: too few places, or all on one line")
    jacobians = face_jacobians(list(systems), fit.state, fit.world, fit.options)
    moved = {
        key: replace(s, gradient=s.gradient - s.information @ (jacobians[key] @ delta)) for key, s in systems.items()
    }
    return replace(
        fit,
        state=_moved(fit.state, delta, fit.options),
        covariance=np.linalg.inv(information) * fit.loss_factor,
        systems=moved,
        variance=variance,
    )


def _joined(
    systems: Mapping[tuple[int, int], FaceSystem], state: CornerState, world: FloatArray, options: CornerOptions
) -> tuple[FloatArray, FloatArray]:
    """The normal equations of the whole, from each face's own."""
    _, errors, width = _columns(len(world), options)
    B = _stacked_jacobians(list(systems), state, world, options)
    rows = B.reshape(-1, width)
    information = rows.T @ (np.array([s.information for s in systems.values()]) @ B).reshape(-1, width)
    gradient = rows.T @ np.concatenate([s.gradient for s in systems.values()])
    if options.world_sigma_m > 0.0:
        prior = 1.0 / options.world_sigma_m**2
        information[errors:, errors:] += prior * np.eye(width - errors)
        gradient[errors:] -= prior * state.world_errors.ravel()
    return information, gradient


def _moved(state: CornerState, delta: FloatArray, options: CornerOptions) -> CornerState:
    tilts, errors, _ = _columns(len(state.world_errors), options)
    normals = np.stack(
        [unit(n + tangents(n) @ delta[tilts + 2 * j : tilts + 2 * j + 2]) for j, n in enumerate(state.normals)]
    )
    moved = replace(
        state,
        T_world_lidar=Pose(
            _exact(exp_so3(delta[3:6]) @ state.T_world_lidar.rotation),
            Pose.exp(delta[:6]) @ state.T_world_lidar.translation,
        ),
        normals=normals,
    )
    if options.estimate_scale:
        moved = replace(moved, scale=float(state.scale * np.exp(delta[6])))
    if options.world_sigma_m > 0.0:
        moved = replace(moved, world_errors=state.world_errors + delta[errors:].reshape(-1, 3))
    return moved


def _exact(rotation: FloatArray) -> FloatArray:
    U, _, Vt = np.linalg.svd(rotation)
    return np.asarray(U @ Vt)


_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_PAIR_OF = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def frame_corners(
    faces: Mapping[int, FaceReturns], normals: FloatArray, corner: FloatArray, frames: int, sigma_m: float
) -> FloatArray:
    """The corner (F, 3) of each frame alone, three free planes each; NaN where a frame's returns determine none.

    One step from the place's common planes, of which a frame differs by its noise alone.
    """
    moves = np.full((frames, 3, 3), np.nan)
    for j in range(3):
        f = faces[j]
        residual, rows, weight = weighted_rows(f, normals[j], corner, sigma_m)
        weighted = weight * rows
        # Where each frame that is there begins: returns come frame by frame.
        first = np.flatnonzero(np.diff(f.frame, prepend=-1))
        there = f.frame[first]
        sums = np.add.reduceat(np.stack([weighted[a] * rows[b] for a, b in _PAIRS]), first, axis=1)
        H = sums[_PAIR_OF].transpose(2, 0, 1)
        g = np.add.reduceat(weighted * residual, first, axis=1).T
        enough = np.add.reduceat((weight > 0.0).astype(np.int64), first) >= 6
        scaled = H * sigma_m**2 + 1e-12 * np.eye(3)
        good = enough & (np.linalg.cond(scaled) < 1e9)
        moves[there[good], j] = np.linalg.solve(H[good], g[good][..., None])[..., 0]
    tilted = np.stack([normals[j] + moves[:, j, 1:] @ tangents(normals[j]).T for j in range(3)], axis=1)
    corners = np.full((frames, 3), np.nan)
    good = np.isfinite(tilted).all(axis=(1, 2))
    good[good] = np.abs(np.linalg.det(tilted[good])) > 1e-3
    corners[good] = corner + np.linalg.solve(tilted[good], moves[good, :, 0][..., None])[..., 0]
    return corners


def place_discrepancies(fit: CornerFit) -> tuple[FloatArray, FloatArray, BoolArray]:
    """How each place by itself would move and turn the target against the joint estimate.

    Returns
    -------
    Shift (m) and turn (rad) in the LiDAR frame (P, 6); the turn's chi-square statistic (P,), of three degrees
    of freedom; and which places (P,) determine all six numbers.
    """
    count = len(fit.world)
    moves = np.zeros((count, 6))
    statistic, known = np.zeros(count), np.zeros(count, dtype=bool)
    for i in range(count):
        H, g = np.zeros((6, 6)), np.zeros(6)
        for j in range(3):
            system = fit.systems.get((i, j))
            if system is None:
                continue
            normal = fit.state.normals[j]
            B = np.zeros((3, 6))
            B[0, :3] = normal
            B[1:, 3:] = tangents(normal).T @ -skew(normal)
            H += B.T @ system.information @ B
            g += B.T @ system.gradient
        scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
        if np.linalg.eigvalsh(H / np.outer(scale, scale))[0] < 1e-6:
            continue
        covariance = np.linalg.inv(H)
        moves[i] = covariance @ g
        statistic[i] = float(moves[i, 3:] @ np.linalg.solve(covariance[3:, 3:], moves[i, 3:]))
        known[i] = True
    return moves, statistic, known


def own_turns(fit: CornerFit) -> dict[int, tuple[float, float]]:
    """By place with three faces: how far its own planes are tilted against the common ones, at most, in radians, and
    a chi-square of six degrees of freedom. One step from the common planes, on all returns that met them."""
    found = {}
    for place in range(len(fit.world)):
        systems = [fit.systems.get((place, j)) for j in range(3)]
        tilts, total = [], 0.0
        for system in systems:
            if system is None:
                break
            try:
                tilt = _solve(system.information, system.gradient, "a face")[1:]
            except UndeterminedError:
                break
            tilts.append(float(np.linalg.norm(tilt)))
            total += float(tilt @ _without_first(system.information) @ tilt)
        if len(tilts) == 3:
            found[place] = max(tilts), total
    return found


def without_world_noise(fit: CornerFit) -> tuple[FloatArray, FloatArray, int]:
    """Normal equations at the joint estimate with the world's coordinates as they are given, their errors free.

    Returns
    -------
    Information (n, n) and gradient (n,) without what the world's noise says of its errors, and where those begin.
    """
    options = CornerOptions(1.0, "log_scale" in fit.names)
    state = replace(fit.state, world_errors=np.zeros_like(fit.world))
    information, gradient = _joined(fit.systems, state, fit.world, options)
    errors = _columns(len(fit.world), options)[1]
    information[errors:, errors:] -= np.eye(len(gradient) - errors)
    # The faces' own systems stand where the estimate's errors put their corners.
    return information, gradient + information[:, errors:] @ fit.state.world_errors.ravel(), errors


def estimate_world_sigma(fit: CornerFit) -> tuple[float, float]:
    """How well the world coordinates seem to be measured: restricted maximum likelihood on the collapsed systems.

    Parameters
    ----------
    fit
        The joint estimate that took them for exact.

    Returns
    -------
    The standard deviation in metres (0 where nothing speaks against exact ones), and twice the gain in log likelihood.
    """
    options = CornerOptions(1.0, "log_scale" in fit.names)
    state = replace(fit.state, world_errors=np.zeros_like(fit.world))
    information, gradient = _joined(fit.systems, state, fit.world, options)
    errors = _columns(len(fit.world), options)[1]
    size = len(gradient) - errors
    # Of the errors alone, all else being free, along axes on which they are independent.
    solved = np.linalg.solve(
        information[:errors, :errors], np.column_stack([information[:errors, errors:], gradient[:errors]])
    )
    own = information[errors:, errors:] - np.eye(size) - information[errors:, :errors] @ solved[:, :-1]
    sureness, axes = np.linalg.eigh(0.5 * (own + own.T))
    along = (axes.T @ (gradient[errors:] - information[errors:, :errors] @ solved[:, -1])) ** 2
    grid = np.geomspace(1e-5, 0.5, 60)
    variance = grid[:, None] ** 2
    grown = 1.0 + variance * np.maximum(sureness, 0.0)
    values = (np.log(grown) - variance * along / grown).sum(axis=1)
    best = int(np.argmin(values))
    gain = float(values[0] - values[best])
    return (float(grid[best]), gain) if gain > 0.5 else (0.0, 0.0)
