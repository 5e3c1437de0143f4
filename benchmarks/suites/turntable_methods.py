"""The turntable's motion by the literature's methods, the paper's and ours, on the same simulated observations.

A V board put up several times before a turning LiDAR, so that methods which need no visible stripe have a chance too.
The limit is the Cramer-Rao bound of all measurements, and beside it that of boards and ranges without the stripe.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from benchmarks.limits import CORNER_PX, STEP_PX, STRIPE_PX, motion_bound, pose_limits
from benchmarks.peers.plane_views import PlaneView, views_by_reading
from benchmarks.peers.rigid_methods import dong_isler, guo_roumeliotis, zhang_pless, zhang_pless_linear
from benchmarks.peers.turning_methods import circle_of_poses, points_on_planes
from benchmarks.report import Curve, Effort, Report, Table
from benchmarks.studies import by_chance, in_processes, rms
from lidarpose.errors import LidarposeError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.observation import TurntableObservations
from lidarpose.model.turntable import TurntableMotion
from lidarpose.refine.turntable import JointOptions, refine_turntable
from lidarpose.simulate.observations import simulate_observations
from lidarpose.simulate.rig import TurntableRig, draw_rig
from lidarpose.solve.paper import solve_paper
from lidarpose.solve.turntable_function import fit_by_circles

# What the simulator leaves off a board's edges, which the peer that uses them is told.
INSET_M = 0.004
MOST_PLACEMENTS, READINGS = 6, 22

JOINT = "lidarpose, joint"
BLIND = "lidarpose, joint, without the stripe"
PAPER = "lidarpose, paper with known readings"
CIRCLES = "turntable paper (Liu et al. 2022), circles"
ONE_MOTION = "points on planes, one motion (cost of Zhang, Pless 2004)"
LITERATURE = {
    "zhang-pless-linear": "Zhang, Pless 2004, linear; circle of poses",
    "zhang-pless": "Zhang, Pless 2004, refined; circle of poses",
    "guo-roumeliotis": "Guo, Roumeliotis 2013; circle of poses",
    "dong-isler": "Dong, Isler 2018, V board; circle of poses",
}
METHODS = (JOINT, PAPER, BLIND, CIRCLES, ONE_MOTION, *LITERATURE.values())
OURS = (JOINT, PAPER, BLIND, CIRCLES)
WITHOUT_STRIPE = "bound without the stripe"


@dataclass(frozen=True)
class Setting:
    """One point of a curve; the defaults are the middle of all of them."""

    range_sigma_m: float = 0.001
    readings: int = READINGS
    arc_deg: float = 21.5
    placements: int = 4
    distance_m: float | None = None


@dataclass(frozen=True)
class _Axis:
    """What a curve is drawn over: values as the page shows them, and the setting of each."""

    name: str
    label: str
    values: tuple[float, ...]
    setting: Callable[[float], Setting]


AXES = (
    _Axis("noise", "range noise, mm", (0.3, 1.0, 3.0, 10.0), lambda v: Setting(range_sigma_m=1e-3 * v)),
    _Axis("places", "readings (4 boards at each)", (4, 8, 22, 44), lambda v: Setting(readings=int(v))),
    _Axis("arc", "arc, degrees", (2.7, 5.4, 10.75, 21.5), lambda v: Setting(arc_deg=v)),
    _Axis("boards", "placements of the board", (1, 2, 3, 4, 6), lambda v: Setting(placements=int(v))),
    _Axis(
        "distance",
        "distance, m (arc 8 degrees)",
        (0.7, 1.0, 1.4, 2.0, 3.0),
        lambda v: Setting(arc_deg=8.0, distance_m=v),
    ),
)


@lru_cache(maxsize=1)
def _base() -> TurntableRig:
    return draw_rig(1, places=READINGS, placements=MOST_PLACEMENTS)


@lru_cache(maxsize=8)
def rig_of(setting: Setting) -> TurntableRig:
    """The one rig of this study with the setting's readings, boards, noise and distance."""
    base = _base()
    angles = base.turntable_angle_rad
    middle = 0.5 * float(angles.min() + angles.max())
    reading = middle + np.deg2rad(setting.arc_deg) * np.linspace(-0.5, 0.5, setting.readings)
    names = list(base.T_camera_panel)[: setting.placements]
    rig = replace(
        base,
        T_camera_panel={name: base.T_camera_panel[name] for name in names},
        turntable_angle_rad=np.tile(reading, len(names)),
        placement=tuple(name for name in names for _ in reading),
        range_sigma_m=setting.range_sigma_m,
    )
    return rig if setting.distance_m is None else _at_distance(rig, middle, setting.distance_m)


def _at_distance(rig: TurntableRig, middle: float, distance_m: float) -> TurntableRig:
    """The rig with LiDAR and turntable moved along the line to the board, until they are `distance_m` from it."""
    board = np.mean([pose.translation for poses in rig.T_camera_panel.values() for pose in poses], axis=0)
    away = rig.motion.pose(middle).translation - board
    shift = away * (distance_m / float(np.linalg.norm(away)) - 1.0)
    table = rig.motion.T_camera_turntable
    moved = Pose(table.rotation, table.translation + shift)
    return replace(rig, motion=TurntableMotion(moved, rig.motion.T_turntable_lidar))


def observe(rig: TurntableRig, seed: int) -> TurntableObservations:
    """Corners, stripes and ranges with the noise that the bound is for."""
    return simulate_observations(
        rig, corner_sigma_px=CORNER_PX, stripe_sigma_px=STRIPE_PX / np.sqrt(STEP_PX), stripe_step_px=STEP_PX, seed=seed
    )


def motions(rig: TurntableRig, observations: TurntableObservations) -> dict[str, TurntableMotion]:
    """What each method makes of one set of observations; those that cannot are missing."""
    found: dict[str, TurntableMotion] = {}
    start = solve_paper(observations)
    found[PAPER] = start.motion
    reading = {place.position: place.turntable_angle_rad for place in observations.places}
    sampled = [(reading[position], sample.pose) for position, sample in start.samples.items()]
    found[CIRCLES] = fit_by_circles([a for a, _ in sampled], [pose for _, pose in sampled]).motion
    poses = {name: tuple(p.T_camera_panel for p in ps) for name, ps in start.panel_poses.items()}
    options = JointOptions(search_alternatives=False)
    found[JOINT] = refine_turntable(observations, start.motion, poses, options).motion
    found.update(_literature(rig, views_by_reading(observations)))
    if ONE_MOTION in found:
        blind = replace(options, use_stripes=False)
        found[BLIND] = refine_turntable(observations, found[ONE_MOTION], poses, blind).motion
    return found


def _literature(rig: TurntableRig, views: Mapping[float, list[PlaneView]]) -> dict[str, TurntableMotion]:
    poses: dict[str, dict[float, Pose]] = {name: {} for name in LITERATURE}
    for reading, boards in views.items():
        least = guo_roumeliotis(boards)
        ways = {"zhang-pless-linear": zhang_pless_linear(boards), "zhang-pless": zhang_pless(boards)}
        ways["guo-roumeliotis"] = least
        if least is not None:
            ways["dong-isler"] = dong_isler(boards, least, rig.panels, rig.margin_m, INSET_M)
        for name, pose in ways.items():
            if pose is not None:
                poses[name][reading] = pose
    found = {
        LITERATURE[name]: circle_of_poses(list(by_reading), list(by_reading.values()))
        for name, by_reading in poses.items()
        if len(by_reading) >= 3
    }
    if LITERATURE["guo-roumeliotis"] in found:
        found[ONE_MOTION] = points_on_planes(views, found[LITERATURE["guo-roumeliotis"]])
    return found


Errors = dict[str, FloatArray]
"""By method: centre (mm), rotation (deg) in the middle of the arc, and the same half a turn away."""


def _trial(task: tuple[Setting, int]) -> Errors:
    setting, seed = task
    rig = rig_of(setting)
    try:
        found = motions(rig, observe(rig, seed))
    except (LidarposeError, ValueError, np.linalg.LinAlgError):
        return {}
    return {name: _errors(rig, motion) for name, motion in found.items()}


def _middle(rig: TurntableRig) -> float:
    return 0.5 * float(rig.turntable_angle_rad.min() + rig.turntable_angle_rad.max())


def _errors(rig: TurntableRig, motion: TurntableMotion) -> FloatArray:
    out: list[float] = []
    for reading in (_middle(rig), _middle(rig) + np.pi):
        metres, radians = motion.pose(reading).distance(rig.motion.pose(reading))
        out += [1e3 * metres, float(np.degrees(radians))]
    return np.array(out)


def _limits(task: tuple[Setting, bool]) -> FloatArray:
    """The bound in the units and order of `_errors`; infinite where the data leave the motion open."""
    setting, with_stripe = task
    rig = rig_of(setting)
    try:
        bound = motion_bound(rig, with_stripe=with_stripe)
    except np.linalg.LinAlgError:
        return np.full(4, np.inf)
    if not np.all(np.linalg.eigvalsh(bound) > 0.0) or bound.max() > 1e4:
        return np.full(4, np.inf)
    out: list[float] = []
    for reading in (_middle(rig), _middle(rig) + np.pi):
        metres, radians = pose_limits(rig, bound, reading)
        out += [1e3 * metres, float(np.degrees(radians))]
    return np.array(out)


@dataclass(frozen=True, eq=False)
class _Studied:
    """Errors of every trial by method, and both bounds, of one setting."""

    errors: dict[str, FloatArray]
    bound: FloatArray
    without_stripe: FloatArray

    def ratio(self, method: str) -> float:
        """RMS error of the centre inside the arc, over the bound of everything."""
        if method == WITHOUT_STRIPE:
            return float(self.without_stripe[0] / self.bound[0])
        rows = self.errors.get(method, np.zeros((0, 4)))
        return float(rms(rows)[0] / self.bound[0])


def study(settings: dict[Setting, int]) -> dict[Setting, _Studied]:
    """All trials of all settings (with how many runs each) on all cores."""
    trials = [(setting, seed) for setting, runs in settings.items() for seed in range(runs)]
    outcomes = in_processes(_trial, trials)
    bounds = in_processes(_limits, [(setting, stripe) for setting in settings for stripe in (True, False)])
    studied = {}
    for k, setting in enumerate(settings):
        mine = [errors for (s, _), errors in zip(trials, outcomes, strict=True) if s == setting]
        by_method = {m: np.array([e[m] for e in mine if m in e]).reshape(-1, 4) for m in METHODS}
        studied[setting] = _Studied(by_method, bounds[2 * k], bounds[2 * k + 1])
    return studied


def run(effort: Effort) -> Report:
    runs = effort.pick(6, 2)
    axes = AXES if not effort.quick else tuple(replace(a, values=a.values[:2]) for a in AXES[:2])
    settings = {axis.setting(value): runs for axis in axes for value in axis.values}
    settings[Setting()] = effort.pick(24, 4)
    studied = study(settings)
    middle = studied[Setting()]
    joint, paper = (rms(middle.errors[m]) / middle.bound for m in (JOINT, PAPER))
    figures = {
        "turntable.joint_mm": float(joint[0]),
        "turntable.joint_deg": float(joint[1]),
        "turntable.paper_mm": float(paper[0]),
        "turntable.blind_mm": float(rms(middle.errors[BLIND])[0] / middle.without_stripe[0]),
        "turntable.peer_mm": min(middle.ratio(m) for m in METHODS if m not in OURS),
    }
    curves = [_curve(axis, studied, runs) for axis in axes]
    return Report(figures, [_table(middle)], curves)


def _table(studied: _Studied) -> Table:
    rows: list[list[object]] = []
    for method in METHODS:
        e = rms(studied.errors[method])
        rows.append([method, *e, e[0] / studied.bound[0], e[1] / studied.bound[1], len(studied.errors[method])])
    for name, limit in (("Cramer-Rao bound", studied.bound), (WITHOUT_STRIPE, studied.without_stripe)):
        rows.append([name, *limit, limit[0] / studied.bound[0], limit[1] / studied.bound[1], ""])
    columns = ["method", "mm", "deg", "mm, half a turn away", "deg", "mm over the bound", "deg over it", "runs"]
    runs = len(studied.errors[JOINT])
    return Table("Methods for the turntable", columns, rows, f"{_TEXT} {runs} runs: {by_chance(runs)}.")


_TEXT = " ".join(
    (
        f"{READINGS} readings over 21.5 degrees, four placements of the board at each (the geometry of the turntable",
        f"paper, doi 10.13382/j.jemi.B2205942); corners {CORNER_PX} px, stripe {STRIPE_PX} px a pixel along it, ranges",
        "1 mm; no outliers, every point assigned rightly. Root mean square errors in the middle of the arc, and half a",
        "turn away. Only lidarpose and the paper use the stripe: that is what separates them from methods for a laser",
        "that no camera sees, whose own limit is the last line; the joint estimate without the stripe is held against",
        "that one. *Circle of poses*: a pose at each reading, averaged rotations (Hartley et al. 2013), Kasa's circle",
        "(1976). Board poses are the same for all: Zhang's homography (2000), refined by reprojection.",
    )
)


def _curve(axis: _Axis, studied: dict[Setting, _Studied], runs: int) -> Curve:
    settings = [studied[axis.setting(value)] for value in axis.values]
    series = {m: [s.ratio(m) for s in settings] for m in (*METHODS, WITHOUT_STRIPE)}
    text = f"Centre in the middle of the arc, RMS of {runs} runs or more; 1 is the Cramer-Rao bound there"
    absolute = ", ".join(f"{s.bound[0]:.3g}" for s in settings)
    return Curve(
        f"turntable-{axis.name}",
        f"Methods for the turntable over {axis.label}",
        axis.label,
        "error over the bound",
        axis.values,
        series,
        f"{text} ({by_chance(runs)}). The bound itself, in mm: {absolute}.",
    )
