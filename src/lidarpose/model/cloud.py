"""Point clouds with whatever fields their files carry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points in one frame.

    Attributes
    ----------
    points : (N, 3) float32 or float64
        Metres.
    fields
        Further columns by name, each (N,): intensity, ring, time, sigma, ...
    frame
        The frame's name ("lidar", "camera", "world"), if known.
    """

    points: NDArray[np.floating[Any]]
    fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    frame: str | None = None

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise ValueError(f"points have shape {self.points.shape}, expected Nx3")
        for name, column in self.fields.items():
            if column.shape[:1] != self.points.shape[:1]:
                raise ValueError(f"field {name} has {column.shape[:1]} entries for {len(self.points)} points")

    def __len__(self) -> int:
        return len(self.points)

    def finite(self) -> Cloud:
        """The points without those that have a NaN or infinite coordinate (beams without return); fields likewise."""
        if np.isfinite(self.points.sum()):
            # One number that is not finite would show in the sum; a sum too large for the type is looked into.
            return self
        keep = np.isfinite(self.points).all(axis=1)
        if keep.all():
            return self
        return Cloud(self.points[keep], {name: column[keep] for name, column in self.fields.items()}, self.frame)
