"""What a LiDAR's own ranges and beam angles are off by, so that later scans can be put right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.model.recording import SweepRecording


@dataclass(frozen=True)
class BeamCorrection:
    """true angle = angle_scale * stated angle; true range = (stated range - range_offset_m) / range_scale."""

    angle_scale: float = 1.0
    range_scale: float = 1.0
    range_offset_m: float = 0.0

    @staticmethod
    def from_extras(values: Mapping[str, float]) -> BeamCorrection:
        """From estimated parameters by the names of `lidarpose.refine.turntable_parameters.EXTRAS`."""
        return BeamCorrection(
            1.0 + values.get("beam_angle_scale", 0.0),
            1.0 + values.get("range_scale", 0.0),
            values.get("range_offset_m", 0.0),
        )

    @property
    def is_none(self) -> bool:
        """True where nothing is to be corrected."""
        return self == BeamCorrection()

    def apply(self, recording: SweepRecording) -> SweepRecording:
        """The recording with true angles and ranges."""
        if self.is_none:
            return recording
        ranges = np.asarray(recording.range_m)
        if (self.range_scale, self.range_offset_m) != (1.0, 0.0):
            kind = np.result_type(ranges.dtype, np.float32)
            ranges = ((ranges - self.range_offset_m) / self.range_scale).astype(kind)
        angles = np.asarray(recording.beam_angle_deg, dtype=np.float64) * self.angle_scale
        return replace(recording, beam_angle_deg=angles, range_m=ranges)
