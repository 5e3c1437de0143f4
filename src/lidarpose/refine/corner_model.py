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
from functools import cached_property

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, unit
from lidarpose.geometry.robust import mad_sigma
from lidarpose.geometry.se3 import Pose, exp_so3, skew
from lidarpose.model.corner_result import CornerPlaceFaces, FaceReturns
from lidarpose.refine.face_systems import (
    FOLLOWED,
    LEAST_TOLD,
    MAX_STEPS,
    MIN_RETURNS,
    MIN_SIGMA_M,
    FaceSystem,
    face_sums,
    loss_factor,
    solved,
    some_residuals,
    tangents,
    wide_enough,
)

# What is left to go after the last step, in standard deviations.
SETTLED = 1e-3
# The share of the way that a first step leaves, at most: a hundredth where the noise is normal, and known.
FIRST_LEFT = 0.05


# How well people measure a target's corner by tape or total station, where they do not say.
EXPECTED_WORLD_SIGMA_M = 1e-3
_POSE = "the pose: too few places, or all on one line"


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

    @cached_property
    def world_sigma_likelihood(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The restricted likelihood of the standard deviation of the world's coordinates.

        Returns
        -------
        A grid (G,) of it in metres, even in the logarithm; minus twice the log likelihood (G,); and the derivatives
        (n, 3P) of the other parameters by the coordinates' errors.
        """
        return _world_sigma_likelihood(self)

    @property
    def pose_covariance(self) -> FloatArray:
        """(6, 6) of T_world_lidar's left perturbation."""
        return self.covariance[:6, :6]


@dataclass(frozen=True)
class CornerOptions:
    """What is estimated: the scale if `estimate_scale`; world errors if `world_sigma_m` is above zero."""

    world_sigma_m: float = 0.0
    estimate_scale: bool = False


def fit_corner_model(
    places: Sequence[CornerPlaceFaces],
    start: CornerState,
    sigma_m: float,
    options: CornerOptions | None = None,
    *,
    settled: float = SETTLED,
    near: bool = False,
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
    near
        Start and noise are an estimate's from most of these returns: what is far from it is none of the faces.

    Raises
    ------
    UndeterminedError
        If the places do not determine the pose.
    """
    options = options or CornerOptions()
    world = np.stack([p.corner_world for p in places])
    faces = {(i, j): f for i, p in enumerate(places) for j, f in sorted(p.faces.items()) if len(f) >= MIN_RETURNS}
    if not near:
        sigma_m = _wide_start(faces, start, world, sigma_m)
    state, step, length = start, 0, np.inf
    for step in range(1, MAX_STEPS + 1):
        systems, residual = _collapsed(faces, state, world, sigma_m)
        jacobians = _stacked_jacobians(list(systems), state, world, options)
        information, gradient = _joined(systems, state, world, options, jacobians)
        delta = solved(information, gradient, _POSE) / FOLLOWED
        moves = jacobians @ delta
        state = _moved(state, delta, options)
        used_m, sigma_m = sigma_m, max(mad_sigma(residual, centred=True, near=sigma_m), MIN_SIGMA_M)
        before, length = length, float(np.sqrt(delta @ information @ delta))
        # Steps shrink by about as much each time.
        if length * (min(length / before, 1.0) if step > 1 else FIRST_LEFT) < settled:
            break
    # What has been left is too little for another pass over all returns.
    scale = (used_m / sigma_m) ** 2
    systems = {k: s.scaled(scale).after(FOLLOWED * m) for (k, s), m in zip(systems.items(), moves, strict=True)}
    information, _ = _joined(systems, state, world, options)
    lost = loss_factor(residual, sigma_m)
    return CornerFit(
        state,
        parameter_names([p.position for p in places], options),
        np.linalg.inv(information) * lost,
        sigma_m,
        systems,
        world,
        options.world_sigma_m,
        step,
        len(residual),
        lost,
    )


def _wide_start(
    faces: Mapping[tuple[int, int], FaceReturns], start: CornerState, world: FloatArray, sigma_m: float
) -> float:
    """A first scale under which a poor start loses no face, by some returns of each."""
    corners = start.corners(world)
    return wide_enough(sigma_m, [some_residuals(f, start.normals[j], corners[i]) for (i, j), f in faces.items()])


def _collapsed(
    faces: Mapping[tuple[int, int], FaceReturns], state: CornerState, world: FloatArray, sigma_m: float
) -> tuple[dict[tuple[int, int], FaceSystem], FloatArray]:
    """Each face's own system at a state, and the residuals of all returns."""
    corners = state.corners(world)
    sums = {(i, j): face_sums(f, state.normals[j], corners[i], sigma_m) for (i, j), f in faces.items()}
    return {k: s.system for k, s in sums.items()}, np.concatenate([s.residual for s in sums.values()])


def stepped(fit: CornerFit, systems: Mapping[tuple[int, int], FaceSystem]) -> tuple[CornerState, float]:
    """Where other systems at an estimate move its state by one step, whose length is told in standard deviations."""
    information, gradient = joint_information(fit, systems)
    delta = solved(information, gradient, _POSE) / FOLLOWED
    return _moved(fit.state, delta, fit.options), float(np.sqrt(delta @ information @ delta))


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
    systems = {key: s.scaled(1.0 / variance.get(key, 1.0)) for key, s in fit.systems.items()}
    information, gradient = joint_information(fit, systems)
    delta = solved(information, gradient, _POSE)
    jacobians = face_jacobians(list(systems), fit.state, fit.world, fit.options)
    moved = {key: s.after(jacobians[key] @ delta) for key, s in systems.items()}
    return replace(
        fit,
        state=_moved(fit.state, delta, fit.options),
        covariance=np.linalg.inv(information) * fit.loss_factor,
        systems=moved,
        variance=variance,
    )


def _joined(
    systems: Mapping[tuple[int, int], FaceSystem],
    state: CornerState,
    world: FloatArray,
    options: CornerOptions,
    jacobians: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """The normal equations of the whole, from each face's own, and their `_stacked_jacobians`."""
    _, errors, width = _columns(len(world), options)
    B = _stacked_jacobians(list(systems), state, world, options) if jacobians is None else jacobians
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
    places = [p for p in range(len(fit.world)) if all((p, j) in fit.systems for j in range(3))]
    systems = [fit.systems[p, j] for p in places for j in range(3)]
    if not systems:
        return {}
    information = np.array([system.information for system in systems])
    gradient = np.array([system.gradient for system in systems])
    # As `solved` has it, for all faces together.
    scale = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), 1e-300))
    scaled = information / (scale[:, :, None] * scale[:, None, :])
    told = np.isfinite(scaled).all(axis=(1, 2))
    scaled[~told] = np.eye(3)
    told &= np.linalg.eigvalsh(scaled)[:, 0] >= LEAST_TOLD
    scaled[~told] = np.eye(3)
    tilt = (np.linalg.solve(scaled, (gradient / scale)[..., None])[..., 0] / scale)[:, 1:]
    cross = information[:, 1:, 0]
    free = information[:, 1:, 1:] - cross[:, :, None] * (cross / np.maximum(information[:, :1, 0], 1e-300))[:, None, :]
    statistic = np.einsum("ki,kij,kj->k", tilt, free, tilt).reshape(-1, 3)
    largest = np.linalg.norm(tilt, axis=1).reshape(-1, 3).max(axis=1)
    known = told.reshape(-1, 3).all(axis=1)
    turns = zip(largest.tolist(), statistic.sum(axis=1).tolist(), strict=True)
    return {place: turn for place, turn, good in zip(places, turns, known, strict=True) if good}


def corner_covariances(fit: CornerFit) -> FloatArray:
    """Covariances (P, 3, 3) of the places' corners in the LiDAR frame."""
    J = _corner_jacobians(fit.state, fit.world, fit.state.corners(fit.world), fit.options)
    return np.asarray(J @ fit.covariance @ J.transpose(0, 2, 1))


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
        The joint estimate that took them for exact, or one that left them free where that fits too few returns.

    Returns
    -------
    The standard deviation in metres (0 where nothing speaks against exact ones), and twice the gain in log likelihood.
    """
    grid, values, _ = fit.world_sigma_likelihood
    best = int(np.argmin(values))
    gain = float(values[0] - values[best])
    return (float(grid[best]), gain) if gain > 0.5 else (0.0, 0.0)


def undetected_world_noise(fit: CornerFit) -> FloatArray:
    """What to add to the covariance where nobody says how well the world was measured, and the data do not tell.

    No sign of noise is no proof of exact coordinates: three places leave three residuals. Beforehand the standard
    deviation is taken to be about a millimetre, its density ``(1 + sigma^2 / expected^2)^-2``, of which the mean square
    is the expected one. Its mean square by the likelihood of the data, times what errors of the coordinates do to an
    estimate that takes them for exact, is the variance that such an estimate leaves out.

    Parameters
    ----------
    fit
        The joint estimate that took the coordinates for exact.

    Returns
    -------
    Covariance (n, n) in the order of `fit.names`.
    """
    grid, values, followed = fit.world_sigma_likelihood
    # The grid is even in the logarithm of sigma: each step stands for a width that grows as sigma.
    log_weight = -0.5 * values - 2.0 * np.log1p((grid / EXPECTED_WORLD_SIGMA_M) ** 2) + np.log(grid)
    weight = np.exp(log_weight - log_weight.max())
    return np.asarray(float(weight @ grid**2 / weight.sum()) * (followed @ followed.T))


def _world_sigma_likelihood(fit: CornerFit) -> tuple[FloatArray, FloatArray, FloatArray]:
    information, gradient, errors = without_world_noise(fit)
    # Of the errors alone, all else being free, along axes on which they are independent.
    solved = np.linalg.solve(
        information[:errors, :errors], np.column_stack([information[:errors, errors:], gradient[:errors]])
    )
    own = information[errors:, errors:] - information[errors:, :errors] @ solved[:, :-1]
    sureness, axes = np.linalg.eigh(0.5 * (own + own.T))
    along = (axes.T @ (gradient[errors:] - information[errors:, :errors] @ solved[:, -1])) ** 2
    grid = np.geomspace(1e-5, 0.5, 60)
    variance = grid[:, None] ** 2
    grown = 1.0 + variance * np.maximum(sureness, 0.0)
    values = (np.log(grown) - variance * along / grown).sum(axis=1)
    return grid, values, -solved[:, :-1]
