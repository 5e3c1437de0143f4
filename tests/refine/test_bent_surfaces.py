"""Smooth shapes of surfaces and what they do to a mounting: sampled, with waves, which the estimate does not know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.se3 import Pose, exp_so3, log_so3
from lidarpose.model.spun_scan import FlatReturns
from lidarpose.refine.bent_surfaces import bend_of
from lidarpose.refine.flatness import solve, start_state
from lidarpose.refine.mounting import refine_mounting

FREE = np.arange(4)
START = Pose(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), np.zeros(3))
TRUTH = Pose(exp_so3(np.radians([0.8, -0.6, 0.0])) @ START.rotation, np.array([0.02, -0.01, 0.0]))
PLANES = [
    Plane(np.array(row[:3]), row[3] * float(np.linalg.norm(row[:3])))
    for row in [
        (0.99, 0.05, 0.1, 3.0),
        (0.1, 0.98, 0.05, 2.2),
        (-0.95, 0.2, 0.0, 2.6),
        (0.1, -0.99, 0.2, 1.9),
        (0.02, -0.05, -1.0, 1.1),
        (0.05, 0.1, 0.99, 1.5),
    ]
]


def room() -> tuple[FlatReturns, FloatArray, FloatArray]:
    """Exact returns of a room, and where and how squarely each beam meets its surface."""
    reading, beam = (
        a.ravel() for a in np.meshgrid(np.linspace(0.0, 6.1, 36), np.linspace(-1.4, 1.4, 40), indexing="ij")
    )
    c, s = np.cos(beam), np.sin(beam)
    fan = np.stack([c, s, 0.0 * c], -1)
    poses = [Pose.rot_z(float(a)) @ TRUTH for a in reading]
    direction = np.stack([p.rotation @ f for p, f in zip(poses, fan, strict=True)])
    origin = np.stack([p.translation for p in poses])
    n, d = np.stack([p.normal for p in PLANES]), np.array([p.offset for p in PLANES])
    with np.errstate(divide="ignore"):
        met = (d - origin @ n.T) / (direction @ n.T)
    met[met <= 0.0] = np.inf
    surface = np.argmin(met, axis=1)
    ranges = met.min(axis=1)
    sweep = np.repeat(np.arange(36), 40)
    cosine = np.abs((direction * n[surface]).sum(axis=1))
    return FlatReturns(reading, beam, ranges, sweep, surface), origin + ranges[:, None] * direction, cosine


def bulged(exact: FlatReturns, where: FloatArray, cosine: FloatArray, rms_m: float, seed: int) -> FlatReturns:
    """Every surface bent by a sum of random waves, metres long, of this root mean square, and noise on the ranges."""
    rng = np.random.default_rng(seed)
    ranges = exact.range_m + 0.003 * rng.normal(size=len(exact))
    for k in range(exact.surfaces):
        mine = exact.surface == k
        shape = np.zeros(int(mine.sum()))
        for _ in range(4):
            wave = rng.normal(size=3)
            wave *= rng.uniform(0.8, 2.5) / np.linalg.norm(wave)
            shape += np.sin(where[mine] @ wave + rng.uniform(0.0, 2.0 * np.pi)) / np.sqrt(2.0)
        ranges[mine] += rms_m * shape / np.maximum(cosine[mine], 0.2)
    return replace(exact, range_m=ranges)


def off(found: Pose) -> FloatArray:
    return np.concatenate([log_so3(found.rotation @ TRUTH.rotation.T)[:2], (found.translation - TRUTH.translation)[:2]])


def test_flat_surfaces_have_next_to_no_bend() -> None:
    exact, where, cosine = room()
    for seed in range(3):
        returns = bulged(exact, where, cosine, 0.0, seed)
        solution = solve(returns, start_state(returns, START, np.zeros(3), 0.0), FREE, 0.0)
        assert bend_of(solution, returns, solution.line.by_all[:, FREE]).spread_m < 2e-4


def test_the_spread_is_that_of_shapes_put_in() -> None:
    exact, where, cosine = room()
    found = []
    for seed in range(6):
        returns = bulged(exact, where, cosine, 0.004, seed)
        solution = solve(returns, start_state(returns, START, np.zeros(3), 0.0), FREE, 0.0)
        found.append(bend_of(solution, returns, solution.line.by_all[:, FREE]).spread_m)
    # What is left of 4 mm where a plane is taken out, over seven shapes.
    assert 0.0005 < np.median(found) < 0.004
    less = bulged(exact, where, cosine, 0.001, 0)
    solution = solve(less, start_state(less, START, np.zeros(3), 0.0), FREE, 0.0)
    assert bend_of(solution, less, solution.line.by_all[:, FREE]).spread_m < 0.5 * found[0]


def test_bent_walls_are_paid_for_and_not_called_good() -> None:
    exact, where, cosine = room()
    nees, verdicts = [], []
    for seed in range(40):
        estimate = refine_mounting(bulged(exact, where, cosine, 0.002, 100 + seed), START)
        error = off(estimate.T_table_lidar)
        nees.append(float(error @ np.linalg.solve(estimate.covariance, error)) / 4.0)
        verdicts.append(estimate.quality.verdict)
    # Known to a third are standard deviations of six surfaces: 1.7 over many rooms, and no more than chance above it.
    assert np.mean(nees) < 2.3
    assert verdicts.count("good") <= 2
