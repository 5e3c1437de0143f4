"""What to think of a mounting found from flatness: the verdict, its reasons and the figures behind it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.model.calibration import Quality
from lidarpose.model.spun_scan import FlatSurface, ReadingJump
from lidarpose.model.turntable_result import ExtraParameter
from lidarpose.refine.bent_surfaces import Bend
from lidarpose.refine.flatness import EXTRA_NAMES, N_MOUNTING, Evidence, Solution
from lidarpose.refine.sweep_turning import SweepTurning

# Surfaces that disagree by this much more than their patches do are not all flat, or not all still.
LARGEST_SPREAD_FACTOR = 3.0
LARGEST_BENDING_SHARE = 0.6
LARGEST_READING_SCATTER_RAD = np.radians(0.25)
# Bent surfaces that move the mounting by this much more than noise does: its uncertainty is that of a guess at shapes.
LARGEST_BEND_FACTOR = 2.0
IN_WORDS = {
    "encoder_scale": ("the turntable's readings are off by a factor", "encoder-scale"),
    "range_offset_m": ("the ranges are off by a constant", "range-offset"),
    "beam_angle_scale": ("the beam angles are off by a factor", "beam-angle-scale"),
}


@dataclass(frozen=True)
class MountingOptions:
    """What to estimate beside the mounting, and what is good enough.

    Attributes
    ----------
    estimate
        Of `lidarpose.refine.flatness.EXTRA_NAMES`.
    want_mm, want_deg
        Standard deviation of the LiDAR's place and tilt that still counts as good.
    sweeps_stated
        Whether the user says that the table moved during sweeps as the readings have it; if not, and the scene leaves
        it open, that is paid for.
    reading_a_beam
        Whether each beam has a reading of its own.
    """

    estimate: tuple[str, ...] = ()
    want_mm: float = 20.0
    want_deg: float = 0.3
    sweeps_stated: bool = False
    reading_a_beam: bool = False

    def __post_init__(self) -> None:
        unknown = [name for name in self.estimate if name not in EXTRA_NAMES]
        if unknown:
            raise ValueError(f"no such parameter: {', '.join(unknown)}; known are {', '.join(EXTRA_NAMES)}")

    @property
    def free(self) -> IntArray:
        """Indices of what is estimated."""
        extras = [N_MOUNTING + EXTRA_NAMES.index(name) for name in EXTRA_NAMES if name in self.estimate]
        return np.array([*range(N_MOUNTING), *extras], dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Findings:
    """What an estimate and its tests have shown.

    `covariance` is the final one; `bend_factor` is by how much more the surfaces' smooth shapes move the mounting than
    noise does, in the worst direction. The others are as in `lidarpose.model.spun_scan.MountingEstimate`.
    """

    solution: Solution
    evidence: Evidence
    extras: Sequence[ExtraParameter]
    covariance: FloatArray
    surfaces: tuple[FlatSurface, ...]
    bending_m: float
    bend: Bend
    bend_factor: float
    turning: SweepTurning | None
    jumps: tuple[ReadingJump, ...]
    reading_scatter_rad: float

    @property
    def range_noise_m(self) -> float:
        """Of the typical return."""
        return float(np.median(np.repeat(self.solution.sigma, [s.returns for s in self.surfaces])))

    @property
    def sigma_tilt_deg(self) -> float:
        """The larger of both tilts'."""
        return float(np.degrees(np.sqrt(np.diag(self.covariance)[:2].max())))

    @property
    def sigma_shift_mm(self) -> float:
        """The larger of both shifts'."""
        return float(1e3 * np.sqrt(np.diag(self.covariance)[2:4].max()))


def quality_of(found: Findings, options: MountingOptions) -> Quality:
    """The verdict: doubtful with every reason that there is, or good."""
    reasons = (
        *(_suggestion(extra) for extra in found.extras if extra.suggested),
        *_about_readings(found),
        *_about_sweeps(found, options),
        *_about_surfaces(found),
        *_about_sigma(found, options),
    )
    return Quality("doubtful" if reasons else "good", reasons, _figures(found))


def _about_readings(found: Findings) -> Iterator[str]:
    if not found.solution.converged:
        yield "the estimate did not settle: the start may be too far off, or the scene not flat enough"
    if found.jumps:
        yield slipped(found.jumps)
    if found.reading_scatter_rad > LARGEST_READING_SCATTER_RAD:
        yield (
            f"single sweeps' readings seem to be off by {np.degrees(found.reading_scatter_rad):.2f} deg or more: a "
            "table that slips, sticks or reports where it was told to go; no mounting mends that"
        )


def _about_sweeps(found: Findings, options: MountingOptions) -> Iterator[str]:
    turning = found.turning
    if turning is None:
        return
    share = f"{100 * turning.share:.0f} % (standard deviation {100 * turning.sigma:.0f})"
    deg, mm = np.degrees(np.abs(turning.move[:2]).max()), 1e3 * np.abs(turning.move[2:4]).max()
    if turning.contradicted and options.reading_a_beam:
        yield (
            "the table seems not to turn during the sweeps as the readings of single beams have it; "
            f"{share} of that turn is missing: leave out --never-stops if it stopped for each sweep"
        )
    elif turning.contradicted:
        yield (
            f"the table seems to have turned during the sweeps, by {share} of the way to the next reading: give "
            "--never-stops if it turned on"
        )
    elif turning.open and not options.sweeps_stated and _too_uncertain(found, options):
        yield (
            "this scene leaves open whether the table stopped for each sweep or turned on, which would change the tilt "
            f"by {deg:.2g} deg and the place by {mm:.2g} mm: say --stops or --never-stops"
        )


def _about_surfaces(found: Findings) -> Iterator[str]:
    noise = found.range_noise_m
    if found.evidence.spread_factor > LARGEST_SPREAD_FACTOR:
        worst = max(found.surfaces, key=lambda surface: surface.pull)
        yield (
            "the surfaces contradict each other about the mounting by "
            f"{found.evidence.spread_factor:.1f} times their noise, most of all the one with {worst.returns} returns"
        )
    if found.bending_m > LARGEST_BENDING_SHARE * noise:
        yield f"the surfaces are bent by {1e3 * found.bending_m:.1f} mm beyond their noise of {1e3 * noise:.1f} mm"
    elif found.bend_factor > LARGEST_BEND_FACTOR:
        yield (
            f"the surfaces bulge and twist, by about {1e3 * found.bend.spread_m:.2g} mm over each, which moves the "
            f"mounting by {found.bend_factor:.1f} times as much as noise does"
        )


def _too_uncertain(found: Findings, options: MountingOptions) -> bool:
    return found.sigma_tilt_deg > options.want_deg or found.sigma_shift_mm > options.want_mm


def _about_sigma(found: Findings, options: MountingOptions) -> Iterator[str]:
    if _too_uncertain(found, options):
        yield (
            f"standard deviations of {found.sigma_tilt_deg:.2g} deg and {found.sigma_shift_mm:.3g} mm; wanted are "
            f"{options.want_deg:g} deg and {options.want_mm:g} mm: record more of the turn, or surfaces on more sides"
        )


def _figures(found: Findings) -> dict[str, Any]:
    turning = found.turning
    return {
        "method": "flatness",
        "surfaces": len(found.surfaces),
        "returns": int(sum(s.returns for s in found.surfaces)),
        "sigma_tilt_deg": found.sigma_tilt_deg,
        "sigma_shift_mm": found.sigma_shift_mm,
        "range_noise_mm": 1e3 * found.range_noise_m,
        "bending_mm": 1e3 * found.bending_m,
        "bend_mm": 1e3 * found.bend.spread_m,
        "bend_factor": found.bend_factor,
        "turning_during_sweeps": None if turning is None else {"share": turning.share, "sigma": turning.sigma},
        "reading_scatter_deg": float(np.degrees(found.reading_scatter_rad)),
        "reading_jumps": [
            {
                "sweeps": list(jump.sweeps),
                "stated_deg": float(np.degrees(jump.stated_rad)),
                "seen_deg": float(np.degrees(jump.seen_rad)),
            }
            for jump in found.jumps
        ],
        "spread_factor": found.evidence.spread_factor,
    }


def slipped(jumps: Sequence[ReadingJump]) -> str:
    """In words, for one jump or more, the largest first."""
    worst = jumps[0]
    more = {1: "", 2: ", and once more"}.get(len(jumps), f", and {len(jumps) - 1} times more")
    first, second = worst.sweeps
    seen, stated = np.degrees(worst.seen_rad), np.degrees(worst.stated_rad)
    return (
        f"between sweeps {first} and {second} the table turned by {seen:.1f} deg where its readings say {stated:.1f}"
        f"{more}: it slips or sticks, or sweeps were lost; no mounting mends that"
    )


def _suggestion(extra: ExtraParameter) -> str:
    words, option = IN_WORDS[extra.name]
    if extra.name.endswith("_m"):
        size = f"{1e3 * extra.value:.1f} mm (standard deviation {1e3 * extra.sigma:.1f})"
    else:
        size = f"{1e2 * extra.value:.2f} % (standard deviation {1e2 * extra.sigma:.2f})"
    return f"{words}, it seems, by about {size}: try --estimate {option}"
