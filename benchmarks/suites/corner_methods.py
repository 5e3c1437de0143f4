"""The world pose by the corner paper's methods, by general libraries and by ours, on the same simulated frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.accuracy_world import bound
from benchmarks.peers.corner_peers import open3d_corners, registered_places
from benchmarks.report import Curve, Effort, Report, Table
from benchmarks.studies import by_chance, in_processes, rms
from lidarpose.errors import LidarposeError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.simulate.corner_scene import CornerSceneSpec, CornerTruth, simulate_corner_session
from lidarpose.simulate.multibeam import Defects
from lidarpose.workflows.world import WorldMethod, calibrate_world, locate_target

JOINT, PAPER, RANSAC = "lidarpose, joint", "corner paper", "corner paper's rival: RANSAC"
OPEN3D, ICP = "Open3D planes, corner, singular values", "point-to-plane ICP between places (Open3D)"
OWN: dict[str, WorldMethod] = {JOINT: "joint", PAPER: "paper", RANSAC: "ransac"}
METHODS = (*OWN, OPEN3D, ICP)


@dataclass(frozen=True)
class Setting:
    """One point of a curve: frames a place, range noise, places, edge of the cube."""

    frames: int = 1
    range_sigma_m: float = 0.008
    places: int = 6
    size_m: float = 0.5

    def spec(self, seed: int) -> CornerSceneSpec:
        """Pose 1 of the paper with its cube before an HDL-32."""
        defects = replace(Defects(), range_sigma_m=self.range_sigma_m)
        return CornerSceneSpec(
            pose="1", frames=self.frames, places=self.places, seed=seed, size_m=self.size_m, defects=defects
        )


@dataclass(frozen=True)
class _Axis:
    name: str
    label: str
    values: tuple[float, ...]
    setting: Callable[[float], Setting]


AXES = (
    _Axis("frames", "frames a place", (1, 2, 5, 20), lambda v: Setting(frames=int(v))),
    _Axis("noise", "range noise, mm", (2, 4, 8, 16), lambda v: Setting(range_sigma_m=1e-3 * v)),
    _Axis("places", "places", (3, 4, 6, 10), lambda v: Setting(places=int(v))),
    # By how much a smaller target is as one farther off: the simulator's stand 1.4 to 2.6 m away.
    _Axis("size", "edge of the cube, m (1.4 to 2.6 m away)", (0.3, 0.4, 0.5, 0.7), lambda v: Setting(size_m=v)),
)


def _trial(task: tuple[Setting, int]) -> tuple[dict[str, FloatArray], FloatArray]:
    """By method the errors (deg, mm); and the bound of this very scene."""
    setting, seed = task
    spec = setting.spec(seed)
    session, truth = simulate_corner_session(spec)
    limit = bound(spec) / np.sqrt(setting.frames)
    found: dict[str, FloatArray] = {}
    try:
        located = locate_target(session)
    except LidarposeError:
        return found, limit
    for name, method in OWN.items():
        try:
            found[name] = error(calibrate_world(session, method, located=located).T_world_source, truth)
        except LidarposeError:
            continue
    for name, peer in ((OPEN3D, open3d_corners()), (ICP, registered_places())):
        if peer is not None:
            try:
                found[name] = error(peer(session, located), truth)
            except (LidarposeError, ValueError):
                continue
    return found, limit


def error(pose: Pose, truth: CornerTruth) -> FloatArray:
    """Rotation (deg) and position (mm)."""
    metres, radians = pose.distance(truth.T_world_lidar)
    return np.array([np.degrees(radians), 1e3 * metres])


@dataclass(frozen=True, eq=False)
class _Studied:
    errors: dict[str, FloatArray]
    bound: FloatArray
    runs: int

    def over_bound(self, method: str) -> FloatArray:
        return np.asarray(rms(self.errors[method]) / self.bound)


def study(settings: dict[Setting, int]) -> dict[Setting, _Studied]:
    """All trials of all settings (with how many runs each) on all cores."""
    trials = [(setting, seed) for setting, runs in settings.items() for seed in range(runs)]
    outcomes = in_processes(_trial, trials)
    studied = {}
    for setting, runs in settings.items():
        mine = [outcome for (s, _), outcome in zip(trials, outcomes, strict=True) if s == setting]
        by_method = {m: np.array([e[m] for e, _ in mine if m in e]).reshape(-1, 2) for m in METHODS}
        studied[setting] = _Studied(by_method, rms([limit for _, limit in mine]), runs)
    return studied


def run(effort: Effort) -> Report:
    axes = AXES if not effort.quick else (replace(AXES[0], values=(1, 2)),)
    settings = {axis.setting(value): effort.pick(5, 2) for axis in axes for value in axis.values}
    settings[Setting()] = effort.pick(12, 2)
    studied = study(settings)
    middle = studied[Setting()]
    joint, paper = middle.over_bound(JOINT), middle.over_bound(PAPER)
    figures = {
        "corner.joint_deg": float(joint[0]),
        "corner.joint_mm": float(joint[1]),
        "corner.paper_mm": float(paper[1]),
    }
    peers = [float(middle.over_bound(m)[1]) for m in (OPEN3D, ICP) if len(middle.errors[m])]
    if peers:
        figures["corner.peer_mm"] = min(peers)
    return Report(figures, [_table(middle)], [_curve(axis, studied) for axis in axes])


def _table(studied: _Studied) -> Table:
    rows: list[list[object]] = []
    for method in METHODS:
        e, n = rms(studied.errors[method]), len(studied.errors[method])
        if n == 0 and method in (OPEN3D, ICP):
            rows.append([method, *[None] * 5])
        else:
            rows.append([method, *e, *(e / studied.bound), f"{n} of {studied.runs}"])
    rows.append(["Cramer-Rao bound", *studied.bound, 1, 1, ""])
    columns = ["method", "deg RMS", "mm RMS", "deg over the bound", "mm over it", "answers"]
    chance = f"{studied.runs} runs: {by_chance(studied.runs)}."
    return Table("Methods for the world pose, one frame a place", columns, rows, f"{_TEXT} {chance}")


_TEXT = " ".join(
    (
        "Pose 1 of the corner paper: a cube of half a metre at six places, a simulated HDL-32 with 8 mm noise, mixed",
        "pixels and lost beams. Every method is told where the target stands (found by lidarpose) and works on the",
        "same returns; the bound is that of every return that truly is of a face.",
    )
)


def _curve(axis: _Axis, studied: dict[Setting, _Studied]) -> Curve:
    settings = [studied[axis.setting(value)] for value in axis.values]
    series = {
        m: [float(s.over_bound(m)[1]) for s in settings] for m in METHODS if any(len(s.errors[m]) for s in settings)
    }
    absolute = ", ".join(f"{s.bound[1]:.3g}" for s in settings)
    runs = min(s.runs for s in settings)
    text = f"Position, RMS of {runs} runs or more ({by_chance(runs)}). The bound itself, in mm: {absolute}."
    title = f"Methods for the world pose over {axis.label}"
    return Curve(f"corner-{axis.name}", title, axis.label, "error over the bound", axis.values, series, text)
