"""What a run's figures tell a person to do: causes in the order in which they are worth checking.

The verdict with its reasons comes with the estimate; this module only translates evidence into steps.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping

import numpy as np

from lidarpose.model.turntable_result import Kind, NoiseEstimate, TurntableEstimate
from lidarpose.model.turntable_run import TurntableRun
from lidarpose.report.numbers import plural, short
from lidarpose.report.turn_numbers import arc_deg, used_positions

# Beyond these a recording is not sound: scatter in px, px and m; whole lines off by px and m.
_SCATTER: dict[Kind, float] = {"corners": 0.5, "stripes": 0.7, "ranges": 0.01}
_WHOLE_LINES: dict[Kind, float] = {"stripes": 0.4, "ranges": 0.003}
_LEAST_ARC_DEG = 10.0
_LEAST_PLACES = 6
_MUCH_LEFT_OUT = 0.15
_CONTRADICTS = "fit the motion of the other places"

_EXTRA_STEPS = {
    "encoder_scale": "Check the turntable's unit and gear ratio: positions.csv wants its readings in degrees.",
    "range_offset_m": "Let the LiDAR warm up (half an hour) and check its zero against a tape measure.",
    "range_scale": "Measure a square of the board with a calliper and correct square_m in session.toml; then check "
    "that ranges are in metres.",
    "beam_angle_scale": "Check the beam angles in the scans: a rounded angular step (0.0833 for 1/12 degree) adds up.",
    "black_bias_m": "Ranges on black and white squares differ: print the black squares in grey.",
    "centre_x_px": "Calibrate the camera anew, or take the camera.yaml that belongs to these images (cropped ones?).",
    "centre_y_px": "Calibrate the camera anew, or take the camera.yaml that belongs to these images (cropped ones?).",
    "focal_scale": "Calibrate the camera anew at this focus, and check that camera.yaml has the size of these images.",
}


def todo(run: TurntableRun) -> tuple[str, ...]:
    """Steps for the user, the most telling first; none for a run that is good."""
    quality = run.calibration.quality
    if quality is not None and quality.verdict == "good":
        return ()
    steps = list(dict.fromkeys(_steps(run)))
    if quality is not None and quality.verdict == "rejected":
        until = "until then do not measure with this calibration.json: its numbers are not trustworthy."
        steps.append(until.capitalize() if steps else f"Correct what the reasons name and calibrate again; {until}")
    return tuple(steps)


def left_out_summary(run: TurntableRun) -> list[tuple[str, list[str]]]:
    """What was left out, by reason, the most frequent first."""
    by_reason: dict[str, list[str]] = {}
    for item in run.left_out:
        by_reason.setdefault(item.reason, []).append(item.what)
    return sorted(by_reason.items(), key=lambda pair: -len(pair[1]))


def _steps(run: TurntableRun) -> Iterator[str]:
    estimate = run.estimate
    faults: list[str] = []
    if estimate is not None:
        faults += [*_noise_steps(estimate), *_extra_steps(estimate)]
    faults += [*_left_out_steps(run), *_layout_steps(run)]
    yield from faults
    # More of the same recording mends nothing while the measurements contradict each other.
    if estimate is not None and not faults:
        yield from _direction_steps(estimate)


def _noise_steps(estimate: TurntableEstimate) -> Iterator[str]:
    noise = estimate.noise
    if _scatters(noise, "corners"):
        yield (
            f"The corners miss by {short(noise['corners'].sigma)} px. Check columns, rows and square_m of each panel "
            "in session.toml, that camera.yaml belongs to this camera, lens setting and image size, and that the "
            "board's images are sharp."
        )
    if _lines_are_off(noise, "stripes") and _lines_are_off(noise, "ranges"):
        yield (
            "Stripes and ranges both disagree from place to place. Most likely readings in positions.csv are not true, "
            "or its rows are mixed up: check the turntable's unit (degrees), its sense and its stops, and that "
            "stripe image and scan of each row were recorded at that reading."
        )
    if _scatters(noise, "stripes") or _lines_are_off(noise, "stripes"):
        yield (
            "The stripes do not lie where the rest puts them. Check that neither camera nor board moved between the "
            "bright image and the stripe images, that stripe image and scan of each row in positions.csv belong "
            "together, and that the room was dark."
        )
    if _scatters(noise, "ranges") or _lines_are_off(noise, "ranges"):
        yield (
            "The ranges do not fit the board. Check that scans are in metres and degrees, that each scan in "
            "positions.csv has the right reading, and that nothing hides the board from the LiDAR."
        )


def _scatters(noise: Mapping[Kind, NoiseEstimate], kind: Kind) -> bool:
    found = noise.get(kind)
    return found is not None and found.sigma > _SCATTER[kind]


def _lines_are_off(noise: Mapping[Kind, NoiseEstimate], kind: Kind) -> bool:
    found = noise.get(kind)
    return found is not None and found.place_sigma > _WHOLE_LINES[kind]


def _extra_steps(estimate: TurntableEstimate) -> Iterator[str]:
    called = [e for e in estimate.extras if e.suggested and not e.estimated and e.observable]
    for extra in sorted(called, key=lambda e: -abs(e.value) / max(e.sigma, 1e-300))[:1]:
        step = _EXTRA_STEPS.get(extra.name)
        if not step:
            continue
        # A wrong principal point is no matter of the recording: it is not offered for estimation.
        option = extra.name.removesuffix("_m").replace("_", "-")
        can = not extra.name.endswith("_px")
        yield f"{step} If it cannot be mended, calibrate with --estimate {option}." if can else step


def _left_out_steps(run: TurntableRun) -> Iterator[str]:
    total = len(run.session.places)
    lost = total - len(used_positions(run, wholly=True))
    apart = [item.what for item in run.left_out if _CONTRADICTS in item.reason]
    if len(apart) > _MUCH_LEFT_OUT * total:
        yield (
            f"{len(apart)} of {plural(total, 'place')} could not be used: they contradict the others. Compare "
            f"positions.csv with what was recorded, from {apart[0]} to {apart[-1]}: a reading or a scan that stands "
            "one row too low or high does this. Calibrated as sessions of their own, the two parts show which is sound."
        )
    elif lost > _MUCH_LEFT_OUT * total:
        reasons = Counter(item.reason for item in run.left_out)
        often = f" Most often: {reasons.most_common(1)[0][0]}." if reasons else ""
        yield f"{lost} of {plural(total, 'place')} could not be used, or only in part.{often} Mend that, record again."


def _layout_steps(run: TurntableRun) -> Iterator[str]:
    low, high = arc_deg(run)
    if high - low < _LEAST_ARC_DEG:
        yield (
            f"The readings span only {high - low:.1f} degrees. Record over a wider arc (20 degrees or more), with the "
            "stripe on both panels; put the board up at a second placement if it leaves the view."
        )
    used = len(used_positions(run))
    if used < _LEAST_PLACES:
        yield f"Only {plural(used, 'place')} could be used. Record twenty or more, spread over the arc."


def _direction_steps(estimate: TurntableEstimate) -> Iterator[str]:
    figures = estimate.quality.figures
    want = figures.get("want_mm"), figures.get("want_deg")
    for direction in estimate.directions[:2]:
        pairs = zip((direction.sigma_mm, direction.sigma_deg), want, strict=True)
        weak = any(isinstance(w, (int, float)) and np.isfinite(w) and s > 0.5 * w for s, w in pairs)
        if direction.remedy and weak:
            yield f"Weakest is {direction.name}. {direction.remedy}"
