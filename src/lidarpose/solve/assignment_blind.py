"""The choice of scan lines where the camera sees no stripe: from boards and scans alone.

One placement of a V board leaves the LiDAR's place along the fold free, and the mirrored choice as good as the true
one. Two or more placements, differently turned, fix both: the order of the lines is tried for every placement, and the
motion that puts all lines on their panels decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.planes import Plane
from lidarpose.model.observation import PlaceFeatures, TurntableObservations
from lidarpose.model.targets import Panel
from lidarpose.model.turntable import TurntableMotion
from lidarpose.solve.line_pair import FittedLine, fit_scan_line, free_directions
from lidarpose.solve.panel_pose import PanelPose
from lidarpose.solve.planes_only import PlaceOnPlanes, PlanesOnlySolution, solve_planes_only

# Beyond the outermost corners a panel may go on for this many squares.
MARGIN_SQUARES = 3.0
# Orders are tried for so many placements together; the others follow from the motion.
TRIED_PLACEMENTS = 3
# As for solutions with stripes: half the residual, and no chance.
LEAST_RATIO = 2.0
# A place whose lines lie this many sigmas (times what the others show) off their panels is left out.
SUPPORT_SIGMAS = 6.0
FOLD_SLACK_M = 0.03


@dataclass(frozen=True, eq=False)
class BlindChoice:
    """By place: the indices of the lines on panel 0 and panel 1; why other places were left out; the motion."""

    lines: Mapping[int, tuple[int, int]]
    reasons: Mapping[int, str]
    motion: TurntableMotion
    figures: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two lines of one place that may be the board: the one of smaller beam angle first."""

    place: int
    lines: tuple[int, int]
    fits: tuple[FittedLine, FittedLine]


def choose_without_stripes(
    panels: Sequence[Panel],
    panel_poses: Mapping[str, Sequence[PanelPose]],
    places: Sequence[PlaceFeatures],
    *,
    first_panel: int | None = None,
) -> BlindChoice:
    """Find the board's two lines at every place, and which panel each lies on, without any stripe.

    Raises
    ------
    UndeterminedError
        If the board had one placement only, or nothing tells two choices apart.
    """
    names = sorted({p.placement for p in places})
    if len(names) < 2:
        raise UndeterminedError(
            "No stripe was found at any place, and boards and scans alone leave the LiDAR free to slide along the fold",
            remedy="Make the laser's stripe visible (dark room, long exposure, no infrared filter), or record two or "
            "more placements of the board, turned differently: board/<name>/*.png, and in positions.csv a placement",
        )
    reasons: dict[int, str] = {}
    pairs: list[_Pair] = []
    for k, place in enumerate(places):
        pair = _board_like(k, place, _reach(panels))
        if pair is None:
            reasons[k] = "no two lines of the scan are like a folded board's"
        else:
            pairs.append(pair)
    tried = names[:TRIED_PLACEMENTS]
    solutions: list[tuple[float, PlanesOnlySolution]] = []
    for order in [(first_panel,) * len(tried)] if first_panel is not None else list(product((0, 1), repeat=len(tried))):
        first = dict(zip(tried, order, strict=True))
        some = [p for p in pairs if places[p.place].placement in first]
        on_planes = [_on_planes(p, places, panels, panel_poses, first[places[p.place].placement]) for p in some]
        try:
            solutions += [(s.rms, s) for s in solve_planes_only(on_planes)]
        except ValueError:
            continue
    solutions.sort(key=lambda item: item[0])
    _require_one(solutions)
    return _all_places(solutions[0][1], pairs, places, panels, panel_poses, reasons, [s[0] for s in solutions])


def motion_without_stripes(
    observations: TurntableObservations, panel_poses: Mapping[str, Sequence[PanelPose]]
) -> TurntableMotion:
    """A start for the joint estimate of a session without stripes, from lines that have found their panels.

    Raises
    ------
    UndeterminedError
        If no motion, or more than one, fits.
    """
    places = []
    for place in observations.places:
        if not {0, 1} <= set(place.scan_lines):
            continue
        fits = (fit_scan_line(place.scan_lines[0]), fit_scan_line(place.scan_lines[1]))
        feature = PlaceFeatures(place.position, place.turntable_angle_rad, {}, (), place.placement)
        places.append(_on_planes(_Pair(0, (0, 1), fits), [feature], observations.panels, panel_poses, 0))
    try:
        solutions = [(s.rms, s) for s in solve_planes_only(places)] if len(places) >= 3 else []
    except ValueError:
        solutions = []
    _require_one(solutions)
    return solutions[0][1].motion


def _require_one(solutions: list[tuple[float, PlanesOnlySolution]]) -> None:
    remedy = "Record more placements of the board, turned differently, and more readings; or make the stripe visible"
    if not solutions:
        raise UndeterminedError("No motion of the LiDAR puts the scan lines on the panels", remedy=remedy)
    if len(solutions) > 1 and solutions[1][0] < LEAST_RATIO * max(solutions[0][0], 0.02):
        raise UndeterminedError(
            "Without a visible stripe several motions, or several choices of scan lines, fit equally well",
            remedy=f"{remedy}; if only the order is open, --first-panel tells it",
        )


def _reach(panels: Sequence[Panel]) -> tuple[float, float]:
    reach = [
        float(np.hypot(p.columns - 1, p.rows - 1)) * p.square_m / 2.0 + MARGIN_SQUARES * p.square_m for p in panels
    ]
    return reach[0], reach[1]


def _board_like(index: int, place: PlaceFeatures, reach: tuple[float, float]) -> _Pair | None:
    """The two lines of a place that look most like a V seen from inside; None if none do."""
    fits = [fit_scan_line(line, robust=False) for line in place.lines]
    order = np.argsort([float(np.mean(line.angle_rad)) for line in place.lines], kind="stable")
    best: tuple[float, _Pair] | None = None
    for i, j in permutations(order.tolist(), 2):
        if place.lines[i].angle_rad[0] > place.lines[j].angle_rad[0]:
            continue
        gap = _gap(fits[i], fits[j], max(reach))
        if gap is not None and (best is None or gap < best[0]):
            best = (gap, _Pair(index, (i, j), (fits[i], fits[j])))
    return best[1] if best is not None else None


def _gap(first: FittedLine, second: FittedLine, reach: float) -> float | None:
    """How far two lines stay from their common point; None if they are no V around the LiDAR's view."""
    try:
        directions = free_directions(first, second)
    except ValueError:
        return None
    E = first.line.intersection(second.line)
    angle = float(np.arccos(np.clip(directions[0] @ directions[1], -1.0, 1.0)))
    if not np.deg2rad(20.0) < angle < np.deg2rad(175.0):
        return None
    total = 0.0
    for fit, direction, other in ((first, directions[0], directions[1]), (second, directions[1], directions[0])):
        near, far = np.sort((fit.ends - E) @ direction)
        # The LiDAR, at the origin, must stand on the side of each line that the other line is on.
        across = float((-E - (-E @ direction) * direction) @ other)
        if near < -FOLD_SLACK_M or near > 0.5 * reach or far > 2.0 * reach or across <= 0.0:
            return None
        total += abs(float(near))
    return total


def _on_planes(
    pair: _Pair,
    places: Sequence[PlaceFeatures],
    panels: Sequence[Panel],
    panel_poses: Mapping[str, Sequence[PanelPose]],
    first_panel: int,
) -> PlaceOnPlanes:
    place = places[pair.place]
    T = [panel_poses[place.placement][key].T_camera_panel for key in (0, 1)]
    fits = pair.fits if first_panel == 0 else (pair.fits[1], pair.fits[0])
    middles: list[FloatArray] = [t @ p.corners_panel().mean(axis=0) for t, p in zip(T, panels, strict=False)]
    return PlaceOnPlanes(
        place.turntable_angle_rad,
        fits,
        (Plane.from_pose(T[0]), Plane.from_pose(T[1])),
        (middles[0], middles[1]),
        _reach(panels),
    )


def _all_places(
    best: PlanesOnlySolution,
    pairs: Sequence[_Pair],
    places: Sequence[PlaceFeatures],
    panels: Sequence[Panel],
    panel_poses: Mapping[str, Sequence[PanelPose]],
    reasons: dict[int, str],
    rms: list[float],
) -> BlindChoice:
    """Every place's order by the motion that was found; places that fit neither way are left out."""
    lines: dict[int, tuple[int, int]] = {}
    for pair in pairs:
        off = [_off(best.motion, _on_planes(pair, places, panels, panel_poses, first)) for first in (0, 1)]
        if min(off) > SUPPORT_SIGMAS * max(1.0, best.rms):
            reasons[pair.place] = "its scan lines do not fit the motion of the other places"
            continue
        i, j = pair.lines
        lines[pair.place] = (i, j) if off[0] <= off[1] else (j, i)
    figures = {"solutions": float(len(rms)), "rms_sigmas": rms[0]}
    if len(rms) > 1:
        figures["rival_rms_sigmas"] = rms[1]
    return BlindChoice(lines, reasons, best.motion, figures)


def _off(motion: TurntableMotion, place: PlaceOnPlanes) -> float:
    """Root mean square of a place's four standardised residuals."""
    T = motion.pose(place.angle_rad)
    squares = []
    for line, plane in zip(place.lines, place.panels, strict=True):
        across = plane.distance(T @ np.array([*line.middle, 0.0])) / np.hypot(line.offset_sigma_m, 2e-4)
        tilt = plane.normal @ T.rotate(np.array([*line.line.direction, 0.0])) / np.hypot(line.direction_sigma_rad, 3e-4)
        squares += [float(across) ** 2, float(tilt) ** 2]
    return float(np.sqrt(np.mean(squares)))
