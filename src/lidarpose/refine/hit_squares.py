"""Which squares of the boards beams hit, for scans without intensities: a bias on black squares shows all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.observation import TurntableObservations
from lidarpose.refine.turntable_layout import JointData, RangeRows
from lidarpose.refine.turntable_state import JointState

# A beam's spot is millimetres wide: so near the edge of a square it lies on both colours.
SPOT_M = 0.002


def with_squares(data: JointData, state: JointState, observations: TurntableObservations) -> RangeRows:
    """The ranges with the darkness of what each beam hits, by the board's pattern and a rough solution.

    Parameters
    ----------
    data
        Its `slots` tell which panel each line is on.
    state
        Where the boards and the LiDAR are, to a fraction of a square.
    observations
        Of which panels it is known where their black squares are; beams on others are taken to hit white.
    """
    rows, lines = data.ranges, data.ranges.lines
    R, t, _ = state.turned(data.angles_rad, data.reference_rad)
    darkness = np.zeros(len(rows.range_m))
    for j in range(lines.count):
        slot = data.slots[lines.slot[j]]
        first_dark = observations.corners[slot.placement][slot.panel].first_dark
        if first_dark is None:
            continue
        mine = slice(int(lines.start[j]), int(lines.start[j + 1]))
        place, panel = lines.place[j], observations.panels[slot.panel]
        points = (rows.beams[:, mine] * rows.range_m[mine]).T @ R[place][:, :2].T + t[place]
        square = (state.panels[lines.slot[j]].inverse() @ points)[:, :2] / panel.square_m
        darkness[mine] = _darkness(square, panel.columns, panel.rows, first_dark, SPOT_M / panel.square_m)
    return replace(rows, darkness=darkness)


def _darkness(at: FloatArray, columns: int, rows: int, first_dark: bool, spot: float) -> FloatArray:
    """1 on black, 0 on white and beyond the pattern, for points (N, 2) in squares from the first inner corner."""
    cell = np.floor(at)
    # Within a spot of an edge: a share of both, half of each on the edge itself.
    sharpness = np.minimum(0.5 - np.abs(at - cell - 0.5), spot).prod(axis=1) / spot**2
    sign = np.where(cell.sum(axis=1) % 2 == 0, 1.0, -1.0) * (1.0 if first_dark else -1.0)
    inside = np.all((cell >= -1) & (cell < [columns, rows]), axis=1)
    return np.asarray(np.where(inside, 0.5 + 0.5 * sign * sharpness, 0.0))
