"""Which beams of a recording to keep: range gates and mixed pixels."""

from __future__ import annotations

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.model.recording import SweepRecording

# A surface seen at less than this angle is no surface that the neighbouring beams share.
_STEEP_RAD = np.deg2rad(6.0)
_STEP_IN_SIGMA = 6.0


def within_gate(recording: SweepRecording, nearest_m: float, farthest_m: float) -> BoolArray:
    """(N, M) beams with a return between the two ranges."""
    if nearest_m <= 0.0 and farthest_m == np.inf:
        return recording.has_return()
    r = np.asarray(recording.range_m)
    return recording.has_return() & (r >= nearest_m) & (r <= farthest_m)


def mixed_pixels(recording: SweepRecording, range_sigma_m: float) -> BoolArray:
    """(N, M) beams whose range lies between two surfaces because their spot fell on both.

    Such a point hangs in the air: towards both neighbours of its sweep (or of the beam in the neighbouring sweeps) the
    range changes so much that a surface through both would be seen at a grazing angle, and it changes by more than
    noise. The edge of a surface is steep on one side only and stays. A neighbour without return counts as steep.
    A plane seen at a grazing angle stays, because there the inverse range changes evenly.
    """
    r = np.where(recording.has_return(), np.asarray(recording.range_m, dtype=np.float64), np.nan)
    step = np.abs(np.diff(recording.beam_angle_rad))
    along = _hanging(r, np.concatenate([step, step[-1:]]) if len(step) else np.zeros(1), range_sigma_m)
    readings = recording.turntable_angle_rad
    if recording.has_reading_per_beam:
        readings = readings.mean(axis=1)
    turn = float(np.median(np.abs(np.diff(readings)))) if recording.sweeps > 1 else 0.0
    across = _hanging(r.T, np.full(recording.sweeps, turn), range_sigma_m).T if turn > 0.0 else np.zeros_like(along)
    return along | across


def _hanging(r: FloatArray, step_rad: FloatArray, sigma: float) -> BoolArray:
    """Beams (rows, columns) that are steep towards both neighbours in their row, and off the line between them."""
    padded = np.pad(r, ((0, 0), (1, 1)), constant_values=np.nan)
    before, after = padded[:, :-2], padded[:, 2:]
    # A chord seen at grazing angle a over the step d changes the range by r sin(d) / tan(a).
    limit = np.maximum(r * np.sin(step_rad) / np.tan(_STEEP_RAD), _STEP_IN_SIGMA * sigma)
    steep_before = ~(np.abs(r - before) <= limit)
    steep_after = ~(np.abs(r - after) <= limit)
    with np.errstate(divide="ignore", invalid="ignore"):
        middle = 2.0 / (1.0 / before + 1.0 / after)
        even = np.abs(r - middle) <= np.maximum(0.1 * np.abs(after - before), _STEP_IN_SIGMA * sigma)
    return np.asarray(steep_before & steep_after & ~even & np.isfinite(r))
