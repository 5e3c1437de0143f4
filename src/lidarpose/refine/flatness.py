"""How a 2D LiDAR sits on its turntable, from flat surfaces in its own scan: no target, no camera, no right angle.

A wrong mounting bends what is flat: with the zero of the beam angles off, a ceiling becomes a cone; with the fan turned
out of the axis, walls are twisted; with the LiDAR beside the axis, they bulge. Unknown are two tilts and two shifts of
the LiDAR, each surface's plane, and what else was asked for. Compared are ranges along their beams. The turn about the
axis and the height along it leave every plane flat: they are the choice of the table's frame.

The idea is that of point-to-plane self-calibration of actuated scanners (Alismail and Browning, "Automatic calibration
of spinning actuated lidar internal parameters", J. Field Robotics 32, 2015). Normal equations are reduced by each
surface's own three numbers. The covariance is that of scores summed over patches of the surfaces (Liang and Zeger,
1986): neighbouring returns share what the wall is off by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, perpendicular_pair
from lidarpose.geometry.planes import Plane, fit_plane
from lidarpose.geometry.robust import mad_sigma
from lidarpose.geometry.se3 import Pose, exp_so3, nearest_rotation, rotation_z
from lidarpose.model.spun_scan import FlatReturns
from lidarpose.refine.noise import CORE, REJECT, taper_weights

MOUNTING_NAMES = ("rx_rad", "ry_rad", "x_m", "y_m")
EXTRA_NAMES = ("encoder_scale", "range_offset_m", "beam_angle_scale")
"""As in `lidarpose.refine.turntable_parameters`."""
N_MOUNTING = len(MOUNTING_NAMES)
N_ALL = N_MOUNTING + len(EXTRA_NAMES)
# Returns whose beam meets the surface at less than this (sine) tell of its edge and its dirt.
GRAZING = 0.1
# A surface's noise counts as at least this share of that of the typical one.
LEAST_SIGMA_SHARE = 0.4
# Patches over which errors count as common: this wide in reading and beam angle.
PATCH_RAD = np.radians(10.0)
# Where a surface alone tells a parameter, or next to nothing of it, nothing can be compared.
OWN_SHARE = 0.02


@dataclass(frozen=True, eq=False)
class SpunState:
    """Where the estimate stands: the mounting, the extra parameters (3,), the surfaces in the table's frame."""

    T_table_lidar: Pose
    extras: FloatArray
    planes: tuple[Plane, ...]

    def moved(self, step: FloatArray, planes: tuple[Plane, ...]) -> SpunState:
        """After a step (N_ALL,) of mounting and extras, with new planes."""
        pose = self.T_table_lidar
        rotation = exp_so3(np.array([step[0], step[1], 0.0])) @ pose.rotation
        shift = pose.translation + np.array([step[2], step[3], 0.0])
        return SpunState(Pose(nearest_rotation(rotation), shift), self.extras + step[N_MOUNTING:], planes)


@dataclass(frozen=True, eq=False)
class Linearised:
    """Residuals (n,), measured less predicted ranges, and the prediction's derivatives.

    `by_all` (n, N_ALL) by mounting and extras, `by_plane` (n, 3) by the surface's two tilts about its middle and its
    offset, `by_reading` (n,) by the reading alone. `usable` (n,) is False for grazing beams. `frames` (K, 3, 3) holds
    each surface's middle and two axes.
    """

    residual: FloatArray
    by_all: FloatArray
    by_plane: FloatArray
    by_reading: FloatArray
    usable: BoolArray
    frames: FloatArray


@dataclass(frozen=True, eq=False)
class Reduced:
    """Normal equations of each surface with its own plane taken out: (K, N_ALL, N_ALL) and (K, N_ALL).

    `to_plane` (K, 3, N_ALL) and `plane_step` (K, 3): the plane's step is plane_step - to_plane @ step.
    """

    information: FloatArray
    gradient: FloatArray
    to_plane: FloatArray
    plane_step: FloatArray


def points_in_table(
    T_table_lidar: Pose,
    extras: FloatArray,
    origin_rad: float,
    reading_rad: FloatArray,
    beam_rad: FloatArray,
    range_m: FloatArray,
) -> FloatArray:
    """Points (n, 3) of returns in the table's frame."""
    theta = (1.0 + extras[2]) * beam_rad
    direction = np.stack([np.cos(theta), np.sin(theta), np.zeros_like(theta)], -1) @ T_table_lidar.rotation.T
    p = (range_m - extras[1])[:, None] * direction + T_table_lidar.translation
    psi = reading_rad + extras[0] * (reading_rad - origin_rad)
    c, s = np.cos(psi), np.sin(psi)
    return np.stack([c * p[:, 0] - s * p[:, 1], s * p[:, 0] + c * p[:, 1], p[:, 2]], -1)


def start_state(returns: FlatReturns, T_table_lidar: Pose, extras: FloatArray, origin_rad: float) -> SpunState:
    """The state of a start, with planes fitted to the points as it puts them."""
    points = points_in_table(T_table_lidar, extras, origin_rad, returns.reading_rad, returns.beam_rad, returns.range_m)
    planes = tuple(fit_plane(points[returns.surface == k]) for k in range(returns.surfaces))
    return SpunState(T_table_lidar, extras, planes)


def linearise(state: SpunState, returns: FlatReturns, origin_rad: float) -> Linearised:
    """Residuals and derivatives at a state."""
    theta = (1.0 + state.extras[2]) * returns.beam_rad
    c, s = np.cos(theta)[:, None], np.sin(theta)[:, None]
    x, y, _ = state.T_table_lidar.rotation.T
    direction, across = c * x + s * y, c * y - s * x
    t = state.T_table_lidar.translation
    away = returns.reading_rad - origin_rad
    turn = rotation_z(returns.reading_rad + state.extras[0] * away)
    normals = np.stack([p.normal for p in state.planes])[returns.surface]
    offsets = np.array([p.offset for p in state.planes])[returns.surface]
    # The surface's normal as the table turns, so that all products are in the LiDAR's neighbourhood.
    n = np.einsum("nji,nj->ni", turn, normals)
    cosine = (n * direction).sum(axis=1)
    usable = np.abs(cosine) > GRAZING
    cosine = np.where(usable, cosine, 1.0)
    distance = (offsets - n @ t) / cosine
    usable &= distance > 0.0
    local = distance[:, None] * direction + t
    by_reading = -(n[:, 1] * local[:, 0] - n[:, 0] * local[:, 1]) / cosine
    by_all = np.empty((len(returns), N_ALL))
    by_all[:, :2] = -(distance / cosine)[:, None] * np.cross(direction, n)[:, :2]
    by_all[:, 2:4] = -n[:, :2] / cosine[:, None]
    by_all[:, 4] = by_reading * away
    by_all[:, 5] = 1.0
    by_all[:, 6] = -distance * (n * across).sum(axis=1) / cosine * returns.beam_rad
    by_plane, frames = _by_plane(state, returns.surface, np.einsum("nij,nj->ni", turn, local), cosine)
    residual = returns.range_m - distance - state.extras[1]
    return Linearised(np.where(usable, residual, 0.0), by_all, by_plane, by_reading, usable, frames)


def _by_plane(
    state: SpunState, surface: IntArray, hit: FloatArray, cosine: FloatArray
) -> tuple[FloatArray, FloatArray]:
    frames = np.empty((len(state.planes), 3, 3))
    for k, plane in enumerate(state.planes):
        frames[k] = np.stack([plane.project(hit[surface == k].mean(axis=0)), *perpendicular_pair(plane.normal)])
    here = hit - frames[surface, 0]
    tilts = np.einsum("nij,nj->ni", frames[surface, 1:], here)
    return np.column_stack([-tilts, np.ones(len(hit))]) / cosine[:, None], frames


def surface_sigmas(residual: FloatArray, usable: BoolArray, surface: IntArray, surfaces: int) -> FloatArray:
    """Robust spread (K,) of the ranges on each surface, not far below the typical one."""
    sigma = np.array([mad_sigma(residual[(surface == k) & usable], centred=True) for k in range(surfaces)])
    sigma = np.where(np.isfinite(sigma), sigma, np.inf)
    typical = float(np.median(sigma[surface[usable]])) if usable.any() else np.inf
    return np.asarray(np.maximum(sigma, max(LEAST_SIGMA_SHARE * typical, 1e-6)))


def weights_of(line: Linearised, returns: FlatReturns) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weights (n,) with each surface's noise and the loss in them, the loss' slopes (n,), and the sigmas (K,)."""
    sigma = surface_sigmas(line.residual, line.usable, returns.surface, returns.surfaces)
    z = line.residual / sigma[returns.surface]
    weight = np.where(line.usable, taper_weights(z), 0.0)
    tail = np.clip((np.abs(z) - CORE) / (REJECT - CORE), 0.0, 1.0)
    bend = 0.5 * np.pi * np.abs(z) / (REJECT - CORE) * np.sin(np.pi * tail)
    slope = np.where(line.usable, weight - np.where((tail > 0.0) & (tail < 1.0), bend, 0.0), 0.0)
    scale = 1.0 / sigma[returns.surface] ** 2
    return weight * scale, slope * scale, sigma


def reduce_surfaces(line: Linearised, returns: FlatReturns, weight: FloatArray) -> Reduced:
    """Weighted normal equations of each surface, its plane eliminated."""
    K = returns.surfaces
    information, gradient = np.zeros((K, N_ALL, N_ALL)), np.zeros((K, N_ALL))
    to_plane, plane_step = np.zeros((K, 3, N_ALL)), np.zeros((K, 3))
    for k in range(K):
        mine = returns.surface == k
        root = np.sqrt(weight[mine])[:, None]
        G = root * np.column_stack([line.by_all[mine], line.by_plane[mine], line.residual[mine]])
        H = G.T @ G
        a, q, r = slice(0, N_ALL), slice(N_ALL, N_ALL + 3), -1
        inverse = np.linalg.pinv(H[q, q], rcond=1e-12)
        to_plane[k], plane_step[k] = inverse @ H[q, a], inverse @ H[q, r]
        information[k] = H[a, a] - H[a, q] @ to_plane[k]
        gradient[k] = H[a, r] - H[a, q] @ plane_step[k]
    return Reduced(information, gradient, to_plane, plane_step)


@dataclass(frozen=True, eq=False)
class Solution:
    """Where Gauss and Newton ended."""

    state: SpunState
    line: Linearised
    weight: FloatArray
    slope: FloatArray
    sigma: FloatArray
    converged: bool


def solve(
    returns: FlatReturns, state: SpunState, free: IntArray, origin_rad: float, max_iterations: int = 40
) -> Solution:
    """The robust estimate; `free` are the indices (p,) of the parameters that may move.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the equations cannot be solved.
    """
    converged = False
    for _ in range(max_iterations):
        line = linearise(state, returns, origin_rad)
        weight, _, _ = weights_of(line, returns)
        reduced = reduce_surfaces(line, returns, weight)
        A = reduced.information.sum(axis=0)[np.ix_(free, free)]
        step = np.zeros(N_ALL)
        step[free] = np.linalg.solve(A, reduced.gradient.sum(axis=0)[free])
        largest = float(np.abs(step).max())
        # A start a few degrees off is safe; a longer step leaves the range where the derivatives mean anything.
        step *= min(1.0, 0.1 / max(largest, 1e-300))
        planes = tuple(
            _moved_plane(plane, line.frames[k], reduced.plane_step[k] - reduced.to_plane[k] @ step)
            for k, plane in enumerate(state.planes)
        )
        state = state.moved(step, planes)
        if largest < 1e-6:
            converged = True
            break
    line = linearise(state, returns, origin_rad)
    weight, slope, sigma = weights_of(line, returns)
    return Solution(state, line, weight, slope, sigma, converged)


def _moved_plane(plane: Plane, frame: FloatArray, step: FloatArray) -> Plane:
    """Tilted by step[:2] about its middle, then shifted by step[2]; `Plane` brings the normal to length 1."""
    middle, u, v = frame
    normal = plane.normal + step[0] * u + step[1] * v
    return Plane(normal, float(normal @ middle) + step[2])


@dataclass(frozen=True, eq=False)
class Evidence:
    """The parameters' covariance, and what the residuals say against the model.

    Attributes
    ----------
    information, score_spread : (N_ALL, N_ALL)
        Of all parameters, those that were not estimated too: the mean slope of the equations and the covariance of
        their scores.
    gradient : (N_ALL,)
        Zero for those that were estimated.
    widening : (p, p)
        Of the estimated parameters' score covariance: L such that it becomes L score_spread L'. It is the unit matrix
        where the surfaces agree as well as their patches do.
    pulls : (K,)
        By how many standard deviations each surface disagrees with the others about the estimated parameters.
    spread_factor
        Spread of the surfaces about the common estimate over what their patches say it should be.
    """

    information: FloatArray
    score_spread: FloatArray
    gradient: FloatArray
    widening: FloatArray
    pulls: FloatArray
    spread_factor: float

    def covariance(self, free: IntArray, *, widened: bool = True) -> FloatArray:
        """Covariance (p, p) of some parameters with the others held; `widened` for those that were estimated."""
        inverse = np.linalg.inv(self.information[np.ix_(free, free)])
        spread = self.score_spread[np.ix_(free, free)]
        if widened:
            spread = self.widening @ spread @ self.widening.T
        return np.asarray(inverse @ spread @ inverse.T)


def evidence_of(solution: Solution, returns: FlatReturns, free: IntArray) -> Evidence:
    """Sandwich over patches of the surfaces, and the surfaces' agreement with one another."""
    line = solution.line
    by_weight = reduce_surfaces(line, returns, solution.weight)
    # The slope of the loss, not its weight, tells how the equations' zero moves.
    share = np.array(
        [
            solution.slope[returns.surface == k].sum() / max(solution.weight[returns.surface == k].sum(), 1e-300)
            for k in range(returns.surfaces)
        ]
    )
    information = by_weight.information * np.clip(share, 0.2, 1.0)[:, None, None]
    patch, patches = patches_of(returns)
    pull = solution.weight * line.residual
    rows = line.by_all - np.einsum("nq,nqa->na", line.by_plane, by_weight.to_plane[returns.surface])
    scores = np.stack([np.bincount(patch, pull * rows[:, j], patches) for j in range(N_ALL)], axis=1)
    freedom = max(patches - len(free) - 3 * returns.surfaces, 1)
    spread = scores.T @ scores * (patches / freedom)
    gradient = by_weight.gradient
    widening, pulls, factor = _agreement(information, gradient, spread, free)
    return Evidence(information.sum(axis=0), spread, gradient.sum(axis=0), widening, pulls, factor)


def _agreement(
    information: FloatArray, gradient: FloatArray, spread: FloatArray, free: IntArray
) -> tuple[FloatArray, FloatArray, float]:
    """The widening (p, p), each surface's pull (K,) on the estimate, and the factor between their spread and patches'.

    In coordinates in which the whole information is the unit matrix, surface k has information B and a score whose
    covariance is B - B^2, because the common estimate follows it. Divided by the root of 1 - B the scores' squares add
    up to the unit matrix again (Bell and McCaffrey, "Bias reduction in standard errors", Survey Methodology 28, 2002).
    """
    block = np.ix_(free, free)
    root = np.linalg.inv(np.linalg.cholesky(information.sum(axis=0)[block]))
    by_patches = root @ spread[block] @ root.T
    typical = float(np.trace(by_patches)) / len(free)
    squares = np.zeros_like(by_patches)
    pulls = np.zeros(len(information))
    for k in range(len(information)):
        share, axes = np.linalg.eigh(root @ information[k][block] @ root.T)
        share = np.clip(share, 0.0, 1.0)
        score = axes.T @ (root @ gradient[k][free])
        freed = axes @ (score / np.sqrt(np.maximum(1.0 - share, OWN_SHARE)))
        squares += np.outer(freed, freed)
        told = (share > OWN_SHARE) & (share < 1.0 - OWN_SHARE)
        if told.any():
            pulls[k] = np.sqrt(np.mean(score[told] ** 2 / (share[told] * (1.0 - share[told]))) / typical)
    half = np.linalg.cholesky(by_patches)
    back = np.linalg.inv(half)
    ratio, axes = np.linalg.eigh(back @ squares @ back.T)
    factor = float(np.sqrt(ratio.mean()))
    # A handful of surfaces tells directions apart badly: each counts half by itself, half as the mean.
    wider = np.sqrt(np.maximum(0.5 * (ratio + ratio.mean()), 1.0))
    to_scores = np.linalg.inv(root)
    widening = to_scores @ half @ (axes * wider) @ axes.T @ back @ root
    return widening, pulls, factor


def patches_of(returns: FlatReturns) -> tuple[IntArray, int]:
    """Numbers (n,) of patches, pieces of one surface some degrees wide, and how many there are."""
    cells = np.stack(
        [
            returns.surface,
            np.floor(returns.reading_rad / PATCH_RAD).astype(np.int64),
            np.floor(returns.beam_rad / PATCH_RAD).astype(np.int64),
        ],
        axis=1,
    )
    found, index = np.unique(cells, axis=0, return_inverse=True)
    return np.asarray(index, dtype=np.int64).reshape(-1), len(found)


def bending(solution: Solution, returns: FlatReturns) -> float:
    """Root mean square (m) of what patches are off by beyond their noise, weighted as in the estimate."""
    patch, patches = patches_of(returns)
    used = solution.weight > 0.0
    count = np.bincount(patch[used], minlength=patches).astype(np.float64)
    mean = np.bincount(patch[used], solution.line.residual[used], patches) / np.maximum(count, 1.0)
    within = np.bincount(patch[used], (solution.line.residual[used] - mean[patch[used]]) ** 2, patches)
    enough = count >= 5.0
    if not enough.any():
        return 0.0
    noise = within[enough] / (count[enough] - 1.0) / count[enough]
    weight = np.bincount(patch[used], solution.weight[used], patches)[enough]
    return float(np.sqrt(max(np.average(mean[enough] ** 2 - noise, weights=weight), 0.0)))


def reading_scatter(solution: Solution, returns: FlatReturns) -> float:
    """Root mean square (rad) of what single sweeps' readings seem to be off by, beyond the noise."""
    J, w, r = solution.line.by_reading, solution.weight, solution.line.residual
    sweeps = int(returns.sweep.max()) + 1
    information = np.bincount(returns.sweep, w * J * J, sweeps)
    use = information > 0.0
    delta = np.bincount(returns.sweep, w * J * r, sweeps) / np.where(use, information, 1.0)
    rest = w * J * (r - J * delta[returns.sweep])
    noise = np.bincount(returns.sweep, rest**2, sweeps)[use] / information[use] ** 2
    return float(np.sqrt(max(np.average(delta[use] ** 2 - noise, weights=information[use]), 0.0)))
