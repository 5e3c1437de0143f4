"""What may be asked of the joint estimate of a turntable session; apart from it, as importing that takes a while."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from lidarpose.geometry.se3 import Pose
from lidarpose.model.observation import TurntableObservations
from lidarpose.model.turntable import TurntableMotion
from lidarpose.refine.turntable_parameters import EXTRAS

Start = tuple[TurntableMotion, Mapping[str, tuple[Pose | None, ...]]]
"""Motion and panels' poses by placement, where an estimate starts."""


@dataclass(frozen=True)
class JointOptions:
    """What to estimate beside the 22 numbers, and what the user wants.

    Attributes
    ----------
    estimate
        Extra parameters, names of `lidarpose.refine.turntable_parameters.EXTRAS`.
    use_stripes
        False: work from boards and scans alone.
    want_mm, want_deg
        The standard deviation of position and orientation, inside the recorded arc, that still counts as good.
    max_iterations
        Of the solver.
    restart
        Makes a start from observations; lets the search for contradictions try alternatives (a scan reversed, panels
        swapped) from a start of their own. The workflow gives the closed form.
    search_alternatives
        Whether to look for an explanation when the residuals are bad.
    """

    estimate: tuple[str, ...] = ()
    use_stripes: bool = True
    want_mm: float = 2.0
    want_deg: float = 0.2
    max_iterations: int = 60
    restart: Callable[[TurntableObservations], Start] | None = None
    search_alternatives: bool = True

    def __post_init__(self) -> None:
        unknown = [name for name in self.estimate if name not in EXTRAS]
        if unknown:
            raise ValueError(f"unknown parameter {unknown[0]!r}; known are {', '.join(EXTRAS)}")
        if not (self.want_mm > 0.0 and self.want_deg > 0.0):
            raise ValueError("the wanted standard deviations must be positive")
