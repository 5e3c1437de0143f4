"""The joint estimate of a turntable session, from observations and a start to an answer with a verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.observation import TurntableObservations
from lidarpose.model.turntable import TurntableMotion
from lidarpose.model.turntable_result import ExtraParameter, TurntableEstimate
from lidarpose.refine.alternatives import duplicates, explain_by_alternative
from lidarpose.refine.contradictions import explanations
from lidarpose.refine.hit_squares import with_squares
from lidarpose.refine.joint_options import JointOptions
from lidarpose.refine.named_effect import paid_for, shift_of, strongest_effects, suggested, unseen_range_errors
from lidarpose.refine.observability import pose_spread, weak_directions, whole_turn
from lidarpose.refine.reading_noise import reading_noise
from lidarpose.refine.stability import leave_places_out
from lidarpose.refine.turntable_estimate import (
    OutsideParameters,
    extra_effect,
    left_out_lines,
    noise_estimates,
    outside_parameters,
    panel_poses,
    require_determined,
    residual_groups,
    tested_extras,
)
from lidarpose.refine.turntable_joint import Solution, solve_joint
from lidarpose.refine.turntable_layout import JointData, lay_out
from lidarpose.refine.turntable_parameters import EXTRAS
from lidarpose.refine.turntable_state import JointState, start_state
from lidarpose.refine.verdict import Evidence, judge

__all__ = ["JointOptions", "refine_turntable"]

# A share of beams that a start puts on squares of the other colour, which changes nothing.
SAME_SQUARES = 0.02


def refine_turntable(
    observations: TurntableObservations,
    start_motion: TurntableMotion,
    start_panel_poses: Mapping[str, tuple[Pose | None, ...]],
    options: JointOptions | None = None,
) -> TurntableEstimate:
    """One robust maximum-likelihood estimate over all places, with its covariance, diagnosis and verdict.

    Parameters
    ----------
    observations
        Corners, stripes and scan lines, each with its panel. Stripes may be missing altogether.
    start_motion, start_panel_poses
        A rough solution in the fixed frames (from the closed form); T_camera_panel by placement.
    options
        See `JointOptions`.

    Raises
    ------
    UndeterminedError
        If the data leave a motion open; the message names it and what to record.
    ValueError
        If a panel in use has no start pose.
    """
    options = options or JointOptions()
    data = lay_out(observations, use_stripes=options.use_stripes)
    start = start_state(data, start_motion, start_panel_poses)
    plain = replace(options, estimate=())
    solution = _solve(data, start, observations, plain)
    outside = outside_parameters(solution)
    _require_determined(observations, solution, outside, options)
    refused: dict[str, str] = {}
    if options.estimate:
        chosen, refused = _observable(solution, options)
        if chosen:
            solution = solve_joint(solution.data, solution.state, replace(options, estimate=chosen))
            outside = outside_parameters(solution)
            require_determined(solution, outside)
        options = replace(options, estimate=chosen)
    return _assemble(observations, solution, outside, options, refused)


def _solve(data: JointData, start: JointState, observations: TurntableObservations, options: JointOptions) -> Solution:
    """The joint estimate without extra parameters. Without intensities, what beams hit is told by where they hit, and
    the estimate made again where a rough start put that on other squares."""
    if data.has_intensity:
        return solve_joint(data, start, options)
    ranges = with_squares(data, start, observations)
    solution = solve_joint(replace(data, ranges=ranges), start, options)
    again = with_squares(data, solution.state, observations)
    if np.abs(again.darkness - ranges.darkness).mean() < SAME_SQUARES:
        return solution
    return solve_joint(replace(data, ranges=again), solution.state, options)


def _require_determined(
    observations: TurntableObservations, solution: Solution, outside: OutsideParameters, options: JointOptions
) -> None:
    """Raise UndeterminedError, with the fault in the files that causes it where one can be named."""
    try:
        require_determined(solution, outside)
    except UndeterminedError as error:
        cause = explain_by_alternative(observations, options) if options.search_alternatives else None
        if cause is None:
            raise
        raise UndeterminedError(
            f"the files contradict each other: {cause}", remedy="Mend the session's files", details=(error.what,)
        ) from error


_LARGEST_SIGMA: dict[str, float] = {
    "encoder_scale": 0.02,
    "range_offset_m": 0.02,
    "range_scale": 0.02,
    "beam_angle_scale": 0.02,
    "black_bias_m": 0.02,
    "focal_scale": 0.05,
    "centre_x_px": 30.0,
    "centre_y_px": 30.0,
}
"""An extra parameter that the data determine no better than this is not turned on."""


def _observable(solution: Solution, options: JointOptions) -> tuple[tuple[str, ...], dict[str, str]]:
    """Which of the chosen extra parameters the data can tell, and why the others are refused."""
    tested = {e.name: e for e in tested_extras(solution, replace(options, estimate=()))}
    chosen, refused = [], {}
    for name in options.estimate:
        if not tested[name].observable:
            refused[name] = "not estimated: the data cannot tell it"
        elif tested[name].sigma > _LARGEST_SIGMA[name]:
            refused[name] = f"not estimated: its standard deviation would be {tested[name].sigma:.2g}"
        else:
            chosen.append(name)
    return tuple(chosen), refused


def _assemble(
    observations: TurntableObservations,
    solution: Solution,
    outside: OutsideParameters,
    options: JointOptions,
    refused: Mapping[str, str],
) -> TurntableEstimate:
    data, angles = solution.data, solution.data.angles_rad
    stability, noise = leave_places_out(solution, outside), noise_estimates(solution)
    errors = reading_noise(solution)
    if errors is not None:
        solution = errors.solution
        outside = outside_parameters(solution)
    inside_at = np.unique([angles.min(), data.reference_rad, angles.max()])
    extras = _judged_extras(solution, outside, options, refused, inside_at)
    effects = strongest_effects(solution, outside, options, extras, explanations(solution.suspicious or solution))
    directions = weak_directions(outside.motion, outside.covariance[:10, :10], angles)
    outside = paid_for(outside, effects, data.reference_rad)
    C = _of_motion(outside)
    evidence = Evidence(
        noise=noise,
        range_sigma_m=observations.lidar.range_sigma_m,
        inside=pose_spread(outside.motion, C, inside_at),
        around=pose_spread(outside.motion, C, whole_turn(data.reference_rad)),
        want_mm=options.want_mm,
        want_deg=options.want_deg,
        converged=solution.converged,
        lines_offered={k: len(n.line_weights) for k, n in solution.noise.lines.items()},
        lines_left_out={k: int((n.line_weights == 0.0).sum()) for k, n in solution.noise.lines.items()},
        extras=extras,
        stability=stability,
        directions=directions,
        places=len(observations.places),
        duplicates=duplicates(observations),
        drift=(solution.suspicious or solution).drift,
        effects=effects,
        reading_sigma_rad=0.0 if errors is None else errors.sigma_rad,
        unseen=unseen_range_errors(solution, outside, extras, options.want_mm),
        effect_shift=shift_of(outside, effects[0], data.reference_rad) if effects else (0.0, 0.0),
    )
    quality = judge(evidence)
    if quality.verdict == "rejected" or not solution.converged:
        cause = explain_by_alternative(observations, options) if options.search_alternatives else None
        if cause is not None:
            evidence = replace(evidence, findings=(cause,))
            quality = judge(evidence)
    groups = residual_groups(solution)
    return TurntableEstimate(
        motion=outside.motion,
        panel_poses=panel_poses(solution, observations),
        parameter_names=outside.names,
        parameter_covariance=outside.covariance,
        noise=noise,
        residuals=groups,
        left_out=left_out_lines(solution, observations, groups),
        cost=0.5 * solution.equations.sum_of_squares,
        converged=solution.converged,
        iterations=solution.iterations,
        condition_number=solution.condition_number,
        directions=directions,
        extras=extras,
        quality=quality,
        findings=(*evidence.findings, *evidence.duplicates),
        extra_values={n: float(solution.state.extras[EXTRAS.index(n)]) for n in options.estimate},
    )


def _of_motion(outside: OutsideParameters) -> FloatArray:
    """Covariance (10, 10) of the motion, (11, 11) with the readings' scale where that is estimated or seen."""
    keep = [*range(10), *(k for k, name in enumerate(outside.names) if name == "encoder_scale")]
    return np.asarray(outside.covariance[np.ix_(keep, keep)])


def _judged_extras(
    solution: Solution,
    outside: OutsideParameters,
    options: JointOptions,
    refused: Mapping[str, str],
    inside_at: FloatArray,
) -> tuple[ExtraParameter, ...]:
    inside = pose_spread(outside.motion, outside.covariance[:10, :10], inside_at)
    out = []
    for extra in tested_extras(solution.suspicious or solution, options):
        if extra.name in refused:
            extra = replace(extra, note=refused[extra.name])
        effect = (0.0, 0.0)
        if extra.observable and not extra.estimated:
            effect = extra_effect(solution, outside, extra.name, extra.value)
        out.append(replace(extra, suggested=suggested(extra, effect, inside)))
    return tuple(out)
