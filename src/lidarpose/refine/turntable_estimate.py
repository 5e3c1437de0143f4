"""From the solver's internal parameters to the estimate that is handed back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.observation import LeftOut, TurntableObservations
from lidarpose.model.turntable import PARAMETER_NAMES, TurntableMotion
from lidarpose.model.turntable_result import ExtraParameter, Kind, NoiseEstimate, ResidualGroup
from lidarpose.refine.joint_equations import lines_of
from lidarpose.refine.joint_options import JointOptions
from lidarpose.refine.observability import pose_spread, weak_directions, whole_turn
from lidarpose.refine.turntable_joint import Solution
from lidarpose.refine.turntable_layout import Slot
from lidarpose.refine.turntable_parameters import EXTRAS, N_GLOBAL, N_MOTION
from lidarpose.refine.turntable_state import motion_map

_PANEL_PARTS = ("tx_m", "ty_m", "tz_m", "rx_rad", "ry_rad", "rz_rad")
_HOPELESS_M, _HOPELESS_RAD = 0.5, np.deg2rad(30.0)


@dataclass(frozen=True, eq=False)
class OutsideParameters:
    """Names, values and covariance in the fixed frames.

    Attributes
    ----------
    names, covariance : (n,), (n, n)
        Of motion, estimated extras and panels.
    from_inside : (n, n)
        Derivative by the active internal parameters.
    """

    motion: TurntableMotion
    names: tuple[str, ...]
    covariance: FloatArray
    from_inside: FloatArray


def outside_parameters(solution: Solution) -> OutsideParameters:
    """The motion in the fixed frames with the covariance (n, n) of motion, estimated extras and panels."""
    data, state = solution.data, solution.state
    motion = state.to_motion(data.reference_rad)
    n = N_GLOBAL + 6 * len(data.slots)
    to_outside = np.zeros((n, n))
    to_outside[:N_MOTION, :N_MOTION] = motion_map(state, motion, data.reference_rad)
    to_outside[N_MOTION:N_GLOBAL, N_MOTION:N_GLOBAL] = np.eye(len(EXTRAS))
    for k, pose in enumerate(state.panels):
        at = slice(N_GLOBAL + 6 * k, N_GLOBAL + 6 * k + 6)
        to_outside[at, at] = (pose @ Pose(np.eye(3), data.centres[k])).adjoint()
    use = np.asarray(solution.active)
    J = to_outside[np.ix_(use, use)]
    names = (
        *PARAMETER_NAMES,
        *EXTRAS,
        *(f"panel_{_slot_name(slot)}.{part}" for slot in data.slots for part in _PANEL_PARTS),
    )
    return OutsideParameters(motion, tuple(names[i] for i in use), J @ solution.covariance @ J.T, J)


def _slot_name(slot: Slot) -> str:
    return f"{slot.placement}_{slot.panel}" if slot.placement else f"{slot.panel}"


def require_determined(solution: Solution, outside: OutsideParameters) -> None:
    """Raise UndeterminedError where the data leave the LiDAR's pose amid the recorded readings open.

    The message names the motion that is free.
    """
    angles = solution.data.angles_rad
    # Lines that drift are a contradiction, for the verdict: they do not leave a motion open.
    C = outside.covariance[:10, :10] / max(n.neighbour_factor for n in solution.noise.lines.values())
    inside = pose_spread(outside.motion, C, np.array([angles.min(), solution.data.reference_rad, angles.max()]))
    around = pose_spread(outside.motion, C, whole_turn(solution.data.reference_rad))
    open_inside = inside.position_m.max() > _HOPELESS_M or inside.rotation_rad.max() > _HOPELESS_RAD
    open_around = around.position_m.max() > 2.0 * _HOPELESS_M or around.rotation_rad.max() > 2.0 * _HOPELESS_RAD
    if not (open_inside or open_around or solution.condition_number > 1e13):
        return
    weakest = weak_directions(outside.motion, C, angles, count=1)[0]
    raise UndeterminedError(
        f"the data leave {weakest.name} undetermined (one standard deviation is "
        f"{weakest.sigma_mm:.3g} mm and {weakest.sigma_deg:.3g} degrees at {weakest.angle_deg:.1f} degrees)",
        remedy=weakest.remedy,
    )


def noise_estimates(solution: Solution) -> dict[Kind, NoiseEstimate]:
    """By kind, what the residuals show."""
    data, noise = solution.data, solution.noise
    sigma = np.concatenate([np.repeat(c.sigma_px, 2) for c in data.corners])
    weights = np.concatenate(noise.corners.weights)
    stated = float(np.median(sigma))
    used = int((weights > 0.0).sum())
    freedom, factor = used - 6.0 * len(data.slots), noise.corners.factor
    out: dict[Kind, NoiseEstimate] = {
        "corners": NoiseEstimate(
            len(sigma), used, stated, factor, stated * factor, 0.0, freedom, noise.corners.smooth_factor
        )
    }
    for kind, of_lines in noise.lines.items():
        lines = lines_of(data, kind)
        finite = np.isfinite(lines.sigma)
        stated = float(np.median(lines.sigma[finite])) if finite.any() else float("nan")
        counted = solution.at.lines[kind].valid & (of_lines.line_weights[lines.line_of_row] > 0.0)
        used = int((of_lines.row_weights[counted] > 0.0).sum())
        out[kind] = NoiseEstimate(
            len(lines.sigma),
            used,
            stated,
            of_lines.factor,
            stated * of_lines.factor,
            float(np.sqrt(of_lines.place_variance)),
            max(used - 10.0, 0.0),
            of_lines.neighbour_factor,
            of_lines.rows_as_one,
        )
    return out


def residual_groups(solution: Solution) -> tuple[ResidualGroup, ...]:
    """Residuals with their weights, group by group."""
    data, noise = solution.data, solution.noise
    groups = []
    for k, slot in enumerate(data.slots):
        sigma = np.repeat(data.corners[k].sigma_px, 2) * noise.corners.factor
        values, weights = solution.at.corners[k].residual, noise.corners.weights[k]
        groups.append(ResidualGroup("corners", slot.placement, slot.panel, None, None, values, weights, sigma))
    for kind, of_lines in noise.lines.items():
        lines, residuals = lines_of(data, kind), solution.at.lines[kind]
        weights = of_lines.row_weights * of_lines.line_weights[lines.line_of_row] * residuals.valid
        for j in range(lines.count):
            rows = slice(int(lines.start[j]), int(lines.start[j + 1]))
            slot = data.slots[lines.slot[j]]
            place = int(lines.place[j])
            groups.append(
                ResidualGroup(
                    kind,
                    slot.placement,
                    slot.panel,
                    data.positions[place],
                    float(data.angles_rad[place]),
                    residuals.residual[rows],
                    weights[rows],
                    lines.sigma[rows] * of_lines.factor,
                )
            )
    return tuple(groups)


def left_out_lines(
    solution: Solution, observations: TurntableObservations, groups: Sequence[ResidualGroup]
) -> tuple[LeftOut, ...]:
    """What was left out or lost much of its weight, in words; `groups` as `residual_groups` makes them."""
    out = [*observations.left_out, *solution.data.left_out]
    for group in groups:
        if group.position is None:
            share = float((group.weights < 0.5).mean())
            if share > 0.02:
                where = f" of placement {group.placement}" if group.placement else ""
                what = f"{share:.0%} of the corners of panel {group.panel}{where}"
                out.append(LeftOut(what, "they do not fit the rest"))
            continue
        what = {"stripes": "the stripe", "ranges": "the scan line"}[group.kind]
        name = f"{what} of {group.position} on panel {group.panel}"
        if not group.weights.any():
            off = float(np.median(group.values))
            size = f"{off:+.2f} px" if group.kind == "stripes" else f"{1e3 * off:+.2f} mm"
            out.append(LeftOut(name, f"it contradicts all other places: off by {size} in the middle"))
        elif (share := np.count_nonzero(group.weights < 0.5) / len(group.weights)) > 0.25:
            out.append(LeftOut(f"{share:.0%} of {name}", "outliers"))
    return tuple(out)


def tested_extras(solution: Solution, options: JointOptions) -> tuple[ExtraParameter, ...]:
    """Every extra parameter: estimated, or tested by one linear step (a score test).

    Rao (1948): at the estimate without the parameter, gradient and information tell what a step with it would bring.
    """
    equations, use = solution.equations, np.asarray(solution.active)
    out = []
    for i, name in enumerate(EXTRAS):
        p = N_MOTION + i
        if name in options.estimate:
            at = int(np.flatnonzero(use == p)[0])
            sigma = float(np.sqrt(solution.covariance[at, at]))
            out.append(ExtraParameter(name, float(solution.state.extras[i]), sigma, True, True))
            continue
        cross = equations.information[use, p]
        own = float(equations.information[p, p])
        rest = own - float(cross @ solution.covariance @ cross)
        if own <= 0.0 or rest <= 1e-7 * own:
            out.append(ExtraParameter(name, 0.0, float("inf"), False, False, note="the data cannot tell it"))
            continue
        score = float(equations.gradient[p] - cross @ solution.covariance @ equations.gradient[use])
        value, sigma = score / rest, 1.0 / np.sqrt(rest)
        out.append(ExtraParameter(name, value, float(sigma), False, True))
    return tuple(out)


def extra_effect(solution: Solution, outside: OutsideParameters, name: str, value: float) -> tuple[float, float]:
    """How far (m, rad) an extra parameter of this value would move the pose inside the recorded arc."""
    move = move_of_extra(solution, outside, name, value)[:N_MOTION]
    spread = pose_spread(outside.motion, np.outer(move, move), _arc(solution))
    return float(spread.position_m.max()), float(spread.rotation_rad.max())


def move_of_extra(solution: Solution, outside: OutsideParameters, name: str, value: float) -> FloatArray:
    """How the parameters of `outside` (n,) would change with an extra parameter of this value.

    A scale of the readings turns the LiDAR in proportion to the reading, which no motion does: its change is the one
    that moves the pose alike over the recorded arc.
    """
    p = N_MOTION + EXTRAS.index(name)
    use = np.asarray(solution.active)
    move = np.asarray(
        outside.from_inside @ (-solution.covariance @ solution.equations.information[use, p] * value), dtype=np.float64
    )
    if name == "encoder_scale":
        about_middle = replace(outside.motion, reading_origin_rad=solution.data.reference_rad)
        J = np.concatenate([outside.motion.pose_jacobian(float(r)) for r in _arc(solution)])
        turned = np.concatenate([about_middle.pose_by_scale(float(r)) * value for r in _arc(solution)])
        move[:N_MOTION] += np.linalg.lstsq(J, turned, rcond=1e-9)[0]
    return move


def _arc(solution: Solution) -> FloatArray:
    """First, middle and last reading."""
    angles = solution.data.angles_rad
    return np.array([angles.min(), solution.data.reference_rad, angles.max()])


def panel_poses(solution: Solution, observations: TurntableObservations) -> Mapping[str, tuple[Pose | None, ...]]:
    """By placement, in the session's order of panels."""
    known = dict(zip(solution.data.slots, solution.state.panels, strict=True))
    return {
        name: tuple(known.get(Slot(name, k)) for k in range(len(corners)))
        for name, corners in observations.corners.items()
    }
