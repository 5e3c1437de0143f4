"""Measurements as readers want to see them: the beams behind a diameter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidarpose.geometry.arrays import perpendicular_pair
from lidarpose.measure.beams import plane_ranges
from lidarpose.measure.disk import RoundMeasurement
from lidarpose.model.round_view import RoundView
from lidarpose.workflows.measuring import MeasuringView

# A return this far off the plane (in standard deviations, and at least in metres) is from something else.
_GATE_SIGMAS, _LEAST_GATE_M = 5.0, 0.002


def round_view(view: MeasuringView, measured: RoundMeasurement, name: str, remarks: Sequence[str] = ()) -> RoundView:
    """The beams on a measured disk (or about a hole), and those about its edge, in its plane."""
    support = measured.support
    beams = view.beams.at(np.union1d(support.plane_index, support.edge_index))
    distance = plane_ranges(support.plane, beams)
    met = beams.origin + distance[:, None] * beams.direction
    axes = np.stack(perpendicular_pair(measured.normal))
    place = (met - measured.centre) @ axes.T
    gate = max(_GATE_SIGMAS * view.noise_m, _LEAST_GATE_M)
    with np.errstate(invalid="ignore"):
        returned = np.abs(beams.range_m - distance) < gate
    flat = np.isfinite(place).all(axis=1)
    parts = {"edge": measured.edge_sigma_m, "plane": measured.plane_sigma_m}
    if measured.calibration_sigma_m is not None:
        parts["calibration"] = measured.calibration_sigma_m
    return RoundView(
        measured.kind,
        name,
        view.frame,
        measured.diameter_m,
        measured.sigma_m,
        parts,
        measured.outermost_diameter_m,
        measured.centre,
        measured.normal,
        measured.covered,
        measured.plane_rms_m,
        place[returned & flat],
        place[~returned & flat],
        beams.points[returned],
        axes,
        tuple(remarks),
    )
