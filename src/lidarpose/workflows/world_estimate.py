"""The joint estimate over a session's places, and beside offsets of a LiDAR's rings and a crossing of its beams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.model.corner_result import CornerPlaceFaces
from lidarpose.model.corner_session import CornerSession
from lidarpose.refine.beam_crossing import OpenCrossing, SeenCrossing, open_crossing, seen_crossing, without_crossing
from lidarpose.refine.corner_model import (
    SETTLED,
    CornerFit,
    CornerOptions,
    CornerState,
    estimate_world_sigma,
    fit_corner_model,
)
from lidarpose.refine.ring_offsets import (
    RingEquations,
    RingOffsets,
    Rings,
    find_rings,
    ring_equations,
    ring_offsets,
    some_returns,
)
from lidarpose.refine.slipped_place import free_fit, loses_returns
from lidarpose.refine.spot_scatter import common_error_factor

# Offsets of rings, and how much else spots err together, are estimated in turn.
RING_STEPS = 3
# So are a crossing of the beams and the errors of the world's coordinates.
CROSSING_STEPS = 3
# Twice the gain in log likelihood at which uncertain world coordinates are believed in.
CONVINCING_GAIN = 9.0
# It is estimated again until it grows no more: coordinates taken for better than they are bend the estimate.
WORLD_STEPS, GROWN = 4, 1.2


def fit_places(
    session: CornerSession,
    places: Sequence[CornerPlaceFaces],
    start: CornerState,
    sigma_m: float,
    scale_too: bool,
    settled: float = SETTLED,
    *,
    near: bool = False,
) -> tuple[CornerFit, list[CornerPlaceFaces]]:
    """The joint estimate over the places that have faces; the world's noise as stated, or as the data show it.

    With `near`, start and noise are an estimate's from most of these returns (see `fit_corner_model`).
    """
    rows = [i for i, p in enumerate(places) if p.faces]
    used = [places[i] for i in rows]
    near = near and not start.world_errors.any()
    start = replace(start, world_errors=np.zeros((len(used), 3)))
    stated = session.world_sigma_m
    fit = fit_corner_model(used, start, sigma_m, CornerOptions(stated or 0.0, scale_too), settled=settled, near=near)
    if stated is None:
        fit = _with_world_noise(used, fit, settled)
    return fit, used


def _with_world_noise(used: Sequence[CornerPlaceFaces], exact: CornerFit, settled: float) -> CornerFit:
    """The estimate with the world's coordinates as uncertain as the data show them; itself where they fit."""
    # What does not fit exact coordinates has no say in whether they are.
    fit = (free_fit(used, exact, settled) if loses_returns(exact, used) else None) or exact
    known = 0.0
    for _ in range(WORLD_STEPS):
        estimated, gain = estimate_world_sigma(fit)
        if gain < CONVINCING_GAIN:
            return exact
        if estimated < GROWN * known:
            break
        known = estimated
        options = CornerOptions(estimated, exact.options.estimate_scale)
        fit = fit_corner_model(used, fit.state, fit.range_sigma_m, options, settled=settled)
    return fit


@dataclass(frozen=True, eq=False)
class BesideRings:
    """The joint estimate and its returns, free of what single rings are off by, where the data tell; where the beams
    seem to cross, and where they may."""

    fit: CornerFit
    places: list[CornerPlaceFaces]
    offsets: RingOffsets | None = None
    crossing: SeenCrossing | None = None
    possible: OpenCrossing | None = None


def without_rings(session: CornerSession, fit: CornerFit, used: list[CornerPlaceFaces]) -> BesideRings:
    """The joint estimate beside offsets of a multi-beam LiDAR's rings, where the data speak for any, and where its
    beams seem to cross, or may cross."""
    few = some_returns(used) if session.cloud_frame == "lidar" else []
    few_rings = find_rings(few)
    if few_rings is None:
        return BesideRings(fit, used)
    estimate, clean, offsets = fit, used, None
    equations: RingEquations | None = ring_equations(fit, few, few_rings)
    if ring_offsets(fit, few, few_rings, equations=equations) is not None:
        estimate, clean, offsets = _with_rings(session, fit, used)
        equations = None
    crossing = _crossing(session, estimate, clean, few, few_rings, offsets, equations)
    if crossing is not None and crossing.told:
        estimate = replace(estimate, covariance=estimate.covariance + np.outer(crossing.move, crossing.move))
    stated = session.lidar.beam_crossing_m is not None
    possible = None if crossing is None or stated else open_crossing(crossing, few_rings)
    return BesideRings(estimate, clean, offsets, crossing, possible)


def _crossing(
    session: CornerSession,
    fit: CornerFit,
    clean: list[CornerPlaceFaces],
    few: list[CornerPlaceFaces],
    rings: Rings,
    offsets: RingOffsets | None,
    equations: RingEquations | None,
) -> SeenCrossing | None:
    """Where the beams seem to cross, from some returns `few`, with their `equations` at the fit if these are known;
    `clean` are all, without offsets of rings."""
    told, ring_sigma_m = (0.0, 0.0) if offsets is None else (offsets.told, offsets.sigma_m)
    # Without offsets of rings the returns are the measured ones.
    factor = common_error_factor(fit, some_returns(clean) if offsets is not None else few, told)
    first = seen_crossing(fit, few, rings, ring_sigma_m, factor, equations)
    if first is None or first.told or session.world_sigma_m is not None or not fit.world_sigma_m > 0.0:
        return first
    # What a crossing does has passed for errors of the world's coordinates: are there any where it is taken out?
    total, last = first.crossing_m, first
    for _ in range(CROSSING_STEPS):
        taken = without_crossing(clean, fit, total)
        fit, _ = fit_places(session, taken, fit.state, fit.range_sigma_m, "log_scale" in fit.names)
        factor = common_error_factor(fit, some_returns(taken), told)
        again = seen_crossing(fit, without_crossing(few, fit, total), rings, ring_sigma_m, factor)
        if again is None:
            return first
        total, last = total + again.crossing_m, again
    estimated = 8.0 if "log_scale" in fit.names else 7.0
    return SeenCrossing(total, last.sigma_m, first.by_metre, 3.0 * len(clean) - estimated)


def _with_rings(
    session: CornerSession, fit: CornerFit, used: list[CornerPlaceFaces]
) -> tuple[CornerFit, list[CornerPlaceFaces], RingOffsets | None]:
    rings = find_rings(used)
    offsets = None if rings is None else ring_offsets(fit, used, rings)
    clean, estimate = used, fit
    for _ in range(RING_STEPS):
        if rings is None or offsets is None:
            return fit, used, None
        clean = offsets.corrected(used)
        estimate, _ = fit_places(session, clean, estimate.state, estimate.range_sigma_m, "log_scale" in fit.names)
        factor = common_error_factor(estimate, clean, offsets.told)
        offsets = ring_offsets(estimate, clean, rings, offsets.offset_m, factor)
    if offsets is None:
        return fit, used, None
    return replace(estimate, covariance=offsets.covariance), clean, offsets
