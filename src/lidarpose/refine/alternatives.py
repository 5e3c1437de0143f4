"""What if a file meant something else? Sessions that contradict themselves are tried under other readings of them.

Units, panels and the order of scans are tried one at a time, from a start of their own, on a part of the places and
rows. The alternative under which the contradiction is gone is named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.model.observation import PanelCorners, PlaceObservation, ScanLine, StripePoints, TurntableObservations
from lidarpose.model.turntable_result import Kind
from lidarpose.refine.joint_equations import lines_of
from lidarpose.refine.joint_options import JointOptions
from lidarpose.refine.turntable_estimate import outside_parameters, require_determined
from lidarpose.refine.turntable_joint import Solution, solve_joint
from lidarpose.refine.turntable_layout import lay_out
from lidarpose.refine.turntable_state import start_state

_MOST_PLACES = 9
_MOST_ROWS = 50
_CLEARLY_BETTER = 2.0
_FAR_M = 60.0


@dataclass(frozen=True)
class Alternative:
    """A text that names the fault, and the observations with it mended."""

    text: str
    observations: TurntableObservations


def misfit(solution: Solution) -> float:
    """Deviance of lines at their estimated noise in units of the stated one: what alternatives are compared by.

    Twice the negative log-likelihood but for constants, with a price for lines that had to be left out.
    """
    total = 0.0
    for kind, noise in solution.noise.lines.items():
        lines = lines_of(solution.data, kind)
        rows = float((noise.row_weights > 0.0).sum())
        per_line = rows / max(lines.count, 1)
        stated = float(np.median(lines.sigma[np.isfinite(lines.sigma)]))
        whole = noise.factor**2 / max(per_line, 1.0) + noise.place_variance / stated**2
        total += (rows - 2.0 * lines.count) * 2.0 * np.log(noise.factor)
        total += 2.0 * lines.count * np.log(whole)
        total += 40.0 * float((noise.line_weights == 0.0).sum())
        total += 8.0 * float((~solution.at.lines[kind].valid).sum())
    corners = solution.noise.corners
    total += 2.0 * float(sum(len(w) for w in corners.weights)) * np.log(corners.factor)
    return float(total)


def explain_by_alternative(observations: TurntableObservations, options: JointOptions) -> str | None:
    """The alternative that removes a contradiction, in words; None where none does or no restart was given.

    It has to determine the pose: what leaves it open fits too easily.
    """
    if options.restart is None:
        return None
    part = thinned_observations(observations)
    now = _try(part, options)
    lines = float(sum(len(p.stripes) + len(p.scan_lines) for p in part.places))
    if now is not None and now[1]:
        return None
    for alternative in alternatives(part):
        score = _try(alternative.observations, options)
        if score is not None and score[1] and (now is None or score[0] < now[0] - _CLEARLY_BETTER * lines):
            return alternative.text
    return None


def _try(observations: TurntableObservations, options: JointOptions) -> tuple[float, bool] | None:
    """Misfit under one reading of the files, and whether it is sound; None where it gives no solution."""
    assert options.restart is not None
    try:
        motion, panels = options.restart(observations)
        data = lay_out(observations, use_stripes=options.use_stripes)
        solution = solve_joint(
            data, start_state(data, motion, panels), replace(options, estimate=(), max_iterations=20)
        )
        return misfit(solution), solution.converged and _sound(solution) and _is_determined(solution)
    except (UndeterminedError, ValueError, np.linalg.LinAlgError):
        return None


def _is_determined(solution: Solution) -> bool:
    try:
        require_determined(solution, outside_parameters(solution))
    except UndeterminedError:
        return False
    return True


_SOUND: dict[Kind, float] = {"stripes": 0.5, "ranges": 0.004}


def _sound(solution: Solution) -> bool:
    """Whether whole lines fit to half a pixel and 4 mm: an alternative that does not explains nothing."""
    kinds = solution.noise.lines.items()
    # Beams that would have to meet their panel behind the LiDAR count as misfit, not as missing.
    if any(solution.at.lines[kind].valid.mean() < 0.8 for kind, _ in kinds):
        return False
    if any(np.sqrt(noise.place_variance) > _SOUND[kind] for kind, noise in kinds):
        return False
    return all((noise.line_weights == 0.0).mean() < 0.1 for _, noise in kinds)


def alternatives(observations: TurntableObservations) -> Iterator[Alternative]:
    """Everything that is tried."""
    yield from _units(observations)
    yield from _readings(observations)
    yield from _panels(observations)
    yield from _order(observations)


def _units(observations: TurntableObservations) -> Iterator[Alternative]:
    ranges = np.concatenate([line.range_m for p in observations.places for line in p.scan_lines.values()])
    sizes = np.concatenate([c.corners_panel.max(axis=0) for cs in observations.corners.values() for c in cs])
    if np.median(ranges) > _FAR_M:
        for factor, unit in ((1e-3, "millimetres"), (1e-2, "centimetres"), (0.0254, "inches")):
            yield Alternative(
                f"the ranges fit if they are in {unit}, not metres", _with_lines(observations, _scaled_ranges(factor))
            )
    if sizes.max() > 20.0:
        for factor, unit in ((1e-3, "millimetres"), (1e-2, "centimetres")):
            yield Alternative(
                f"the board fits if its squares are given in {unit}, not metres",
                _with_corners(observations, _scaled_squares(factor)),
            )
    for factor, unit in ((0.0254, "inches"), (0.3048, "feet"), (1e-2, "centimetres"), (1e-1, "decimetres")):
        if np.median(ranges) <= _FAR_M:
            yield Alternative(
                f"the ranges fit if they are in {unit}, not metres", _with_lines(observations, _scaled_ranges(factor))
            )


def _readings(observations: TurntableObservations) -> Iterator[Alternative]:
    words = {
        180.0 / np.pi: "the turntable's readings fit if they were radians that were read as degrees",
        np.pi / 180.0: "the turntable's readings fit if they are degrees that were taken as radians",
        2.0: "the turntable's readings fit if they are doubled",
        0.5: "the turntable's readings fit if they are halved",
        10.0: "the turntable's readings fit if they are multiplied by 10",
        0.1: "the turntable's readings fit if they are divided by 10",
    }
    for factor, text in words.items():
        yield Alternative(text, _with_readings(observations, factor))
    yield Alternative(
        "the turntable's readings and the places are in opposite order",
        _with_places(observations, [p.turntable_angle_rad for p in observations.places][::-1]),
    )


def _panels(observations: TurntableObservations) -> Iterator[Alternative]:
    if len(observations.panels) != 2:
        return
    yield Alternative(
        "the scan lines fit if each belongs to the other panel (panels swapped)",
        _mapped(observations, lambda p: replace(p, scan_lines={1 - k: v for k, v in p.scan_lines.items()})),
    )
    yield Alternative(
        "the stripes fit if each belongs to the other panel (panels swapped)",
        _mapped(observations, lambda p: replace(p, stripes={1 - k: v for k, v in p.stripes.items()})),
    )
    yield Alternative(
        "stripes and scan lines fit if the two boards are swapped",
        replace(observations, corners={name: tuple(cs[::-1]) for name, cs in observations.corners.items()}),
    )


def _order(observations: TurntableObservations) -> Iterator[Alternative]:
    """Scans against everything else: reversed in time, or some places late."""
    places = observations.places
    yield from _halves(observations)
    scans = [p.scan_lines for p in places]
    reverse = [replace(p, scan_lines=s) for p, s in zip(places, scans[::-1], strict=True)]
    yield Alternative(
        "the scans are in the opposite order of the stripe images (reversed scans)",
        replace(observations, places=tuple(reverse)),
    )


def _halves(observations: TurntableObservations) -> Iterator[Alternative]:
    places = observations.places
    first = len(places) // 2
    for half, which in ((slice(first, None), "second"), (slice(0, first), "first")):
        flipped = list(places)
        flipped[half] = [_flipped(p) for p in places[half]]
        yield Alternative(
            f"the beams of the scans in the {which} half run the other way round (reversed scans)",
            replace(observations, places=tuple(flipped)),
        )


def _flipped(place: PlaceObservation) -> PlaceObservation:
    def flip(line: ScanLine) -> ScanLine:
        intensity = None if line.intensity is None else line.intensity[::-1]
        return ScanLine(-line.angle_rad[::-1], line.range_m[::-1], line.sigma_m[::-1], intensity)

    return replace(place, scan_lines={k: flip(line) for k, line in place.scan_lines.items()})


# --- edits of observations ------------------------------------------------------------------------------------------


def thinned_observations(observations: TurntableObservations) -> TurntableObservations:
    """At most 9 places and 50 rows a line: enough to see whether parts contradict each other."""
    index = np.unique(np.linspace(0, len(observations.places) - 1, _MOST_PLACES).round().astype(int))
    places = tuple(_thin_place(observations.places[int(i)]) for i in index)
    return replace(observations, places=places)


def _thin_place(place: PlaceObservation) -> PlaceObservation:
    def stripe(s: StripePoints) -> StripePoints:
        keep = np.unique(np.linspace(0, len(s) - 1, _MOST_ROWS).round().astype(int))
        return StripePoints(s.pixels[keep], s.normals[keep], s.sigma_px[keep])

    def line(s: ScanLine) -> ScanLine:
        keep = np.unique(np.linspace(0, len(s) - 1, _MOST_ROWS).round().astype(int))
        intensity = None if s.intensity is None else s.intensity[keep]
        return ScanLine(s.angle_rad[keep], s.range_m[keep], s.sigma_m[keep], intensity)

    return replace(
        place,
        stripes={k: stripe(s) for k, s in place.stripes.items()},
        scan_lines={k: line(s) for k, s in place.scan_lines.items()},
    )


def _mapped(
    observations: TurntableObservations, change: Callable[[PlaceObservation], PlaceObservation]
) -> TurntableObservations:
    return replace(observations, places=tuple(change(p) for p in observations.places))


def _with_lines(observations: TurntableObservations, change: Callable[[ScanLine], ScanLine]) -> TurntableObservations:
    return _mapped(observations, lambda p: replace(p, scan_lines={k: change(line) for k, line in p.scan_lines.items()}))


def _scaled_ranges(factor: float) -> Callable[[ScanLine], ScanLine]:
    # The stated noise is scaled too: it is the unit in which misfits are compared.
    return lambda line: replace(line, range_m=line.range_m * factor, sigma_m=line.sigma_m * factor)


def _with_corners(
    observations: TurntableObservations, change: Callable[[PanelCorners], PanelCorners]
) -> TurntableObservations:
    return replace(
        observations, corners={name: tuple(change(c) for c in cs) for name, cs in observations.corners.items()}
    )


def _scaled_squares(factor: float) -> Callable[[PanelCorners], PanelCorners]:
    return lambda corners: replace(corners, corners_panel=corners.corners_panel * factor)


def _with_readings(observations: TurntableObservations, factor: float) -> TurntableObservations:
    return _with_places(observations, [p.turntable_angle_rad * factor for p in observations.places])


def _with_places(observations: TurntableObservations, readings: list[float]) -> TurntableObservations:
    places = [replace(p, turntable_angle_rad=r) for p, r in zip(observations.places, readings, strict=True)]
    return replace(observations, places=tuple(places))


def duplicates(observations: TurntableObservations) -> tuple[str, ...]:
    """Places at different readings with the very same scan or stripe: a file was copied, or a sensor stood still."""
    found = []
    for what in ("scan", "stripe"):
        seen: dict[bytes, PlaceObservation] = {}
        pairs = []
        for place in observations.places:
            parts = [s.range_m for s in place.scan_lines.values()]
            if what == "stripe":
                parts = [s.pixels.ravel() for s in place.stripes.values()]
            if not parts or sum(len(p) for p in parts) < 10:
                continue
            key = np.concatenate(parts).tobytes()
            first = seen.setdefault(key, place)
            if first is not place and abs(first.turntable_angle_rad - place.turntable_angle_rad) > 1e-6:
                pairs.append((first.position, place.position))
        if pairs:
            more = f" and {len(pairs) - 1} more" if len(pairs) > 1 else ""
            found.append(
                f"positions {pairs[0][0]} and {pairs[0][1]}{more} have the very same {what} at different readings"
            )
    return tuple(found)
