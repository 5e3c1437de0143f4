"""The estimate of a spun 2D LiDAR's mounting with its tests: what the scene tells, and what to think of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.se3 import Pose, skew
from lidarpose.model.beam_correction import BeamCorrection
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.spun_scan import FlatReturns, FlatSurface, MountingEstimate, ReadingJump
from lidarpose.model.turntable import PARAMETER_NAMES
from lidarpose.model.turntable_result import ExtraParameter
from lidarpose.refine.bent_surfaces import bend_of
from lidarpose.refine.flatness import (
    EXTRA_NAMES,
    MOUNTING_NAMES,
    N_MOUNTING,
    Evidence,
    Solution,
    bending,
    evidence_of,
    reading_scatter,
    solve,
    start_state,
)
from lidarpose.refine.mounting_verdict import IN_WORDS, Findings, MountingOptions, quality_of, slipped
from lidarpose.refine.reading_jumps import reading_jumps
from lidarpose.refine.sweep_turning import moved_by_jumps, sweep_turning
from lidarpose.refine.turntable_state import regular_motion

# A mounting less certain than this is not known; the estimate may then be anywhere.
LARGEST_TILT_SIGMA_RAD = np.radians(2.0)
LARGEST_SHIFT_SIGMA_M = 0.1
# While surfaces are still looked for, so many times as much: pieces tell less than they will once grown together.
LARGEST_ON_THE_WAY = 3.0
# An extra parameter less certain than this is not told by the scene.
LARGEST_EXTRA_SIGMA = {"encoder_scale": 0.02, "range_offset_m": 0.03, "beam_angle_scale": 0.02}
# A parameter is missing where it would come to this many standard deviations and take away this share of the squares:
# less is no main cause of a misfit.
SUGGESTED_SIGMAS = 6.0
SUGGESTED_SHARE = 0.1
LEAST_SURFACES = 3


def refine_mounting(
    returns: FlatReturns,
    T_table_lidar: Pose,
    options: MountingOptions | None = None,
    *,
    extras: FloatArray | None = None,
    origin_rad: float | None = None,
) -> MountingEstimate:
    """The mounting at which the surfaces are flattest, with its covariance and a verdict.

    Whether it is told well enough to be a result is for `require_told` to say.

    Parameters
    ----------
    returns
        On at least three surfaces.
    T_table_lidar
        A start, some degrees and centimetres off at most. Its turn about z stays.
    extras : (3,)
        A start of the extra parameters; zeros by default.
    origin_rad
        The reading that a factor on readings is counted from; the middle of the readings by default.

    Raises
    ------
    UndeterminedError
        If the surfaces do not tell the mounting.
    """
    options = options or MountingOptions()
    if returns.surfaces < LEAST_SURFACES:
        raise _undetermined(f"{returns.surfaces} flat surfaces were found, and a mounting needs at least three")
    if origin_rad is None:
        origin_rad = 0.5 * float(returns.reading_rad.min() + returns.reading_rad.max())
    start = Pose(T_table_lidar.rotation, T_table_lidar.translation * [1.0, 1.0, 0.0])
    free = options.free
    try:
        state = start_state(returns, start, np.zeros(3) if extras is None else extras, origin_rad)
        solution = solve(returns, state, free, origin_rad)
        evidence = evidence_of(solution, returns, free)
        covariance = evidence.covariance(free)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise _undetermined("The flat surfaces seen leave the mounting open") from error
    jumps, from_steps = reading_jumps(solution, returns)
    _refuse_undetermined(covariance, options.estimate, jumps, LARGEST_ON_THE_WAY)
    tested = _extras(solution, evidence, options.estimate, covariance)
    bend = bend_of(solution, returns, solution.line.by_all[:, free])
    by_noise = evidence.covariance(free, widened=False)
    covariance = _covering(covariance, by_noise + bend.covariance)
    covariance = _paid_for(covariance, evidence, free, tested)
    moved = moved_by_jumps(solution, returns, free, jumps)
    covariance = covariance + moved.T @ moved
    # A parameter that is missing spoils what else is asked.
    turning = None if any(extra.suggested for extra in tested) else sweep_turning(solution, returns, free)
    if turning is not None and (turning.contradicted or (turning.open and not options.sweeps_stated)):
        covariance = covariance + np.outer(turning.move, turning.move)
    findings = Findings(
        solution,
        evidence,
        tested,
        covariance,
        _surfaces(solution, evidence, returns),
        bending(solution, returns),
        bend,
        float(np.sqrt(np.abs(np.linalg.eigvals(np.linalg.solve(by_noise, bend.covariance))).max())),
        turning,
        jumps,
        max(reading_scatter(solution, returns), from_steps),
    )
    return MountingEstimate(
        solution.state.T_table_lidar,
        origin_rad,
        tested,
        (*MOUNTING_NAMES, *(EXTRA_NAMES[i - N_MOUNTING] for i in free[N_MOUNTING:])),
        covariance,
        evidence.covariance(free),
        findings.surfaces,
        findings.bending_m,
        findings.reading_scatter_rad,
        jumps,
        bend.spread_m,
        None if turning is None else (turning.share, turning.sigma),
        evidence.spread_factor,
        solution.converged,
        quality_of(findings, options),
    )


def _covering(first: FloatArray, second: FloatArray) -> FloatArray:
    """The smallest covariance that is nowhere below the first, and nowhere below the second in the first's axes."""
    half = np.linalg.cholesky(first)
    back = np.linalg.inv(half)
    ratio, axes = np.linalg.eigh(back @ second @ back.T)
    return np.asarray(half @ (axes * np.maximum(ratio, 1.0)) @ axes.T @ half.T)


def _undetermined(what: str) -> UndeterminedError:
    return UndeterminedError(
        what,
        remedy="Record a room with floor or ceiling and two walls that are no continuation of each other, over as much "
        "of the turn as the rig allows.",
    )


def require_told(estimate: MountingEstimate, options: MountingOptions) -> None:
    """UndeterminedError where the scene leaves the mounting open, by all that the covariance holds."""
    _refuse_undetermined(estimate.covariance, options.estimate, estimate.jumps)


def _refuse_undetermined(
    covariance: FloatArray, estimate: Sequence[str], jumps: Sequence[ReadingJump], times: float = 1.0
) -> None:
    sigma = np.sqrt(np.diag(covariance))
    if not np.all(np.isfinite(sigma)):
        raise _undetermined("The flat surfaces seen leave the mounting open")
    for name, value in zip((n for n in EXTRA_NAMES if n in estimate), sigma[N_MOUNTING:], strict=True):
        if value > times * LARGEST_EXTRA_SIGMA[name]:
            unit, factor = ("mm", 1e3) if name.endswith("_m") else ("%", 1e2)
            raise UndeterminedError(
                f"{name} is not told by this scene: its standard deviation would be {factor * value:.2g} {unit}",
                remedy=f"Leave out --estimate {IN_WORDS[name][1]}, or record surfaces that are nearer and farther, "
                "and more of the turn.",
            )
    tilt, shift = float(sigma[:2].max()), float(sigma[2:4].max())
    if tilt > times * LARGEST_TILT_SIGMA_RAD or shift > times * LARGEST_SHIFT_SIGMA_M:
        open_ = (
            f"The flat surfaces seen leave the mounting open: standard deviations {np.degrees(tilt):.2g} deg "
            f"and {1e3 * shift:.3g} mm"
        )
        if jumps:
            raise UndeterminedError(
                f"{open_}; {slipped(jumps)}", remedy="Record again with readings that are where the table was."
            )
        raise _undetermined(open_)


def _extras(
    solution: Solution, evidence: Evidence, estimate: Sequence[str], covariance: FloatArray
) -> tuple[ExtraParameter, ...]:
    """Those that were estimated, and one linear step for each of the others."""
    free = [*range(N_MOUNTING), *(N_MOUNTING + k for k, n in enumerate(EXTRA_NAMES) if n in estimate)]
    squares = float((solution.weight * solution.line.residual**2).sum())
    out, gains = [], {}
    for k, name in enumerate(EXTRA_NAMES):
        index = N_MOUNTING + k
        if name in estimate:
            at = free.index(index)
            sigma = float(np.sqrt(covariance[at, at]))
            out.append(ExtraParameter(name, float(solution.state.extras[k]), sigma, estimated=True, observable=True))
            continue
        value, sigma, gain = _one_step(evidence, np.array(free), index)
        observable = sigma < LARGEST_EXTRA_SIGMA[name]
        if observable and abs(value) > SUGGESTED_SIGMAS * sigma and gain > SUGGESTED_SHARE * squares:
            gains[name] = gain
        out.append(ExtraParameter(name, value, sigma, estimated=False, observable=observable))
    if not gains:
        return tuple(out)
    best = max(gains, key=lambda name: gains[name])
    return tuple(ExtraParameter(e.name, e.value, e.sigma, e.estimated, e.observable, e.name == best) for e in out)


def _paid_for(
    covariance: FloatArray, evidence: Evidence, free: IntArray, extras: Sequence[ExtraParameter]
) -> FloatArray:
    """The covariance with what a missing parameter moves the estimate by, squared."""
    for k, extra in enumerate(extras):
        if extra.suggested:
            A = evidence.information
            move = -extra.value * np.linalg.solve(A[np.ix_(free, free)], A[free, N_MOUNTING + k])
            covariance = covariance + np.outer(move, move)
    return covariance


def _one_step(evidence: Evidence, free: IntArray, index: int) -> tuple[float, float, float]:
    """Value and standard deviation of a further parameter, and by what the weighted squares would fall."""
    A = evidence.information
    along = np.linalg.solve(A[np.ix_(free, free)], A[free, index])
    left = float(A[index, index] - A[index, free] @ along)
    if not left > 1e-9 * float(A[index, index]):
        return 0.0, float("inf"), 0.0
    value = float(evidence.gradient[index] - along @ evidence.gradient[free]) / left
    # What the surfaces disagree by may be what this parameter mends: it is not counted against it.
    sigma = float(np.sqrt(evidence.covariance(np.append(free, index), widened=False)[-1, -1]))
    return value, sigma, value**2 * left


def _surfaces(solution: Solution, evidence: Evidence, returns: FlatReturns) -> tuple[FlatSurface, ...]:
    full = 1.0 / solution.sigma[returns.surface] ** 2
    out = []
    for k, plane in enumerate(solution.state.planes):
        mine = returns.surface == k
        used = int(np.count_nonzero(solution.weight[mine] > 0.5 * full[mine]))
        out.append(FlatSurface(plane, int(mine.sum()), used, float(solution.sigma[k]), float(evidence.pulls[k])))
    return tuple(out)


def mounting_calibration(estimate: MountingEstimate) -> TurntableCalibration:
    """The calibration file's content. There is no camera: its frame stands for the table's, as the start has it."""
    T = estimate.T_table_lidar
    motion = regular_motion(Pose.identity(), T)
    # By the ten numbers from the four: both describe the same poses, so it follows from the poses at three readings.
    readings = np.array([-2.1, 0.0, 2.1])
    four = np.zeros((6, 4))
    four[:3, :2], four[3:, :2] = skew(T.translation)[:, :2], np.eye(3)[:, :2]
    four[:3, 2:] = np.eye(3)[:, :2]
    inside = np.concatenate([Pose.rot_z(float(a)).adjoint() @ four for a in readings])
    outside = np.concatenate([motion.pose_jacobian(float(a)) for a in readings])
    extras = len(estimate.parameter_names) - N_MOUNTING
    J = np.zeros((len(PARAMETER_NAMES) + extras, N_MOUNTING + extras))
    J[:10, :4] = np.linalg.lstsq(outside, inside, rcond=None)[0]
    J[10:, 4:] = np.eye(extras)
    values = dict(estimate.extra_values)
    if "encoder_scale" in values:
        motion = replace(
            motion, reading_scale=1.0 + values["encoder_scale"], reading_origin_rad=estimate.reading_origin_rad
        )
    names = (*PARAMETER_NAMES, *estimate.parameter_names[N_MOUNTING:])
    covariance = J @ estimate.covariance @ J.T
    return TurntableCalibration(
        motion, 0.5 * (covariance + covariance.T), names, estimate.quality, beams=BeamCorrection.from_extras(values)
    )
