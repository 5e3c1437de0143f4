"""Straight lines in 2D scans of made-up rooms with a V board, poles, clutter, mixed pixels and dropouts."""

from __future__ import annotations

import json
import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from lidarpose.detect.scan_lines import find_lines, merge_sweeps, range_noise
from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.lines import fit_line2
from lidarpose.model.scan import LidarSpec, Scan

DATA = Path(__file__).parents[3] / "shared" / "data"
POLE = 100
MIXED = -2


@dataclass(frozen=True)
class Room:
    """Straight walls (K, 2, 2), the first two the panels of a V board, and round poles (x, y, radius)."""

    walls: FloatArray
    poles: FloatArray


def draw_room(rng: np.random.Generator) -> Room:
    facing, distance = rng.uniform(-1.0, 1.0), rng.uniform(0.6, 2.0)
    fold = distance * np.array([np.cos(facing), np.sin(facing)])
    opening, turn = np.deg2rad(rng.uniform(80.0, 165.0)), rng.uniform(-0.3, 0.3)
    walls = []
    for sign in (1.0, -1.0):
        direction = facing + np.pi + sign * opening / 2 + turn
        along = np.array([np.cos(direction), np.sin(direction)])
        walls.append([fold + 0.005 * along, fold + rng.uniform(0.15, 0.4) * along])
    corners = np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]]) * rng.uniform(2.5, 5.0, 2)
    spin = rng.uniform(0.0, 6.0)
    corners = corners @ np.array([[np.cos(spin), -np.sin(spin)], [np.sin(spin), np.cos(spin)]])
    walls += [[corners[k], corners[(k + 1) % 4]] for k in range(4)]
    for _ in range(3):
        spot = rng.uniform(-2.5, 2.5, 2)
        if np.linalg.norm(spot) > distance + 0.3:
            walls.append([spot, spot + 0.15 * rng.normal(size=2)])
    poles = np.column_stack([rng.uniform(-3.0, 3.0, (3, 2)), rng.uniform(0.03, 0.25, 3)])
    clear = np.linalg.norm(poles[:, :2], axis=1) > distance + 0.3
    return Room(np.array(walls), poles[clear])


def look(room: Room, angles: FloatArray, rng: np.random.Generator, sigma: float) -> tuple[Scan, IntArray]:
    """A scan, and for each beam which wall (or POLE + k, or MIXED) it hit."""
    beams = np.column_stack([np.cos(angles), np.sin(angles)])
    ranges, owner = np.full(len(angles), np.inf), np.full(len(angles), -1)
    with np.errstate(all="ignore"):
        for k, (a, b) in enumerate(room.walls):
            normal = np.array([a[1] - b[1], b[0] - a[0]])
            r = (a @ normal) / (beams @ normal)
            share = (r[:, None] * beams - a) @ (b - a) / ((b - a) @ (b - a))
            hit = (r > 0) & (share >= 0) & (share <= 1) & (r < ranges)
            ranges[hit], owner[hit] = r[hit], k
        for pole, (x, y, radius) in enumerate(room.poles):
            along = beams @ [x, y]
            r = along - np.sqrt(along**2 - (x * x + y * y - radius**2))
            hit = (r > 0) & (r < ranges)
            ranges[hit], owner[hit] = r[hit], POLE + pole
    for k in np.flatnonzero(np.diff(owner)).tolist():
        if rng.random() < 0.6:
            share = rng.random()
            ranges[k], owner[k] = share * ranges[k] + (1 - share) * ranges[k + 1], MIXED
    ranges = ranges + sigma * rng.standard_normal(len(ranges))
    stray = rng.random(len(ranges)) < 0.002
    ranges[stray] -= rng.uniform(0.0, 0.3, stray.sum())
    ranges[(rng.random(len(ranges)) < 0.01) | ~np.isfinite(ranges)] = np.nan
    return Scan(angles, ranges), owner


def owners_of(line_angles: FloatArray, scan: Scan, owner: IntArray) -> IntArray:
    return owner[np.searchsorted(scan.angle_rad, line_angles - 1e-9)]


@pytest.mark.parametrize("sigma", [0.0003, 0.001, 0.003, 0.01])
def test_both_panels_are_found_whole_and_nothing_foreign_in_them(sigma: float) -> None:
    shares, ratios = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        step = np.deg2rad([1 / 12, 1 / 6, 0.25][seed % 3])
        scan, owner = look(draw_room(rng), np.arange(-np.pi / 2, np.pi / 2, step), rng, sigma)
        lines = find_lines(scan)
        for panel in (0, 1):
            beams = int((owner == panel).sum())
            if beams < 25:
                continue
            owned = [owners_of(line.angle_rad, scan, owner) for line in lines]
            counts = [int((o == panel).sum()) for o in owned]
            best = int(np.argmax(counts))
            assert len(owned[best]) - counts[best] <= 2
            shares.append(counts[best] / beams)
            ratios.append(lines[best].sigma_m[0] / sigma)
    assert min(shares) > 0.6
    assert np.mean(shares) > 0.92
    assert 0.93 < np.mean(ratios) < 1.07


@pytest.mark.parametrize("sweeps", [2, 4])
def test_an_even_number_of_sweeps_is_averaged_too(sweeps: int) -> None:
    rng = np.random.default_rng(5)
    angles = np.deg2rad(np.arange(60.0, 120.0, 0.25))
    true = 2.0 / np.sin(angles)
    scan = Scan(
        np.tile(angles, sweeps),
        np.tile(true, sweeps) + rng.normal(0.0, 0.002, sweeps * len(angles)),
        sweep=np.repeat(np.arange(sweeps), len(angles)),
    )
    merged = merge_sweeps(scan)
    assert len(merged) > 0.97 * len(angles)
    assert np.median(merged.count) == sweeps
    (line,) = find_lines(scan)
    assert np.median(line.sigma_m) == pytest.approx(0.002 / np.sqrt(sweeps), rel=0.2)


def test_sweeps_are_averaged_and_their_sigma_falls_with_their_number() -> None:
    rng = np.random.default_rng(3)
    room, angles = draw_room(rng), np.deg2rad(np.arange(-90, 90, 0.25))
    scans = [look(room, angles, np.random.default_rng([3, k]), 0.003)[0] for k in range(9)]
    together = Scan(
        np.concatenate([s.angle_rad for s in scans]),
        np.concatenate([s.range_m for s in scans]),
        sweep=np.repeat(np.arange(9), len(angles)),
    )
    one, many = find_lines(scans[0]), find_lines(together)
    assert len(many) >= len(one)
    assert np.median([line.sigma_m.mean() for line in many]) == pytest.approx(0.001, rel=0.15)
    assert range_noise(merge_sweeps(together)) == pytest.approx(0.003, rel=0.2)


def test_a_line_across_the_seam_of_a_full_turn_is_one_line() -> None:
    angles = np.deg2rad(np.arange(-180, 180, 0.25))
    rng = np.random.default_rng(0)
    ranges = np.full(len(angles), np.nan)
    behind = np.abs(np.abs(angles) - np.pi) < 0.3
    ranges[behind] = 1.0 / -np.cos(angles[behind])
    lines = find_lines(Scan(angles, ranges + 0.001 * rng.standard_normal(len(angles))))
    assert len(lines) == 1
    assert np.all(np.diff(lines[0].angle_rad) > 0)
    np.testing.assert_allclose(lines[0].points_lidar()[:, 0], -1.0, atol=0.006)


def test_round_things_are_no_lines() -> None:
    for radius in (0.05, 0.15, 0.5, 2.0):
        angles = np.deg2rad(np.arange(-60, 60, 1 / 12))
        along = 3.0 * np.cos(angles)
        with np.errstate(invalid="ignore"):
            ranges = along - np.sqrt(along**2 - 9.0 + radius**2)
        noise = 0.001 * np.random.default_rng(1).standard_normal(len(angles))
        assert find_lines(Scan(angles, ranges + noise)) == ()


def test_exact_and_empty_scans() -> None:
    angles = np.deg2rad(np.arange(-40, 40, 0.25))
    (line,) = find_lines(Scan(angles, 2.0 / np.cos(angles)), LidarSpec(range_sigma_m=0.002))
    np.testing.assert_allclose(line.points_lidar()[:, 0], 2.0, atol=1e-12)
    assert np.all(line.sigma_m == 0.002)
    assert find_lines(Scan(angles, np.full(len(angles), np.nan))) == ()
    assert find_lines(Scan(angles[:0], angles[:0])) == ()
    assert find_lines(Scan(angles[:4], np.ones(4))) == ()


def test_black_squares_that_seem_farther_do_not_break_a_panel() -> None:
    angles = np.deg2rad(np.arange(-30, 30, 1 / 12))
    rng = np.random.default_rng(5)
    fold = np.array([1.2, 0.0])
    ranges = np.full(len(angles), np.nan)
    for direction in (2.2, -2.1):
        along = np.array([np.cos(direction), np.sin(direction)])
        normal = np.array([-along[1], along[0]])
        r = (fold @ normal) / (np.column_stack([np.cos(angles), np.sin(angles)]) @ normal)
        place = (r[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]) - fold) @ along
        on = (place > 0) & (place < 0.3)
        ranges[on] = r[on] + 0.004 * (np.floor(place[on] / 0.02) % 2)
    lines = find_lines(Scan(angles, ranges + 0.001 * rng.standard_normal(len(angles))))
    assert len(lines) == 2
    assert sum(map(len, lines)) > 0.9 * np.isfinite(ranges).sum()
    for line, direction in zip(lines, (-2.1, 2.2), strict=True):
        ends = line.points_lidar()[[0, -1]]
        found = np.arctan2(*(ends[1] - ends[0])[::-1])
        assert abs(np.sin(found - direction)) < 0.02
        assert line.sigma_m[0] > 0.0015  # the squares' steps count as scatter


@pytest.mark.skipif(not (DATA / "sick_cola_b").is_dir(), reason=f"the recordings are not at {DATA}")
def test_two_real_walls_stand_at_right_angles() -> None:
    """SICK LMS511 telegrams: a wall on either side of the corner at 22 degrees."""
    scans = lms511_scans()
    assert len(scans) > 100
    corners = []
    for scan in scans[::5]:
        lines = [line for line in find_lines(scan) if np.ptp(line.points_lidar(), axis=0).max() > 0.5]
        walls = [fit_line2(line.points_lidar()) for line in lines if line.angle_rad[0] < np.deg2rad(30)]
        assert len(walls) == 2
        corners.append(np.rad2deg(np.arccos(abs(walls[0].normal @ walls[1].normal))))
        assert 0.002 < lines[0].sigma_m[0] < 0.008
    assert np.mean(corners) == pytest.approx(90.0, abs=0.5)
    together = Scan(np.concatenate([s.angle_rad for s in scans[:20]]), np.concatenate([s.range_m for s in scans[:20]]))
    long = [line for line in find_lines(together) if np.ptp(line.points_lidar(), axis=0).max() > 0.4]
    assert [len(line) for line in long[:2]] == pytest.approx([130, 145], abs=40)


def lms511_scans() -> list[Scan]:
    """The distances in the telegrams (CoLa B): scale, offset, first angle, step, count, values."""
    entries = json.loads((DATA / "sick_cola_b" / "20210301_lms511.pcapng.json").read_text())
    payloads = [e["_source"]["layers"].get("tcp", {}).get("tcp.payload", "") for e in entries]
    stream = b"".join(bytes.fromhex(p.replace(":", "")) for p in payloads)
    scans = []
    for match in re.finditer(b"DIST1", stream):
        scale, _, first, _, count = struct.unpack(">ffiHH", stream[match.end() : match.end() + 16])
        values = np.frombuffer(stream[match.end() + 16 : match.end() + 16 + 2 * count], ">u2")
        if len(values) == count:
            ranges = np.where(values > 0, values * scale / 1e3, np.nan)
            scans.append(Scan(np.deg2rad(first / 1e4 + np.arange(count) / 6.0), ranges))
    return scans
