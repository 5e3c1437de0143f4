"""Sweep recordings: what a 2D LiDAR on a turning turntable returned, sweep after sweep. Arrays may be memory maps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.model.scan import LidarSpec

RealArray = NDArray[Any]
"""Real numbers of any type, possibly a memory map of a file larger than memory."""


@dataclass(frozen=True, eq=False)
class SweepRecording:
    """N sweeps of M beams.

    Attributes
    ----------
    name
        What a person calls it: the folder.
    turntable_angle_deg : (N,) or (N, M)
        One reading a sweep, or one a beam for a turntable that never stops.
    beam_angle_deg : (M,)
        Beam angles in the scan plane.
    range_m : (N, M)
        NaN (or anything that is not a positive finite number) where there is no return.
    intensity : (N, M) or None
        In the instrument's own unit.
    time_s : (N,) or None
        Time of each sweep's first beam.

    Raises
    ------
    ValueError
        If the shapes contradict one another.
    """

    name: str
    turntable_angle_deg: RealArray
    beam_angle_deg: RealArray
    range_m: RealArray
    intensity: RealArray | None = None
    time_s: RealArray | None = None
    lidar: LidarSpec = field(default_factory=LidarSpec)

    def __repr__(self) -> str:
        sweeps, beams = self.range_m.shape
        return f"SweepRecording({self.name!r}, {sweeps} sweeps of {beams} beams, {self.lidar})"

    def __post_init__(self) -> None:
        if self.range_m.ndim != 2:
            raise ValueError(f"range_m has shape {self.range_m.shape}, expected (sweeps, beams)")
        sweeps, beams = self.range_m.shape
        wanted: dict[str, tuple[tuple[int, ...], ...]] = {
            "turntable_angle_deg": ((sweeps,), (sweeps, beams)),
            "beam_angle_deg": ((beams,),),
            "intensity": ((sweeps, beams),),
            "time_s": ((sweeps,),),
        }
        for name, shapes in wanted.items():
            array = getattr(self, name)
            if array is not None and array.shape not in shapes:
                expected = " or ".join(map(str, shapes))
                raise ValueError(f"{name} has shape {array.shape}, expected {expected} as range_m has")

    @property
    def sweeps(self) -> int:
        """N."""
        return int(self.range_m.shape[0])

    @property
    def beams(self) -> int:
        """M."""
        return int(self.range_m.shape[1])

    @property
    def has_reading_per_beam(self) -> bool:
        """True if the turntable's angle is known for every beam."""
        return self.turntable_angle_deg.ndim == 2

    @property
    def beam_angle_rad(self) -> FloatArray:
        """Beam angles (M,) in radians."""
        return np.deg2rad(np.asarray(self.beam_angle_deg, dtype=np.float64))

    @property
    def turntable_angle_rad(self) -> FloatArray:
        """Readings (N,) or (N, M) in radians."""
        return np.deg2rad(np.asarray(self.turntable_angle_deg, dtype=np.float64))

    def has_return(self) -> BoolArray:
        """(N, M) beams with a finite range above zero."""
        r = np.asarray(self.range_m)
        # NaN and infinity fail one of the comparisons.
        return np.asarray((r > 0.0) & (r < np.inf))

    def part(self, first: int, last: int) -> SweepRecording:
        """Sweeps first to last - 1, as views."""
        rows = slice(first, last)
        return replace(
            self,
            turntable_angle_deg=self.turntable_angle_deg[rows],
            range_m=self.range_m[rows],
            intensity=None if self.intensity is None else self.intensity[rows],
            time_s=None if self.time_s is None else self.time_s[rows],
        )

    def parts(self, points: int = 1 << 20) -> Iterator[tuple[int, SweepRecording]]:
        """Consecutive parts of about `points` beams, each with the index of its first sweep."""
        step = max(1, points // max(1, self.beams))
        for first in range(0, self.sweeps, step):
            yield first, self.part(first, min(first + step, self.sweeps))
