"""The effect that would explain misfit best: named in the verdict, and paid for in the covariance.

An effect that residuals show but the estimate does not model (a bias on black squares, an offset of the ranges, a board
that moved) shifts the answer by far more than the noise does. How far is known: one linear step with the effect as a
parameter. The estimate with the effect and the one without it are two readings of the same data, and the distance of
the two, squared, is added to the covariance; it then holds whichever of them is right. Effects that explain the misfit
nearly as well are named and paid for too: data that cannot tell an offset of the ranges from a factor on the beam
angles do not know the pose better than the two differ.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.turntable import PARAMETER_NAMES
from lidarpose.model.turntable_result import ExtraParameter
from lidarpose.refine.contradictions import Explanation
from lidarpose.refine.joint_options import JointOptions
from lidarpose.refine.observability import PoseSpread
from lidarpose.refine.turntable_estimate import OutsideParameters, extra_effect, move_of_extra
from lidarpose.refine.turntable_joint import Solution

EXTRA_WORDS: dict[str, str] = {
    "encoder_scale": "the turntable's readings seem to be off by a factor",
    "range_offset_m": "the ranges seem to have an offset",
    "range_scale": "ranges and board disagree in scale (size of the squares, or unit of the ranges)",
    "beam_angle_scale": "the beam angles seem to be off by a factor (rounded angular step)",
    "black_bias_m": "ranges on black squares differ from those on white ones",
    "focal_scale": "the camera's focal length does not fit the board",
    "centre_x_px": "the camera's principal point does not fit the board (x)",
    "centre_y_px": "the camera's principal point does not fit the board (y)",
}
_TOLERATED: dict[str, float] = {
    "encoder_scale": 2e-3,
    "range_offset_m": 2e-3,
    "range_scale": 3e-3,
    "beam_angle_scale": 2e-3,
    "black_bias_m": 3e-4,
    "focal_scale": 4e-3,
    "centre_x_px": 8.0,
    "centre_y_px": 8.0,
}
_SURE = 5.0
_SURE_OF_LARGE = 3.5
"""An effect beyond what is tolerated shifts the pose by far more than noise does: one that chance makes in one session
of two hundred (eight are looked for) is sooner real."""
_SEARCH_PRICE = {"moved-board": 8.0, "slip": 8.0}
_NEARLY_AS_GOOD = 20.0
"""Falls of the weighted sum of squares that differ by less (a likelihood ratio of 22 000) do not settle which it is."""


@dataclass(frozen=True, eq=False)
class NamedEffect:
    """What would explain the misfit.

    Attributes
    ----------
    text
        In words, with its size.
    serious
        Whether it spoils the verdict; if not it is worth a note.
    move : (n,)
        How the parameters of `OutsideParameters` would change with it.
    encoder_scale
        What the readings' scale would be beside 1, for an effect of that kind.
    """

    text: str
    serious: bool
    move: FloatArray
    encoder_scale: float = 0.0


def strongest_effects(
    solution: Solution,
    outside: OutsideParameters,
    options: JointOptions,
    extras: Sequence[ExtraParameter],
    explanations: Sequence[Explanation],
) -> tuple[NamedEffect, ...]:
    """Of the single changes that would explain misfit the best, and what is nearly as good; none where none does.

    The others are not named: effects resemble each other.
    """
    candidates = [
        *_from_extras(solution, outside, extras),
        *((fall, _from_explanation(outside, e)) for fall, e in _that_matter(explanations, options)),
    ]
    candidates.sort(key=lambda c: -c[0])
    return tuple(effect for score, effect in candidates if score > candidates[0][0] - _NEARLY_AS_GOOD)


def paid_for(outside: OutsideParameters, effects: Sequence[NamedEffect], reference_rad: float) -> OutsideParameters:
    """The same with the effects' shifts, squared, in the covariance.

    A scale of the readings that is seen spoils the pose by the distance from the recorded arc, which no covariance of
    the ten numbers says: it becomes a parameter of its own then, of value 1, counted from `reference_rad`.
    """
    moves = [e.move for e in effects]
    if any(e.encoder_scale for e in effects) and "encoder_scale" not in outside.names:
        at = len(PARAMETER_NAMES)
        names = (*outside.names[:at], "encoder_scale", *outside.names[at:])
        covariance = np.insert(np.insert(outside.covariance, at, 0.0, axis=0), at, 0.0, axis=1)
        motion = replace(outside.motion, reading_origin_rad=reference_rad)
        outside = replace(outside, names=names, covariance=covariance, motion=motion)
        moves = [np.insert(e.move, at, e.encoder_scale) for e in effects]
    return replace(outside, covariance=outside.covariance + sum(np.outer(move, move) for move in moves))


def shift_of(outside: OutsideParameters, effect: NamedEffect, reading_rad: float) -> tuple[float, float]:
    """How far (m, rad) the LiDAR's pose at a reading would move with the effect."""
    xi = outside.motion.pose_jacobian(reading_rad) @ effect.move[:10]
    centre = outside.motion.pose(reading_rad).translation
    return float(np.linalg.norm(xi[:3] + np.cross(xi[3:], centre))), float(np.linalg.norm(xi[3:]))


def unseen_range_errors(
    solution: Solution, outside: OutsideParameters, extras: Sequence[ExtraParameter], want_mm: float
) -> str | None:
    """Systematic errors of the ranges that would move the pose by more than is wanted and leave no mark, in words."""
    found = []
    for extra in extras:
        amount = _TOLERATED[extra.name]
        seen = extra.estimated or (extra.observable and _SURE_OF_LARGE * extra.sigma < amount)
        if seen or extra.name not in ("range_offset_m", "range_scale"):
            continue
        shift_mm = 1e3 * extra_effect(solution, outside, extra.name, amount)[0]
        if shift_mm > want_mm:
            by = f"{1e3 * amount:.0f} mm" if extra.name == "range_offset_m" else f"{100 * amount:.1f} %"
            found.append(f"were they all too long by {by}, the pose would move by {shift_mm:.1f} mm")
    if not found:
        return None
    return f"these data do not show whether the ranges are true: {', and '.join(found)}"


def _from_extras(
    solution: Solution, outside: OutsideParameters, extras: Sequence[ExtraParameter]
) -> Iterator[tuple[float, NamedEffect]]:
    for extra in extras:
        large = abs(extra.value) > _TOLERATED[extra.name]
        sure = _SURE_OF_LARGE if large else _SURE
        if extra.estimated or not extra.observable or abs(extra.value) <= sure * extra.sigma:
            continue
        if not large and not extra.suggested:
            continue
        text = f"{EXTRA_WORDS[extra.name]}: {describe_extra(extra)}{_mirror_hint(extra, solution)}"
        if extra.name == "encoder_scale":
            text += " (the farther from the recorded arc, the more it spoils the pose)"
        move = move_of_extra(solution, outside, extra.name, extra.value)
        scale = extra.value if extra.name == "encoder_scale" else 0.0
        yield (extra.value / extra.sigma) ** 2 - _price(1), NamedEffect(text, large, move, scale)


def _that_matter(explanations: Sequence[Explanation], options: JointOptions) -> Iterator[tuple[float, Explanation]]:
    for e in explanations:
        matters = 1e3 * e.shift_m > 0.25 * options.want_mm or np.rad2deg(e.turn_rad) > 0.25 * options.want_deg
        if e.strength > _SURE and matters:
            yield e.fall - _price(e.freedom) - _SEARCH_PRICE.get(e.key, 0.0), e


def _from_explanation(outside: OutsideParameters, explanation: Explanation) -> NamedEffect:
    return NamedEffect(explanation.text, True, outside.from_inside @ explanation.change)


def _price(freedom: int) -> float:
    """What each further number has to earn before it is believed (Schwarz, 1978, with some 300 lines)."""
    return 5.7 * freedom


def _mirror_hint(extra: ExtraParameter, solution: Solution) -> str:
    camera = solution.data.camera
    mirrored = {
        "centre_x_px": camera.width - 1 - 2.0 * camera.cx,
        "centre_y_px": camera.height - 1 - 2.0 * camera.cy,
    }.get(extra.name)
    if mirrored is None or abs(mirrored) < _TOLERATED[extra.name]:
        return ""
    near = abs(extra.value - mirrored) < max(4.0 * extra.sigma, 2.0)
    return "; just what a mirrored image would show" if near else ""


def describe_extra(extra: ExtraParameter) -> str:
    """Value and standard deviation in the units that people read."""
    if extra.name.endswith("_m"):
        return f"{1e3 * extra.value:+.2f} mm (standard deviation {1e3 * extra.sigma:.2f} mm)"
    if extra.name.endswith("_px"):
        return f"{extra.value:+.1f} px (standard deviation {extra.sigma:.1f} px)"
    return f"{100.0 * extra.value:+.2f} % (standard deviation {100.0 * extra.sigma:.2f} %)"


def suggested(extra: ExtraParameter, effect: tuple[float, float], inside: PoseSpread) -> bool:
    """Do the residuals call for this parameter, and would the pose notice?"""
    if extra.estimated or not extra.observable or abs(extra.value) <= _SURE * extra.sigma:
        return False
    shift, turn = effect
    return bool(shift > 0.5 * inside.position_m.max() or turn > 0.5 * inside.rotation_rad.max())
