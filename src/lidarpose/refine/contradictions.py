"""Contradictions that residuals show: what whole lines are off by, and which single change would explain it.

Each explanation is a parameter (or six) that the estimate did not have. One linear step tells what it would come to and
by how much the misfit would fall (a score test, Rao 1948): no refit, so that every moment of a recording can be tried
as the one at which the board was moved.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.model.turntable_result import Kind
from lidarpose.refine.joint_equations import lines_of, reduced_moments
from lidarpose.refine.least_squares import NormalEquations
from lidarpose.refine.turntable_joint import Solution
from lidarpose.refine.turntable_parameters import N_GLOBAL
from lidarpose.refine.turntable_residuals import panel_jacobians


@dataclass(frozen=True, eq=False)
class Explanation:
    """A change that would explain misfit.

    Attributes
    ----------
    key
        Which kind of explanation.
    text
        In words, with its size.
    fall
        By how much the weighted sum of squares would fall, and `freedom` with how many numbers.
    shift_m, turn_rad
        How far the LiDAR's pose amid the readings would move.
    size
        In the explanation's own unit; of a move the length in m.
    change : (n,)
        How the active parameters would change.
    """

    key: str
    text: str
    fall: float
    freedom: int
    shift_m: float
    turn_rad: float
    size: float
    change: FloatArray

    @property
    def strength(self) -> float:
        """Like the number of standard deviations of a single parameter."""
        return float(np.sqrt(max(self.fall - self.freedom, 0.0) / np.sqrt(self.freedom)))


@dataclass(frozen=True, eq=False)
class _LineTerms:
    """Normal equations of each line (S of all kinds) by its place's pose (6), its panel's pose (6) and the parameters.

    own : (S, 12, 12), gradient : (S, 12), cross : (S, 12, n) with the active parameters.
    """

    place: IntArray
    panel: IntArray
    kind: tuple[Kind, ...]
    own: FloatArray
    gradient: FloatArray
    cross: FloatArray


def line_terms(solution: Solution) -> _LineTerms:
    """All lines' normal equations; left-out lines contribute nothing."""
    parts = [
        _terms_of_kind(solution, kind, reduced_moments(m, solution.noise.lines[kind]))
        for kind, m in solution.moments.items()
    ]
    return _LineTerms(
        np.concatenate([p.place for p in parts]),
        np.concatenate([p.panel for p in parts]),
        tuple(k for p in parts for k in p.kind),
        np.concatenate([p.own for p in parts]),
        np.concatenate([p.gradient for p in parts]),
        np.concatenate([p.cross for p in parts]),
    )


def _terms_of_kind(solution: Solution, kind: Kind, reduced: FloatArray) -> _LineTerms:
    data, residuals, lines = solution.data, solution.at.lines[kind], lines_of(solution.data, kind)
    S, b, _ = residuals.to_parameters.shape
    # to_parameters = (place part) @ J_place for the motion, (panel part) @ J_panel for the panel: undo both.
    _, _, J_place = solution.state.turned(data.angles_rad, data.reference_rad)
    to = np.zeros((S, b, 12))
    to[:, :, :6] = residuals.to_parameters[:, :, :6] @ np.linalg.inv(J_place[lines.place][:, :, :6])
    J_panel = panel_jacobians(solution.state, data)[lines.slot]
    to[:, :, 6:] = residuals.to_parameters[:, :, N_GLOBAL:] @ np.linalg.inv(J_panel)
    use = np.asarray(solution.active)
    full = np.zeros((S, b, N_GLOBAL + 6 * len(data.slots)))
    full[:, :, :N_GLOBAL] = residuals.to_parameters[:, :, :N_GLOBAL]
    for k in range(len(data.slots)):
        mine = lines.slot == k
        full[mine, :, N_GLOBAL + 6 * k : N_GLOBAL + 6 * k + 6] = residuals.to_parameters[mine][:, :, N_GLOBAL:]
    weighted = np.swapaxes(to, 1, 2) @ reduced[:, :-1, :]
    return _LineTerms(
        lines.place,
        np.array([data.slots[k].panel for k in lines.slot]),
        (kind,) * S,
        weighted[:, :, :-1] @ to,
        -weighted[:, :, -1],
        weighted[:, :, :-1] @ full[:, :, use],
    )


# --- explanations ---------------------------------------------------------------------------------------------------


def explanations(solution: Solution) -> list[Explanation]:
    """Changes between lines that the extra parameters do not cover, strongest first."""
    terms = line_terms(solution)
    found = [*_lags(solution, terms), *_moves(solution, terms), *_panel_scales(solution, terms)]
    return sorted(found, key=lambda e: -e.strength)


def _explain(
    solution: Solution, own: FloatArray, gradient: FloatArray, cross: FloatArray
) -> tuple[float, FloatArray, FloatArray] | None:
    """Fall of the sum of squares, values (m,), and the change of the active parameters, for m added parameters."""
    equations: NormalEquations = solution.equations
    use = np.asarray(solution.active)
    settle = solution.covariance @ cross.T
    left = own - cross @ settle
    score = gradient - settle.T @ equations.gradient[use]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(own), 1e-300))
    values, vectors = np.linalg.eigh(left * scale[:, None] * scale[None, :])
    keep = values > 1e-7
    if not keep.any():
        return None
    along = vectors[:, keep].T @ (scale * score)
    value = scale * (vectors[:, keep] @ (along / values[keep]))
    return float((along**2 / values[keep]).sum()), value, -settle @ value


def _pose_move(solution: Solution, change: FloatArray) -> tuple[float, float]:
    """How far the LiDAR's pose at the reference reading moves, m and rad."""
    xi = change[:6]
    centre = solution.state.T_camera_lidar.translation
    return float(np.linalg.norm(xi[:3] + np.cross(xi[3:], centre))), float(np.linalg.norm(xi[3:]))


def _axis_twist(solution: Solution) -> FloatArray:
    """Left perturbation (6,) of the LiDAR's pose by a turn about the turntable's axis."""
    return solution.state.T_camera_axis.adjoint()[:, 5]


def _lags(solution: Solution, terms: _LineTerms) -> Iterator[Explanation]:
    """The scans were taken at other readings than the stripes: one angle between them."""
    of_ranges = np.array([k == "ranges" for k in terms.kind])
    if of_ranges.all():
        return
    twist = np.concatenate([_axis_twist(solution), np.zeros(6)])
    tested = _tested(solution, terms, of_ranges, twist[:, None])
    if tested is None:
        return
    fall, value, change = tested
    step = np.median(np.abs(np.diff(solution.data.angles_rad))) if len(solution.data.angles_rad) > 1 else 0.0
    places = f", {abs(value[0]) / step:.1f} steps of the turntable" if step > 0.0 else ""
    text = (
        f"scans and stripes of one place disagree by {np.rad2deg(value[0]):+.3f} degrees of the turntable{places}: "
        "scans and stripe images are not of the same places"
    )
    yield Explanation("scan-lag", text, fall, 1, *_pose_move(solution, change), float(value[0]), change)


def _moves(solution: Solution, terms: _LineTerms) -> Iterator[Explanation]:
    """The board moved (6 numbers), or the turntable slipped (1), once during the recording: the best moment of each."""
    data = solution.data
    since = _since(terms, len(data.positions))
    board = np.zeros((12, 6))
    board[6:] = np.eye(6)
    slip = np.concatenate([_axis_twist(solution), np.zeros(6)])[:, None]
    for key, twist in (("moved-board", board), ("slip", slip)):
        best: tuple[float, int, FloatArray, FloatArray] | None = None
        for first in range(2, len(data.positions) - 1):
            tested = _explained(solution, twist, *(sums[first] for sums in since))
            if tested is not None and (best is None or tested[0] > best[0]):
                best = (tested[0], first, tested[1], tested[2])
        if best is not None:
            yield _move_found(solution, key, *best)


def _move_found(
    solution: Solution, key: str, fall: float, first: int, value: FloatArray, change: FloatArray
) -> Explanation:
    before, after = solution.data.positions[first - 1], solution.data.positions[first]
    where = f"between positions {before} and {after}"
    if key == "slip":
        size = float(value[0])
        text = f"the turntable slipped or its reading jumped by {np.rad2deg(size):+.3f} degrees {where}"
        return Explanation(key, text, fall, 1, *_pose_move(solution, change), size, change)
    middle = np.mean([p @ c for p, c in zip(solution.state.panels, solution.data.centres, strict=True)], axis=0)
    shift = float(np.linalg.norm(value[:3] + np.cross(value[3:], middle)))
    turn = float(np.rad2deg(np.linalg.norm(value[3:])))
    text = f"board or camera moved {where}, by about {1e3 * shift:.1f} mm and {turn:.2f} degrees"
    return Explanation(key, text, fall, 6, *_pose_move(solution, change), shift, change)


def _panel_scales(solution: Solution, terms: _LineTerms) -> Iterator[Explanation]:
    """One panel's squares are of another size: the panel moves along the line of sight of its middle."""
    numbers = sorted({slot.panel for slot in solution.data.slots})
    if len(numbers) < 2:
        return
    for number in numbers:
        twists = np.zeros((len(terms.place), 12, 1))
        for k, slot in enumerate(solution.data.slots):
            if slot.panel != number:
                continue
            middle = solution.state.panels[k] @ solution.data.centres[k]
            mine = terms.panel == number
            twists[mine, 6:9, 0] = middle
        tested = _tested_each(solution, terms, twists)
        if tested is None:
            continue
        fall, value, change = tested
        text = (
            f"the squares of panel {number + 1} seem to be {1.0 + value[0]:.3f} times their stated size "
            "(the other panel's held)"
        )
        yield Explanation("panel-scale", text, fall, 1, *_pose_move(solution, change), float(value[0]), change)


def _tested(
    solution: Solution, terms: _LineTerms, which: BoolArray, twist: FloatArray
) -> tuple[float, FloatArray, FloatArray] | None:
    """`twist` (12, m): how the added parameters move the place and the panel of the lines `which` (S,)."""
    sums = (part[which].sum(axis=0) for part in (terms.own, terms.gradient, terms.cross))
    return _explained(solution, twist, *sums)


def _explained(
    solution: Solution, twist: FloatArray, own: FloatArray, gradient: FloatArray, cross: FloatArray
) -> tuple[float, FloatArray, FloatArray] | None:
    """The same from the sums (12, 12), (12,) and (12, n) over those lines."""
    return _explain(solution, twist.T @ own @ twist, twist.T @ gradient, twist.T @ cross)


def _since(terms: _LineTerms, places: int) -> tuple[FloatArray, ...]:
    """Sums (P, ...) of the lines' equations from each place on to the last."""
    sums = []
    for part in (terms.own, terms.gradient, terms.cross):
        of_place = np.zeros((places, *part.shape[1:]))
        np.add.at(of_place, terms.place, part)
        sums.append(np.cumsum(of_place[::-1], axis=0)[::-1])
    return tuple(sums)


def _tested_each(
    solution: Solution, terms: _LineTerms, twists: FloatArray
) -> tuple[float, FloatArray, FloatArray] | None:
    """The same with a twist (S, 12, m) of each line's own."""
    turned = np.swapaxes(twists, 1, 2)
    own = (turned @ terms.own @ twists).sum(axis=0)
    gradient = (turned @ terms.gradient[:, :, None])[:, :, 0].sum(axis=0)
    return _explain(solution, own, gradient, (turned @ terms.cross).sum(axis=0))
