"""How accurate the joint estimate is: against the Cramer-Rao bound, and against its own covariance.

    python -m benchmarks.accuracy_turntable --runs 500 --write docs/accuracy.md

The bound comes from numerical derivatives of a measurement function that shares nothing with the estimator. With
`--keep FILE` finished lines are kept, so that an interrupted study goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.limits import CORNER_PX, STEP_PX, STRIPE_PX, motion_bound, pose_limits
from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.rig_family import Family
from lidarpose.refine.turntable import JointOptions, refine_turntable
from lidarpose.simulate.observations import Blunders, simulate_observations
from lidarpose.simulate.rig import TurntableRig, draw_rig
from lidarpose.solve.paper import solve_paper

START, END = "<!-- turntable joint estimate: start -->", "<!-- turntable joint estimate: end -->"


@dataclass(frozen=True)
class Setting:
    """One line of the table."""

    name: str
    places: int = 87
    range_sigma_m: float = 0.001
    blunders: Blunders | None = None
    estimate: tuple[str, ...] = ()
    share: float = 1.0
    """Of the runs; less for what is compared with the clean line, not with the bound."""

    def runs(self, wanted: int) -> int:
        return max(1, round(self.share * wanted))


SETTINGS = (
    Setting("87 places, ranges 1 mm"),
    Setting("87 places, ranges 3 mm", range_sigma_m=0.003),
    Setting("5 places, ranges 1 mm", places=5),
    Setting("10 % outliers in stripes and ranges", blunders=Blunders(stripe_share=0.1, range_share=0.1)),
    Setting("black 1 mm long, option off", blunders=Blunders(black_range_bias_m=1e-3), share=0.3),
    Setting(
        "black 1 mm long, option on", blunders=Blunders(black_range_bias_m=1e-3), estimate=("black_bias_m",), share=0.3
    ),
)


# --- the study ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """Figures at one reading: RMS errors, their ratio to the bound, NEES and coverage, the largest bias in sigmas."""

    mm: float
    deg: float
    ratio_mm: float
    ratio_deg: float
    nees: float
    coverage: float
    bias: float


def study(setting: Setting, runs: int, *, stripe_step_px: float = STEP_PX, seed: int = 1) -> tuple[Outcome, Outcome]:
    """Inside the arc, and half a turn away."""
    rig = draw_rig(seed, places=setting.places, range_sigma_m=setting.range_sigma_m)
    limit = motion_bound(rig)
    middle = float(0.5 * (rig.turntable_angle_rad[0] + rig.turntable_angle_rad[-1]))
    readings = (middle, middle + np.pi)
    rows: list[list[tuple[FloatArray, FloatArray, float]]] = [[], []]
    for run in range(runs):
        observations = simulate_observations(
            rig,
            corner_sigma_px=CORNER_PX,
            stripe_sigma_px=STRIPE_PX / np.sqrt(stripe_step_px),
            stripe_step_px=stripe_step_px,
            blunders=setting.blunders,
            seed=run,
        )
        # The closed form of some places is start enough.
        start = solve_paper(replace(observations, places=observations.places[:: max(1, setting.places // 15)]))
        poses = {name: tuple(p.T_camera_panel for p in ps) for name, ps in start.panel_poses.items()}
        options = JointOptions(estimate=setting.estimate, search_alternatives=False)
        estimate = refine_turntable(observations, start.motion, poses, options)
        for where, reading in enumerate(readings):
            pose, true = estimate.uncertain_pose(reading), rig.motion.pose(reading)
            xi = pose.pose.minus(true)
            shift = pose.pose.translation - true.translation
            rows[where].append((shift, xi[3:], float(xi @ np.linalg.solve(pose.covariance, xi))))
    inside, away = (summary(rig, limit, reading, rows[i]) for i, reading in enumerate(readings))
    return inside, away


def summary(
    rig: TurntableRig, limit: FloatArray, reading: float, rows: list[tuple[FloatArray, FloatArray, float]]
) -> Outcome:
    shift, turn = np.array([r[0] for r in rows]), np.array([r[1] for r in rows])
    nees = np.array([r[2] for r in rows])
    best_m, best_rad = pose_limits(rig, limit, reading)
    rms_m, rms_rad = np.sqrt((shift**2).sum(axis=1).mean()), np.sqrt((turn**2).sum(axis=1).mean())
    both = np.hstack([shift, turn])
    bias = np.abs(both.mean(axis=0) / (both.std(axis=0, ddof=1) / np.sqrt(len(both))))
    return Outcome(
        float(1e3 * rms_m),
        float(np.rad2deg(rms_rad)),
        float(rms_m / best_m),
        float(rms_rad / best_rad),
        float(nees.mean()),
        float((nees < 12.5916).mean()),
        float(bias.max()),
    )


@dataclass(frozen=True)
class Kept:
    """Results that outlive an interrupted study: JSON by name; nothing is kept without a file."""

    path: Path | None

    def get(self, name: str, make: Callable[[], Any]) -> Any:
        known = json.loads(self.path.read_text()) if self.path is not None and self.path.exists() else {}
        if name not in known:
            known[name] = make()
            if self.path is not None:
                self.path.write_text(json.dumps(known, indent=1))
        return known[name]


def table(runs: int, kept: Kept, stripe_step_px: float = STEP_PX) -> str:
    lines = [
        f"Simulated observations at the turntable paper's geometry: corners {CORNER_PX} px, stripe "
        f"{STRIPE_PX} px a pixel along it, started from the closed form. Errors are root mean squares over all three "
        "axes, `/CRB` their ratio to the Cramer-Rao bound of the clean data; NEES of the pose has mean 6 if the "
        "covariance is right; coverage is of the 95 % ellipsoid; bias is the largest of six means in its standard "
        "deviations. Outliers are 10 % of stripe pixels and of ranges. With the option off the verdict is doubtful and "
        "names the black squares, and the covariance contains their effect.",
        "",
        "| setting | runs | reading | mm | /CRB | degrees | /CRB | NEES | coverage | bias |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for setting in SETTINGS:
        begin = time.perf_counter()
        make = partial(_as_records, setting, setting.runs(runs), stripe_step_px)
        for where, found in zip(("inside the arc", "half a turn away"), kept.get(setting.name, make), strict=True):
            o = Outcome(**found)
            lines.append(
                f"| {setting.name} | {setting.runs(runs)} | {where} "
                f"| {o.mm:.3f} | {o.ratio_mm:.2f} | {o.deg:.4f} | {o.ratio_deg:.2f} "
                f"| {o.nees:.2f} | {o.coverage:.3f} | {o.bias:.1f} |"
            )
        print("\n".join(lines[-2:]), f"{time.perf_counter() - begin:.0f} s", flush=True)
    return "\n".join(lines)


def _as_records(setting: Setting, runs: int, stripe_step_px: float) -> list[dict[str, float]]:
    return [asdict(outcome) for outcome in study(setting, runs, stripe_step_px=stripe_step_px)]


RENDERED: tuple[Family, ...] = (
    *("paper", "upside-down", "left", "right", "axis-up", "axis-down", "far-axis", "offset-readings"),
    *("tilted-scan-plane", "flat-scan-plane", "few-places", "many-places", "fold-horizontal", "fold-vertical", "mixed"),
    *("axis-in-scan-plane", "paper", "mixed", "few-places", "mixed"),
)
"""The family of each of 20 seeds, over and over; "few" and "many places" have 87 here, like the others."""
FIRST_SEED = 100
"""Nothing was tuned on the seeds from here on; seeds 0 to 18 were looked at while the estimator was made."""


def rendered(seed: int) -> dict[str, Any]:
    """Errors of joint and paper against the truth, NEES inside the arc and half a turn away, and the verdict.

    Errors are (mm, degrees) inside the arc, then root mean squares over the whole turn.
    """
    from lidarpose.simulate.session import simulate_session
    from lidarpose.workflows.turntable import calibrate_turntable

    rig = draw_rig(seed, family=RENDERED[seed % len(RENDERED)], places=87, range_sigma_m=0.001)
    try:
        run = calibrate_turntable(simulate_session(rig, seed).session)
    except UndeterminedError as error:
        return {"seed": seed, "verdict": "none", "why": error.what}
    assert run.estimate is not None
    middle = float(np.median(rig.turntable_angle_rad))
    around = middle + np.linspace(-np.pi, np.pi, 73)[:-1]
    found: dict[str, Any] = {"seed": seed, "verdict": run.estimate.quality.verdict}
    for name, motion in (("joint", run.calibration.motion), ("paper", run.paper_motion)):
        inside = motion.pose(middle).distance(rig.motion.pose(middle))
        turn = np.array([motion.pose(float(a)).distance(rig.motion.pose(float(a))) for a in around])
        turn_m, turn_rad = np.sqrt((turn**2).mean(axis=0))
        found[name] = [
            1e3 * inside[0],
            float(np.rad2deg(inside[1])),
            1e3 * float(turn_m),
            float(np.rad2deg(turn_rad)),
        ]
    found["nees"] = []
    for reading in (middle, middle + np.pi):
        pose = run.estimate.uncertain_pose(reading)
        xi = pose.pose.minus(rig.motion.pose(reading))
        found["nees"].append(float(xi @ np.linalg.solve(pose.covariance, xi)))
    return found


def rendered_table(seeds: int, kept: Kept) -> str:
    found = []
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        found.append(kept.get(f"rendered {seed}", partial(rendered, seed)))
        print(json.dumps(found[-1]), flush=True)
    verdicts = [f["verdict"] for f in found]
    found = [f for f in found if f["verdict"] != "none"]
    nees = np.array([f["nees"] for f in found])
    covered = (nees < 12.5916).mean(axis=0)
    lines = [
        f"Rendered sessions, {seeds} seeds (from {FIRST_SEED}) over all families of rigs, 87 places, ranges 1 mm, from "
        "images and scans to the pose: root mean square errors. Coverage of the 95 % ellipsoid "
        f"{covered[0]:.2f} inside the arc and {covered[1]:.2f} half a turn away; NEES {nees[:, 0].mean():.1f} and "
        f"{nees[:, 1].mean():.1f}; verdict good: {verdicts.count('good')} of {seeds}, without an answer: "
        f"{verdicts.count('none')}.",
        "",
        "| method | inside, mm | degrees | whole turn, mm | degrees |",
        "|---|---|---|---|---|",
    ]
    for name, key in (("joint", "joint"), ("paper (closed form)", "paper")):
        rms = np.sqrt((np.array([f[key] for f in found]) ** 2).mean(axis=0))
        lines.append(f"| {name} | {rms[0]:.3f} | {rms[1]:.4f} | {rms[2]:.3f} | {rms[3]:.4f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--rendered", type=int, default=len(RENDERED), help="how many rendered sessions (0: none)")
    parser.add_argument("--write", type=Path)
    parser.add_argument("--keep", type=Path, help="a JSON file for finished lines; an interrupted study goes on")
    options = parser.parse_args()
    kept = Kept(options.keep)
    parts = [table(options.runs, kept)] if options.runs else []
    parts += [rendered_table(options.rendered, kept)] if options.rendered else []
    text = "\n\n".join(parts)
    if options.write is not None:
        old = options.write.read_text() if options.write.exists() else f"# Accuracy\n\n{START}\n{END}\n"
        if START not in old:
            old += f"\n## The turntable's joint estimate\n\n{START}\n{END}\n"
        head, rest = old.split(START)
        options.write.write_text(f"{head}{START}\n{text}\n{END}{rest.split(END)[1]}")


if __name__ == "__main__":
    main()
