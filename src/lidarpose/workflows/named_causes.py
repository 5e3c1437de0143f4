"""What may be wrong with a session in which no scan line finds its panel: the usual mistakes, tried one at a time.

A session that is refused because nothing fits is of little help to the person who recorded it. Units, a table that did
not turn, readings in another unit and scans in reverse each leave a mark of their own, and the one that explains the
session is named.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from lidarpose.errors import AmbiguousError, UndeterminedError
from lidarpose.model.observation import LeftOut, PlaceFeatures
from lidarpose.model.session import TurntableSession
from lidarpose.workflows.reversed_scans import Solved, describe_reversed, reversed_part

Places = Sequence[PlaceFeatures]
# How many of the places given find their scan lines, and their root mean square misfit in sigmas.
Tried = tuple[int, float]

_STILL_PX = 1.0
_TURNED_RAD = np.deg2rad(0.5)
_MOST_USED = 0.7
# Two mirrored solutions whose misfit is below this explain the session: it lacks evidence and nothing is wrong with it.
_EXPLAINED_SIGMAS = 6.0
# A mistake is named instead of an ambiguity only if mending it leaves this share of the misfit.
_CLEARLY_LESS = 0.3
# A whole turn in radians, taken for degrees.
_RADIANS_SPAN = 2.0 * np.pi
_RANGES = ((1e-3, "millimetres"), (1e-2, "centimetres"), (0.0254, "inches"), (0.3048, "feet"))
_READINGS = (
    (2.0, "half of what they should be"),
    (0.5, "twice what they should be"),
    (180.0 / np.pi, "radians, not degrees"),
    (np.pi / 180.0, "degrees that were turned into degrees once more"),
    (10.0, "a tenth of what they should be"),
    (0.1, "ten times what they should be"),
)


def with_cause_named(
    error: UndeterminedError,
    session: TurntableSession,
    places: Places,
    left_out: Sequence[LeftOut],
    assign: Callable[[Places], Tried],
    solve: Callable[[Places], Solved],
) -> UndeterminedError:
    """The error, or one that names its cause.

    Parameters
    ----------
    places, left_out
        What detection found, and what it gave up.
    assign, solve
        Scan lines to panels, and the closed form, of some places as they are given; both may raise UndeterminedError.
    """
    if isinstance(error, AmbiguousError) and error.misfit_sigmas < _EXPLAINED_SIGMAS:
        return error
    if not places and left_out:
        often, count = Counter(item.reason for item in left_out).most_common(1)[0]
        return UndeterminedError(f"No place can be used: {often} ({count} times)", remedy=error.remedy)
    most = _CLEARLY_LESS * error.misfit_sigmas if isinstance(error, AmbiguousError) else float("inf")
    cause = _cause(session, places, lambda tried: _fits(tried, assign, most), solve)
    if cause is None:
        return error
    what, remedy = cause
    return UndeterminedError(what, remedy=remedy, details=(error.what,))


def _cause(
    session: TurntableSession,
    places: Places,
    fits: Callable[[Places], bool],
    solve: Callable[[Places], Solved],
) -> tuple[str, str] | None:
    if not any(place.stripes for place in places):
        return None
    if stands_still(places):
        return (
            "The turntable did not turn: readings differ, but the stripe stays where it is in the image",
            "Check that the table moves and that each row of positions.csv names its own image and scan",
        )
    for factor, unit in _RANGES:
        if fits([_scaled(place, factor) for place in places]):
            return f"The ranges are in {unit}: so taken, the scans fit", "Write the scans in metres"
    for factor, words in _READINGS:
        turned = [replace(p, turntable_angle_rad=factor * p.turntable_angle_rad) for p in places]
        if fits(turned):
            return (
                f"The turntable's readings are {words}: multiplied by {factor:.4g} they fit",
                "Write the true readings in degrees into positions.csv",
            )
    if (span := _widest_scan_deg(session)) < _RADIANS_SPAN:
        return (
            f"The beam angles of every scan span {span:.1f} degrees or less: they look like radians",
            "Write the beams' angles in degrees into the scans",
        )
    by_name = {place.position: place for place in places}
    reverse = reversed_part(session, list(by_name), lambda names: solve([by_name[name] for name in names]))
    if reverse:
        return (
            f"The scans contradict each other: {describe_reversed(reverse)}",
            "Mend these files (negate their beam angles, or reverse their ranges) and calibrate again",
        )
    return None


def _widest_scan_deg(session: TurntableSession) -> float:
    """What the widest scan spans."""
    spans = [np.ptp(place.scan.load().angle_rad) for place in session.places if place.scan is not None]
    return float(np.rad2deg(max(spans, default=np.inf)))


def stands_still(places: Places) -> bool:
    """Whether all stripes lie at the same place, and the scans' lines too, although the readings differ."""
    lit = sorted((place for place in places if place.stripes), key=lambda place: place.turntable_angle_rad)
    if len(lit) < 2 or np.ptp([place.turntable_angle_rad for place in lit]) < _TURNED_RAD:
        return False
    for panel in {k for place in lit for k in place.stripes}:
        middles = np.array([np.median(p.stripes[panel].pixels, axis=0) for p in lit if panel in p.stripes])
        if np.ptp(middles, axis=0).max() > _STILL_PX:
            return False
    # Where the table's axis is square to the scan plane, the stripe stays although the table turns.
    first, last = (np.array([line.angle_rad.mean() for line in lit[k].lines]) for k in (0, -1))
    if len(first) == 0 or len(last) == 0:
        return True
    return bool(np.median(np.abs(first[:, None] - last).min(axis=1)) < _TURNED_RAD)


def _fits(places: Places, assign: Callable[[Places], Tried], most_sigmas: float) -> bool:
    """Whether most places find their scan lines, with a misfit below the given one."""
    try:
        found, misfit_sigmas = assign(places)
    except UndeterminedError:
        return False
    return found >= max(3.0, _MOST_USED * len(places)) and misfit_sigmas < most_sigmas


def _scaled(place: PlaceFeatures, factor: float) -> PlaceFeatures:
    lines = tuple(replace(s, range_m=factor * s.range_m, sigma_m=factor * s.sigma_m) for s in place.lines)
    return replace(place, lines=lines)
