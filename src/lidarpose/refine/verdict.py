"""Is the joint estimate good? Residuals, covariance, stability and contradictions, each with its reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarpose.model.calibration import Quality, Verdict
from lidarpose.model.turntable_result import Direction, ExtraParameter, Kind, NoiseEstimate
from lidarpose.refine.drift import Drift
from lidarpose.refine.named_effect import NamedEffect
from lidarpose.refine.observability import PoseSpread
from lidarpose.refine.stability import Stability

_DOUBTFUL: dict[Kind, float] = {"corners": 0.7, "stripes": 1.0, "ranges": 0.015}
_REJECTED: dict[Kind, float] = {"corners": 3.0, "stripes": 4.0, "ranges": 0.1}
"""Scatter (px, px, m) beyond which no working instrument explains the residuals any more."""
_PLACE_DOUBTFUL: dict[Kind, float] = {"stripes": 0.6, "ranges": 0.004}
_PLACE_REJECTED: dict[Kind, float] = {"stripes": 3.0, "ranges": 0.03}
"""The same for what whole lines are off by."""
_WHAT: dict[Kind, str] = {"corners": "chessboard corners", "stripes": "stripe pixels", "ranges": "ranges"}
_ORDER: tuple[Verdict, ...] = ("good", "doubtful", "rejected")


@dataclass(frozen=True, eq=False)
class Evidence:
    """Everything that the verdict looks at."""

    noise: Mapping[Kind, NoiseEstimate]
    range_sigma_m: float | None
    inside: PoseSpread
    around: PoseSpread
    want_mm: float
    want_deg: float
    converged: bool
    lines_offered: Mapping[Kind, int]
    lines_left_out: Mapping[Kind, int]
    extras: Sequence[ExtraParameter]
    stability: Stability | None
    directions: Sequence[Direction]
    findings: Sequence[str] = ()
    duplicates: Sequence[str] = ()
    places: int = 0
    drift: Drift | None = None
    effects: Sequence[NamedEffect] = ()
    effect_shift: tuple[float, float] = (0.0, 0.0)
    reading_sigma_rad: float = 0.0
    unseen: str | None = None


class _Judge:
    def __init__(self) -> None:
        self.level = 0
        self.reasons: list[str] = []

    def object(self, level: int, reason: str) -> None:
        self.level = max(self.level, level)
        self.reasons.append(reason)

    def note(self, reason: str) -> None:
        self.reasons.append(reason)


def judge(evidence: Evidence) -> Quality:
    """The verdict with its reasons and figures."""
    jury = _Judge()
    for finding in evidence.findings:
        jury.object(2, finding)
    for same in evidence.duplicates:
        jury.object(1, same)
    if not evidence.findings:
        _judge_effect(jury, evidence)
    if not evidence.converged:
        jury.object(1, "the estimate did not converge")
    for kind, noise in evidence.noise.items():
        _judge_noise(jury, kind, noise, evidence)
    _judge_left_out(jury, evidence)
    _judge_drift(jury, evidence)
    _judge_size(jury, evidence)
    _judge_stability(jury, evidence)
    if evidence.reading_sigma_rad > 0.0 and not evidence.effects:
        scatter = f"{np.rad2deg(evidence.reading_sigma_rad):.2g} degrees from place to place"
        jury.note(f"note: the turntable's readings are off by about {scatter}, which the standard deviations contain")
    if evidence.unseen is not None and not evidence.effects:
        jury.note(f"note: {evidence.unseen}")
    return Quality(_ORDER[jury.level], tuple(jury.reasons), _figures(evidence))


def _amount(kind: Kind, value: float) -> str:
    return f"{1e3 * value:.2f} mm" if kind == "ranges" else f"{value:.2f} px"


def _judge_noise(jury: _Judge, kind: Kind, noise: NoiseEstimate, evidence: Evidence) -> None:
    scatter = f"{_WHAT[kind]} scatter by {_amount(kind, noise.sigma)}"
    if noise.sigma > _REJECTED[kind]:
        jury.object(2, f"{scatter}: they do not belong to this geometry")
    elif noise.sigma > _DOUBTFUL[kind]:
        jury.object(1, f"{scatter}, more than a sound recording shows")
    elif kind == "ranges" and evidence.range_sigma_m and noise.sigma > 2.5 * evidence.range_sigma_m:
        jury.object(1, f"{scatter}, but {_amount(kind, evidence.range_sigma_m)} was stated for the LiDAR")
    off = noise.place_sigma
    if kind == "corners" or off <= 0.0:
        return
    words = f"{_WHAT[kind]} of whole places are off by {_amount(kind, off)} beyond their scatter"
    if off > _PLACE_REJECTED[kind]:
        jury.object(2, f"{words}: boards, scans and readings contradict each other")
    elif off > _PLACE_DOUBTFUL[kind] or off > 1.5 * noise.sigma:
        jury.object(1, words)


def _judge_left_out(jury: _Judge, evidence: Evidence) -> None:
    for kind, offered in evidence.lines_offered.items():
        gone = evidence.lines_left_out.get(kind, 0)
        if gone > max(0.15 * offered, 1.0):
            jury.object(1, f"{gone} of {offered} lines ({_WHAT[kind]}) contradict the others and were left out")
    for kind, noise in evidence.noise.items():
        share = 1.0 - noise.used / max(noise.count, 1)
        if share > 0.3:
            jury.object(1, f"{share:.0%} of the {_WHAT[kind]} had to be left out as outliers")
        elif share > 0.03:
            jury.note(f"note: {share:.0%} of the {_WHAT[kind]} were left out as outliers")


_DRIFT_DOUBTFUL, _DRIFT_REJECTED = 8.0, 400.0


def _judge_drift(jury: _Judge, evidence: Evidence) -> None:
    if evidence.drift is None or evidence.drift.ratio < _DRIFT_DOUBTFUL:
        return
    level = 2 if evidence.drift.ratio > _DRIFT_REJECTED else 1
    jury.object(
        level,
        "what lines are off by changes smoothly over the arc, "
        f"{evidence.drift.ratio:.0f} times as much as from place to place: the geometry does not fit",
    )


def _judge_effect(jury: _Judge, evidence: Evidence) -> None:
    if not evidence.effects:
        return
    first, *others = evidence.effects
    shift_m, turn_rad = evidence.effect_shift
    amount = f"{1e3 * shift_m:.2g} mm and {np.rad2deg(turn_rad):.2g} degrees"
    paid = f"the pose inside the arc would move by {amount} with it, which the standard deviations contain"
    nearly = "".join(f"; or, which explains it nearly as well: {other.text}" for other in others)
    if any(effect.serious for effect in evidence.effects):
        jury.object(1, f"{first.text}{nearly}; {paid}")
    else:
        jury.note(f"note: {first.text}{nearly}; it can be estimated; {paid}")


def _judge_size(jury: _Judge, evidence: Evidence) -> None:
    mm = 1e3 * float(evidence.inside.position_m.max())
    deg = float(np.rad2deg(evidence.inside.rotation_rad.max()))
    if mm <= evidence.want_mm and deg <= evidence.want_deg:
        return
    remedy = f" {evidence.directions[0].remedy}" if evidence.directions else ""
    weakest = f"; the weakest is {evidence.directions[0].name}." if evidence.directions else "."
    level = 2 if mm > 25.0 * evidence.want_mm or deg > 25.0 * evidence.want_deg else 1
    jury.object(
        level,
        f"inside the recorded arc the pose is known to {mm:.2g} mm and {deg:.2g} degrees only "
        f"(wanted {evidence.want_mm:g} mm and {evidence.want_deg:g} degrees){weakest}{remedy}",
    )


def _judge_stability(jury: _Judge, evidence: Evidence) -> None:
    s = evidence.stability
    if (
        s is not None
        and s.ratio > 4.0
        and (s.shift_mm > 0.1 * evidence.want_mm or s.turn_deg > 0.1 * evidence.want_deg)
    ):
        jury.object(
            1,
            f"without {s.without} the pose would move by {s.shift_mm:.2f} mm and {s.turn_deg:.3f} degrees, "
            f"{s.ratio:.0f} times what the noise explains",
        )


def _figures(evidence: Evidence) -> dict[str, Any]:
    half = _at_half_turn(evidence.around)
    return {
        "sigma_inside_arc_mm": 1e3 * float(evidence.inside.position_m.max()),
        "sigma_inside_arc_deg": float(np.rad2deg(evidence.inside.rotation_rad.max())),
        "sigma_half_a_turn_away_mm": 1e3 * half[0],
        "sigma_half_a_turn_away_deg": float(np.rad2deg(half[1])),
        "want_mm": evidence.want_mm,
        "want_deg": evidence.want_deg,
        "places": evidence.places,
        "reading_sigma_deg": float(np.rad2deg(evidence.reading_sigma_rad)),
        "drift_ratio": None if evidence.drift is None else evidence.drift.ratio,
        "noise": {
            kind: {
                "unit": "mm" if kind == "ranges" else "px",
                "sigma": n.sigma * (1e3 if kind == "ranges" else 1.0),
                "sigma_of_whole_lines": n.place_sigma * (1e3 if kind == "ranges" else 1.0),
                "times_stated": n.factor,
                "neighbours_worth_one": n.rows_as_one,
                "used": n.used,
                "offered": n.count,
            }
            for kind, n in evidence.noise.items()
        },
        "weak_directions": [
            {
                "name": d.name,
                "sigma_mm": d.sigma_mm,
                "sigma_deg": d.sigma_deg,
                "at_deg": d.angle_deg,
                "remedy": d.remedy,
            }
            for d in evidence.directions
        ],
        "extra_parameters": {
            e.name: {"value": e.value, "sigma": e.sigma, "estimated": e.estimated, "suggested": e.suggested}
            for e in evidence.extras
            if e.observable
        },
        "stability": None
        if evidence.stability is None
        else {
            "without": evidence.stability.without,
            "shift_mm": evidence.stability.shift_mm,
            "turn_deg": evidence.stability.turn_deg,
            "times_expected": evidence.stability.ratio,
        },
    }


def _at_half_turn(around: PoseSpread) -> tuple[float, float]:
    return float(around.position_m[0]), float(around.rotation_rad[0])
