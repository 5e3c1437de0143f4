"""Whole turntable runs for tests of what comes after estimation, made from simulated observations without detection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.observation import LeftOut, TurntableObservations
from lidarpose.model.rig_family import Family
from lidarpose.model.turntable_run import Deviation, FunctionDeviation, TurntableRun
from lidarpose.refine.turntable import JointOptions, refine_turntable
from lidarpose.simulate.observations import Blunders, simulate_observations
from lidarpose.simulate.rig import draw_rig
from lidarpose.simulate.session import simulate_session
from lidarpose.solve.paper import PaperSolution, solve_paper
from lidarpose.solve.turntable_function import FunctionDeviations


def turntable_run(
    family: Family = "paper",
    *,
    seed: int = 3,
    places: int | None = None,
    blunders: Blunders | None = None,
    turntable_sigma_rad: float = 0.0,
    name: str | None = None,
    joint: bool = True,
    lost: int = 0,
    placements: int = 1,
) -> TurntableRun:
    """A calibrated simulated session. `lost` places are given up as if detection had found nothing there."""
    rig = draw_rig(seed, family=family, places=places, placements=placements)
    session = simulate_session(rig).session
    observations = simulate_observations(
        rig, blunders=blunders, turntable_sigma_rad=turntable_sigma_rad, stripe_step_px=4.0, seed=seed
    )
    observations = _losing(observations, lost)
    paper = solve_paper(observations)
    panels = {key: tuple(p.T_camera_panel for p in poses) for key, poses in paper.panel_poses.items()}
    provenance = {
        "command": "calibrate",
        "options": {"method": "joint"},
        "inputs_sha256": {f"scans/{k:03d}.csv": f"{k:064x}" for k in range(len(rig))},
        "versions": {"lidarpose": "0.1.0", "numpy": np.__version__},
    }
    estimate = refine_turntable(observations, paper.motion, panels, JointOptions()) if joint else None
    calibration = TurntableCalibration(paper.motion, provenance=provenance)
    if estimate is not None:
        calibration = estimate.calibration(provenance)
    return TurntableRun(
        method="joint" if joint else "paper",
        session=session if name is None else replace(session, name=name),
        observations=observations,
        samples={position: sample.pose for position, sample in paper.samples.items()},
        paper_motion=paper.motion,
        deviation=_table(paper.deviations),
        calibration=calibration,
        estimate=estimate,
        left_out=_left_out(observations, paper, estimate.left_out if estimate is not None else ()),
    )


def _losing(observations: TurntableObservations, lost: int) -> TurntableObservations:
    places = list(observations.places)
    gone = {places[k].position for k in np.linspace(0, len(places) - 1, lost).round().astype(int)} if lost else set()
    kept = tuple(replace(p, scan_lines={}) if p.position in gone else p for p in places)
    reason = "the scan has no straight line where panel 1 should be"
    out = tuple(LeftOut(f"position {name}", reason) for name in sorted(gone))
    return replace(observations, places=kept, left_out=out)


def _left_out(
    observations: TurntableObservations, paper: PaperSolution, joint: tuple[LeftOut, ...]
) -> tuple[LeftOut, ...]:
    return tuple(dict.fromkeys((*observations.left_out, *(joint or paper.left_out))))


def _table(d: FunctionDeviations) -> FunctionDeviation:
    def pair(values: np.ndarray) -> Deviation:
        return Deviation(float(values.mean()), float(values.max()))

    return FunctionDeviation(pair(1e3 * d.centre_m), pair(np.rad2deg(d.z_rad)), pair(np.rad2deg(d.x_rad)))
