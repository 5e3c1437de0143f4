"""A mounting from flat surfaces: derivatives, covariance by sampling, refusals. Returns are made by plain geometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.se3 import Pose, exp_so3, log_so3
from lidarpose.model.spun_scan import FlatReturns, ReadingJump
from lidarpose.refine.flatness import N_ALL, SpunState, linearise, solve, start_state
from lidarpose.refine.mounting import mounting_calibration, refine_mounting
from lidarpose.refine.mounting_verdict import MountingOptions
from lidarpose.refine.sweep_turning import moved_by_jumps

# Of a room without a single right angle.
WALLS = [(0.99, 0.05, 0.1, 3.0), (0.1, 0.98, 0.05, 2.2), (-0.95, 0.2, 0.0, 2.6), (0.1, -0.99, 0.2, 1.9)]
FLOOR_AND_CEILING = [(0.02, -0.05, -1.0, 1.1), (0.05, 0.1, 0.99, 1.5)]
UPRIGHT = Pose(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), np.zeros(3))


def planes_of(rows: list[tuple[float, float, float, float]]) -> list[Plane]:
    return [Plane(np.array(row[:3]), row[3] * float(np.linalg.norm(row[:3]))) for row in rows]


def seen(
    planes: list[Plane],
    T_table_lidar: Pose,
    *,
    noise_m: float,
    seed: int,
    sweeps: int = 60,
    beams: int = 90,
    slip_rad: float = 0.0,
    jump_rad: float = 0.0,
) -> FlatReturns:
    """What each sweep's half fan returns: the nearest plane, ray by ray. Readings may be off,
    each by itself or from somewhere on."""
    rng = np.random.default_rng(seed)
    readings = np.linspace(0.0, 2.0 * np.pi, sweeps, endpoint=False)
    angles = np.linspace(-1.4, 1.4, beams)
    columns: list[list[float]] = []
    for i, reading in enumerate(readings):
        jump = jump_rad if i >= 5 * sweeps // 12 else 0.0
        pose = Pose.rot_z(float(reading + jump + slip_rad * rng.normal())) @ T_table_lidar
        for angle in angles:
            d = pose.rotation @ np.array([np.cos(angle), np.sin(angle), 0.0])
            with np.errstate(divide="ignore"):
                met = np.array([(p.offset - p.normal @ pose.translation) / (p.normal @ d) for p in planes])
            met[met <= 0.0] = np.inf
            k = int(np.argmin(met))
            if not np.isfinite(met[k]) or met[k] > 20.0:
                continue
            r = met[k] + noise_m * rng.normal()
            columns.append([reading, angle, r, i, k])
    table = np.array(columns)
    surface = np.unique(table[:, 4], return_inverse=True)[1]
    return FlatReturns(table[:, 0], table[:, 1], table[:, 2], table[:, 3].astype(np.int64), surface.astype(np.int64))


def mounted(tilt_deg: tuple[float, float], shift_m: tuple[float, float]) -> Pose:
    return Pose(exp_so3(np.radians([*tilt_deg, 0.0])) @ UPRIGHT.rotation, np.array([*shift_m, 0.0]))


def errors(found: Pose, truth: Pose) -> FloatArray:
    """Of two tilts and two shifts."""
    return np.concatenate([log_so3(found.rotation @ truth.rotation.T)[:2], (found.translation - truth.translation)[:2]])


def test_derivatives_are_those_of_the_prediction() -> None:
    truth = mounted((1.0, -2.0), (0.03, -0.02))
    returns = seen(planes_of(WALLS + FLOOR_AND_CEILING), truth, noise_m=0.0, seed=0, sweeps=12, beams=20)
    planes = tuple(planes_of(WALLS + FLOOR_AND_CEILING))
    state = SpunState(mounted((0.4, -1.0), (0.0, 0.01)), np.array([0.01, 0.02, -0.01]), planes)
    line = linearise(state, returns, 1.0)
    assert line.usable.mean() > 0.9
    h = 1e-6
    for j in range(N_ALL):
        step = np.zeros(N_ALL)
        step[j] = h
        ahead, behind = (linearise(state.moved(s * step, planes), returns, 1.0).residual for s in (1.0, -1.0))
        # A residual is measured less predicted.
        numeric = -(ahead - behind) / (2.0 * h)
        np.testing.assert_allclose(line.by_all[line.usable, j], numeric[line.usable], rtol=1e-5, atol=1e-5)


def test_exact_ranges_give_the_mounting_exactly() -> None:
    truth = mounted((2.0, -3.0), (0.05, -0.03))
    returns = seen(planes_of(WALLS + FLOOR_AND_CEILING), truth, noise_m=0.0, seed=0)
    estimate = refine_mounting(returns, UPRIGHT)
    assert np.abs(errors(estimate.T_table_lidar, truth)).max() < 1e-6


def test_the_covariance_is_that_of_repeated_recordings() -> None:
    planes = planes_of(WALLS + FLOOR_AND_CEILING)
    nees = []
    for seed in range(24):
        rng = np.random.default_rng(1000 + seed)
        truth = mounted(tuple(rng.uniform(-2.0, 2.0, 2)), tuple(rng.uniform(-0.03, 0.03, 2)))
        returns = seen(planes, truth, noise_m=0.01, seed=seed, sweeps=36, beams=36)
        estimate = refine_mounting(returns, UPRIGHT)
        off = errors(estimate.T_table_lidar, truth)
        nees.append(float(off @ np.linalg.solve(estimate.covariance, off)) / 4.0)
        assert estimate.quality.verdict == "good" or estimate.spread_factor > 1.0
    # 96 squares: a standard deviation of 0.14.
    assert 0.6 < np.mean(nees) < 1.45


def warped(returns: FlatReturns, T_table_lidar: Pose, bent_m: float, seed: int) -> FlatReturns:
    """Each surface bent in three waves of its own, a few metres long."""
    rng = np.random.default_rng(seed)
    c, s = np.cos(returns.beam_rad), np.sin(returns.beam_rad)
    flat = returns.range_m[:, None] * np.stack([c, s, 0.0 * c], -1)
    where = np.stack(
        [(Pose.rot_z(float(a)) @ T_table_lidar) @ p for a, p in zip(returns.reading_rad, flat, strict=True)]
    )
    ranges = returns.range_m.copy()
    for k in range(returns.surfaces):
        mine = returns.surface == k
        for _ in range(3):
            wave = rng.normal(size=3)
            wave *= rng.uniform(0.8, 2.5) / np.linalg.norm(wave)
            ranges[mine] += bent_m * np.sin(where[mine] @ wave + rng.uniform(0.0, 2.0 * np.pi))
    return replace(returns, range_m=ranges)


@pytest.mark.slow
def test_bent_walls_widen_the_covariance() -> None:
    planes = planes_of(WALLS + FLOOR_AND_CEILING)
    truth = mounted((0.8, -0.6), (0.02, -0.01))
    nees, flat_sigma, bent_sigma, verdicts = [], [], [], []
    for seed in range(10):
        returns = seen(planes, truth, noise_m=0.003, seed=seed, sweeps=36, beams=45)
        flat = refine_mounting(returns, UPRIGHT)
        bent = refine_mounting(warped(returns, truth, 0.003, seed), UPRIGHT)
        off = errors(bent.T_table_lidar, truth)
        nees.append(float(off @ np.linalg.solve(bent.covariance, off)) / 4.0)
        flat_sigma.append(np.sqrt(np.trace(flat.covariance)))
        bent_sigma.append(np.sqrt(np.trace(bent.covariance)))
        verdicts.append(bent.quality.verdict)
    assert np.mean(bent_sigma) > 3.0 * np.mean(flat_sigma)
    # Six surfaces are few to tell from how far they are bent: the ratio has a long tail.
    assert np.median(nees) < 2.5
    assert verdicts.count("doubtful") >= 7


def test_a_factor_on_beam_angles_is_named_and_then_found() -> None:
    truth = mounted((0.8, -0.6), (0.02, -0.01))
    true = seen(planes_of(WALLS + FLOOR_AND_CEILING), truth, noise_m=0.005, seed=3)
    stated = FlatReturns(true.reading_rad, true.beam_rad / 1.02, true.range_m, true.sweep, true.surface)
    plain = refine_mounting(stated, UPRIGHT)
    assert plain.quality.verdict == "doubtful"
    assert [e.name for e in plain.extras if e.suggested] == ["beam_angle_scale"]
    assert any("--estimate beam-angle-scale" in reason for reason in plain.quality.reasons)
    found = refine_mounting(stated, UPRIGHT, MountingOptions(("beam_angle_scale",)))
    assert found.quality.verdict == "good"
    (extra,) = [e for e in found.extras if e.estimated]
    assert abs(extra.value - 0.02) < 4.0 * extra.sigma
    assert extra.sigma < 0.002
    assert np.degrees(np.abs(errors(found.T_table_lidar, truth)[:2]).max()) < 0.1


@pytest.mark.parametrize(("name", "value"), [("range_offset_m", 0.03), ("encoder_scale", -0.02)])
def test_other_parameters_are_found_too(name: str, value: float) -> None:
    truth = mounted((0.8, -0.6), (0.02, -0.01))
    true = seen(planes_of(WALLS + FLOOR_AND_CEILING), truth, noise_m=0.005, seed=4)
    if name == "range_offset_m":
        stated = FlatReturns(true.reading_rad, true.beam_rad, true.range_m + value, true.sweep, true.surface)
    else:
        middle = 0.5 * (true.reading_rad.min() + true.reading_rad.max())
        readings = middle + (true.reading_rad - middle) / (1.0 + value)
        stated = FlatReturns(readings, true.beam_rad, true.range_m, true.sweep, true.surface)
    plain = refine_mounting(stated, UPRIGHT)
    assert plain.quality.verdict == "doubtful"
    # What is seen but not estimated is paid for.
    off = errors(plain.T_table_lidar, truth)
    assert off @ np.linalg.solve(plain.covariance, off) < 25.0
    found = refine_mounting(stated, UPRIGHT, MountingOptions((name,)))
    (extra,) = [e for e in found.extras if e.estimated]
    assert abs(extra.value - value) < 4.0 * extra.sigma + 1e-5
    assert np.degrees(np.abs(errors(found.T_table_lidar, truth)[:2]).max()) < 0.15


def test_readings_that_slip_are_named() -> None:
    truth = mounted((0.8, -0.6), (0.02, -0.01))
    returns = seen(planes_of(WALLS + FLOOR_AND_CEILING), truth, noise_m=0.005, seed=5, slip_rad=np.radians(0.6))
    estimate = refine_mounting(returns, UPRIGHT)
    assert estimate.quality.verdict == "doubtful"
    # The worst sweeps are outliers to the estimate, so that it says less than is there.
    assert 0.25 < np.degrees(estimate.reading_scatter_rad) < 0.8
    assert any("slips" in reason for reason in estimate.quality.reasons)


@pytest.mark.parametrize("jump_deg", [2.0, -3.0])
def test_a_table_that_slips_once_is_named_with_its_place(jump_deg: float) -> None:
    truth = mounted((0.8, -0.6), (0.02, -0.01))
    planes = planes_of(WALLS + FLOOR_AND_CEILING)
    returns = seen(planes, truth, noise_m=0.005, seed=5, sweeps=120, beams=60, jump_rad=np.radians(jump_deg))
    estimate = refine_mounting(returns, UPRIGHT)
    (jump,) = estimate.jumps
    assert jump.sweeps == (49, 50)
    assert np.degrees(jump.stated_rad) == pytest.approx(3.0)
    assert np.degrees(jump.seen_rad) == pytest.approx(3.0 + jump_deg, abs=0.4)
    assert estimate.quality.verdict == "doubtful"
    assert any("between sweeps 49 and 50" in reason for reason in estimate.quality.reasons)
    sound = refine_mounting(seen(planes, truth, noise_m=0.005, seed=5, sweeps=120, beams=60), UPRIGHT)
    assert sound.jumps == ()


@pytest.mark.parametrize(("jump_deg", "at"), [(0.5, 80), (-2.0, 30), (4.0, 80)])
def test_what_a_jump_moves_the_mounting_by(jump_deg: float, at: int) -> None:
    """Predicted where the jump is, and found by estimating without it."""
    sound = seen(
        planes_of(WALLS + FLOOR_AND_CEILING),
        mounted((0.8, -0.6), (0.02, -0.01)),
        noise_m=0.002,
        seed=5,
        sweeps=120,
        beams=60,
    )
    jump = np.radians(jump_deg)
    slipped = replace(sound, reading_rad=sound.reading_rad - np.where(sound.sweep >= at, jump, 0.0))
    free = MountingOptions().free
    there, without = (
        solve(returns, start_state(returns, UPRIGHT, np.zeros(3), np.pi), free, np.pi) for returns in (slipped, sound)
    )
    (moved,) = moved_by_jumps(there, slipped, free, [ReadingJump((at - 1, at), 0.0, jump)])
    found = errors(without.state.T_table_lidar, there.state.T_table_lidar)
    np.testing.assert_allclose(moved[:2], found[:2], atol=2e-4)
    np.testing.assert_allclose(moved[2:], found[2:], atol=5e-4)


def test_sweeps_that_changed_places_are_not_called_good() -> None:
    truth = mounted((0.8, -0.6), (0.02, -0.01))
    returns = seen(planes_of(WALLS + FLOOR_AND_CEILING), truth, noise_m=0.005, seed=5, sweeps=120, beams=60)
    # The first with the second, the third with the fourth ...
    step = 2.0 * np.pi / 120
    swapped = replace(returns, reading_rad=returns.reading_rad + np.where(returns.sweep % 2 == 0, step, -step))
    estimate = refine_mounting(swapped, UPRIGHT)
    assert estimate.quality.verdict == "doubtful"
    assert np.degrees(estimate.reading_scatter_rad) > 1.5


@pytest.mark.parametrize("rows", [FLOOR_AND_CEILING, FLOOR_AND_CEILING[:1], WALLS[:2]])
def test_too_few_surfaces_are_refused(rows: list[tuple[float, float, float, float]]) -> None:
    returns = seen(planes_of(rows), mounted((1.0, 1.0), (0.0, 0.0)), noise_m=0.005, seed=6)
    with pytest.raises(UndeterminedError, match="three"):
        refine_mounting(returns, UPRIGHT)


def test_parallel_surfaces_are_refused_or_uncertain() -> None:
    # A floor and two ceilings tell the tilt of the fan against the axis hardly, and one shift not at all.
    rows = [(0.0, 0.0, -1.0, 1.1), (0.0, 0.0, 1.0, 1.5)]
    returns = seen(planes_of(rows), mounted((1.0, 1.0), (0.01, 0.0)), noise_m=0.005, seed=7)
    far = (returns.surface == 1) & (returns.reading_rad > np.pi)
    three = FlatReturns(
        returns.reading_rad, returns.beam_rad, returns.range_m, returns.sweep, np.where(far, 2, returns.surface)
    )
    with pytest.raises(UndeterminedError, match="leave the mounting open"):
        refine_mounting(three, UPRIGHT)


def test_the_file_says_what_the_estimate_does() -> None:
    truth = mounted((2.0, -1.0), (0.05, -0.03))
    estimate = refine_mounting(seen(planes_of(WALLS + FLOOR_AND_CEILING), truth, noise_m=0.005, seed=8), UPRIGHT)
    calibration = mounting_calibration(estimate)
    for reading in (-1.0, 0.3, 2.5):
        there = Pose.rot_z(reading) @ estimate.T_table_lidar
        assert max(calibration.pose(reading).distance(there)) < 1e-9
        # Its covariance is that of the four numbers, by numerical derivatives of the pose.
        J = np.zeros((6, 4))
        h = 1e-6
        for j in range(4):
            step = np.zeros(4)
            step[j] = h
            rotation = exp_so3(np.array([step[0], step[1], 0.0])) @ estimate.T_table_lidar.rotation
            moved = Pose(rotation, estimate.T_table_lidar.translation + np.array([step[2], step[3], 0.0]))
            J[:, j] = (Pose.rot_z(reading) @ moved).minus(there) / h
        uncertain = calibration.uncertain_pose(reading)
        assert uncertain is not None
        np.testing.assert_allclose(uncertain.covariance, J @ estimate.covariance @ J.T, rtol=1e-4, atol=1e-12)
