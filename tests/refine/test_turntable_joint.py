"""The joint estimate: exact data, noise, outliers, options, and data that determine nothing."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.se3 import Pose
from lidarpose.model.observation import TurntableObservations
from lidarpose.model.rig_family import Family
from lidarpose.model.targets import Panel
from lidarpose.model.turntable import TurntableMotion
from lidarpose.model.turntable_result import TurntableEstimate
from lidarpose.refine.hit_squares import SPOT_M, _darkness
from lidarpose.refine.turntable import JointOptions, refine_turntable
from lidarpose.simulate.board_pattern import is_black
from lidarpose.simulate.observations import Blunders, simulate_observations
from lidarpose.simulate.rig import TurntableRig, draw_rig
from lidarpose.storage.calibration import read_turntable_calibration, write_calibration


def rough_start(rig: TurntableRig, size: float = 2e-3, seed: int = 0) -> TurntableMotion:
    """The truth, moved by about `size` metres and radians in all ten numbers."""
    xi = size * np.random.default_rng(seed).normal(size=10)
    T = Pose.exp(xi[:6]) @ rig.motion.T_camera_turntable
    mounting = Pose.exp(np.concatenate([np.zeros(3), xi[7:]]))
    lidar = Pose(mounting.rotation @ rig.motion.T_turntable_lidar.rotation, rig.motion.T_turntable_lidar.translation)
    shifted = Pose(lidar.rotation, lidar.translation + [abs(xi[6]), 0.0, 0.0])
    return TurntableMotion(T, shifted)


def refine(rig: TurntableRig, observations: TurntableObservations, **options: Any) -> TurntableEstimate:
    return refine_turntable(
        observations,
        rough_start(rig),
        rig.T_camera_panel,
        JointOptions(**options),
    )


def errors(estimate: TurntableEstimate, rig: TurntableRig, reading: float) -> tuple[float, float, float]:
    """Distance in mm, angle in degrees, and the squared standardised error (6 degrees of freedom)."""
    pose = estimate.uncertain_pose(reading)
    true = rig.motion.pose(reading)
    metres, radians = pose.pose.distance(true)
    xi = pose.pose.minus(true)
    return 1e3 * metres, float(np.rad2deg(radians)), float(xi @ np.linalg.solve(pose.covariance, xi))


@pytest.mark.parametrize("family", ["paper", "mixed", "flat-scan-plane", "far-axis"])
def test_exact_data_give_the_exact_answer(family: Family) -> None:
    rig = draw_rig(4, family=family, places=6)
    observations = simulate_observations(
        rig, corner_sigma_px=0.0, stripe_sigma_px=0.0, range_sigma_m=0.0, stripe_step_px=20.0
    )
    estimate = refine(rig, observations)
    for reading in (rig.turntable_angle_rad[0], rig.turntable_angle_rad[0] + np.pi):
        mm, deg, _ = errors(estimate, rig, float(reading))
        assert mm < 1e-5
        assert deg < 1e-6


def test_noise_is_found_without_being_stated() -> None:
    rig = draw_rig(2, places=12)
    observations = simulate_observations(
        rig, corner_sigma_px=0.07, stripe_sigma_px=0.3, range_sigma_m=0.002, stripe_step_px=5.0, seed=1
    )
    wrong = replace(
        observations,
        places=tuple(
            replace(
                p,
                stripes={k: replace(s, sigma_px=np.full(len(s), 0.1)) for k, s in p.stripes.items()},
                scan_lines={k: replace(s, sigma_m=np.full(len(s), 0.02)) for k, s in p.scan_lines.items()},
            )
            for p in observations.places
        ),
    )
    estimate = refine(rig, replace(wrong, lidar=replace(wrong.lidar, range_sigma_m=None)))
    assert estimate.noise["corners"].sigma == pytest.approx(0.07, rel=0.05)
    assert estimate.noise["stripes"].sigma == pytest.approx(0.3, rel=0.05)
    assert estimate.noise["stripes"].factor == pytest.approx(3.0, rel=0.05)
    assert estimate.noise["ranges"].sigma == pytest.approx(0.002, rel=0.05)
    assert estimate.quality.verdict == "good"


@pytest.mark.parametrize("blunders", [None, Blunders(stripe_share=0.1, range_share=0.1)], ids=["clean", "outliers"])
def test_errors_are_those_that_the_covariance_states(blunders: Blunders | None) -> None:
    rig = draw_rig(1, places=10)
    inside, away = [], []
    middle = float(rig.turntable_angle_rad.mean())
    for seed in range(16):
        observations = simulate_observations(rig, stripe_step_px=12.0, seed=seed, blunders=blunders)
        estimate = refine(rig, observations)
        assert estimate.converged
        inside.append(errors(estimate, rig, middle)[2])
        away.append(errors(estimate, rig, middle + np.pi)[2])
    # Mean of 16 chi-squares of 6 degrees of freedom: 6 with a standard deviation of 0.87; three of these.
    assert 3.4 < np.mean(inside) < 8.6
    assert 3.4 < np.mean(away) < 8.6


def test_a_part_that_whole_lines_share_is_found_and_paid_for() -> None:
    rig = draw_rig(1, places=30)
    rng = np.random.default_rng(5)
    middle = float(rig.turntable_angle_rad.mean())
    square = []
    for seed in range(12):
        observations = simulate_observations(rig, stripe_step_px=12.0, seed=seed)
        places = tuple(
            replace(
                p,
                stripes={
                    k: replace(s, pixels=s.pixels + 0.2 * rng.standard_normal() * s.normals)
                    for k, s in p.stripes.items()
                },
            )
            for p in observations.places
        )
        estimate = refine(rig, replace(observations, places=places))
        square.append(errors(estimate, rig, middle)[2])
        # Shift and slope share one variance, and only the shift was disturbed.
        assert 0.1 < estimate.noise["stripes"].place_sigma < 0.22
        assert estimate.noise["stripes"].sigma == pytest.approx(0.15, rel=0.1)
    assert np.mean(square) < 9.0


def test_ranges_that_resemble_their_neighbours_are_not_counted_in_full() -> None:
    rig = draw_rig(1, places=8)
    middle = float(rig.turntable_angle_rad.mean())
    square = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        observations = simulate_observations(rig, range_sigma_m=0.0, stripe_step_px=12.0, seed=seed)
        places = []
        for p in observations.places:
            lines = {}
            for k, line in p.scan_lines.items():
                noise = np.convolve(rng.standard_normal(len(line) + 3), np.full(4, 0.5), "valid")
                lines[k] = replace(line, range_m=line.range_m + 1e-3 * noise, sigma_m=np.full(len(line), 1e-3))
            places.append(replace(p, scan_lines=lines))
        estimate = refine(rig, replace(observations, places=tuple(places)))
        assert estimate.noise["ranges"].rows_as_one == pytest.approx(4.0, rel=0.3)
        assert estimate.noise["ranges"].sigma == pytest.approx(1e-3, rel=0.1)
        square.append(errors(estimate, rig, middle)[2])
    # Mean of 10 chi-squares of 6 degrees of freedom: 6 with a standard deviation of 1.1.
    assert 2.7 < np.mean(square) < 9.3


def test_boards_and_scans_alone_are_enough() -> None:
    rig = draw_rig(3, family="paper", placements=3, places=20)
    observations = simulate_observations(rig, with_stripe=False, seed=2)
    estimate = refine(rig, observations, want_mm=20.0, want_deg=2.0)
    mm, _, square = errors(estimate, rig, float(rig.turntable_angle_rad.mean()))
    assert square < 20.0
    assert mm < 20.0
    assert "stripes" not in estimate.noise
    with_stripes = simulate_observations(rig, seed=2, stripe_step_px=10.0)
    same = refine(rig, with_stripes, use_stripes=False, want_mm=20.0, want_deg=2.0)
    assert "stripes" not in same.noise
    better = refine(rig, with_stripes)
    assert errors(better, rig, float(rig.turntable_angle_rad.mean()))[0] < 1.0
    assert set(better.panel_poses) == {"placement-1", "placement-2", "placement-3"}


def test_scans_of_one_board_placement_alone_leave_a_motion_open() -> None:
    rig = draw_rig(3, places=5)
    observations = simulate_observations(rig, with_stripe=False, seed=2)
    alone = replace(
        observations,
        places=tuple(replace(p, scan_lines={0: p.scan_lines[0]}) for p in observations.places),
    )
    with pytest.raises(UndeterminedError, match="undetermined"):
        refine(rig, alone)


def test_one_reading_leaves_the_axis_open() -> None:
    rig = draw_rig(3, places=5)
    observations = simulate_observations(rig, seed=2, stripe_step_px=20.0)
    same = replace(observations, places=tuple(replace(observations.places[0], position=f"{i}") for i in range(3)))
    with pytest.raises(UndeterminedError, match="axis"):
        refine(rig, same)


def test_without_scan_lines_the_message_says_so() -> None:
    rig = draw_rig(3, places=3)
    observations = simulate_observations(rig, seed=2, stripe_step_px=20.0)
    bare = replace(observations, places=tuple(replace(p, scan_lines={}) for p in observations.places))
    with pytest.raises(UndeterminedError, match="no scan line"):
        refine(rig, bare)


@pytest.mark.parametrize(
    ("name", "value"), [("black_bias_m", 0.001), ("range_offset_m", 0.006)], ids=["black", "offset"]
)
def test_options_remove_what_they_are_for(name: str, value: float) -> None:
    rig = draw_rig(6, family="far-axis", places=40)
    blunders = Blunders(black_range_bias_m=value) if name == "black_bias_m" else Blunders(range_offset_m=value)
    observations = simulate_observations(rig, seed=1, stripe_step_px=6.0, blunders=blunders)
    off = refine(rig, observations)
    named = {e.name: e for e in off.extras}
    assert abs(named[name].value / named[name].sigma) > 5.0
    on = refine(rig, observations, estimate=(name,))
    fitted = {e.name: e for e in on.extras}[name]
    assert fitted.estimated
    assert abs(fitted.value - value) < 4.0 * fitted.sigma
    assert errors(on, rig, float(rig.turntable_angle_rad.mean()))[2] < 20.0
    assert on.parameter_names[10] == name


def test_an_option_that_the_data_cannot_tell_is_refused() -> None:
    rig = draw_rig(6, places=6)
    observations = simulate_observations(rig, seed=1, stripe_step_px=20.0)
    dull = replace(
        observations,
        places=tuple(
            replace(p, scan_lines={k: replace(s, intensity=None) for k, s in p.scan_lines.items()})
            for p in observations.places
        ),
    )
    estimate = refine(rig, dull, estimate=("black_bias_m",))
    extra = {e.name: e for e in estimate.extras}["black_bias_m"]
    assert not extra.estimated
    assert "cannot tell" in extra.note


@pytest.mark.parametrize("known", [True, False])
def test_a_bias_on_black_squares_shows_without_intensities_where_the_squares_are_known(known: bool) -> None:
    rig = draw_rig(2, places=20)
    blunders = Blunders(black_range_bias_m=1e-3)
    seen = simulate_observations(rig, stripe_step_px=20.0, seed=1, blunders=blunders)
    places = tuple(
        replace(p, scan_lines={k: replace(s, intensity=None) for k, s in p.scan_lines.items()}) for p in seen.places
    )
    first_dark = True if known else None
    corners = {k: tuple(replace(c, first_dark=first_dark) for c in both) for k, both in seen.corners.items()}
    estimate = refine(rig, replace(seen, places=places, corners=corners))
    named = any("black squares" in reason for reason in estimate.quality.reasons)
    assert named == known
    if known:
        extra = {e.name: e for e in estimate.extras}["black_bias_m"]
        assert abs(extra.value - 1e-3) < 4.0 * extra.sigma
        assert extra.value > 5e-4
        assert errors(estimate, rig, float(rig.turntable_angle_rad.mean()))[2] < 22.5


def test_squares_that_beams_hit_are_those_that_are_printed() -> None:
    panel = Panel(7, 5, 0.03)
    points = np.random.default_rng(1).uniform([-0.09, -0.09], [0.27, 0.21], (4000, 2))
    darkness = _darkness(points / panel.square_m, panel.columns, panel.rows, True, SPOT_M / panel.square_m)
    edge = np.abs((points / panel.square_m + 0.5) % 1.0 - 0.5).min(axis=1) * panel.square_m
    clear = edge > SPOT_M
    assert np.array_equal(darkness[clear] == 1.0, is_black(panel, points)[clear])
    assert set(np.unique(darkness[clear])) == {0.0, 1.0}
    assert np.all((darkness >= 0.0) & (darkness <= 1.0))


def test_an_encoder_scale_enters_pose_and_covariance() -> None:
    rig = draw_rig(2, places=30)
    observations = simulate_observations(rig, seed=1, stripe_step_px=10.0)
    scaled = replace(
        observations,
        places=tuple(replace(p, turntable_angle_rad=p.turntable_angle_rad / 1.01) for p in observations.places),
    )
    off = refine(rig, scaled)
    assert off.quality.verdict != "good"
    on = refine(rig, scaled, estimate=("encoder_scale",))
    fitted = {e.name: e for e in on.extras}["encoder_scale"]
    assert fitted.sigma < 1e-3
    assert abs(on.motion.reading_scale - 1.01) < 4.0 * fitted.sigma
    true = float(rig.turntable_angle_rad[7])
    pose = on.calibration().uncertain_pose(true / 1.01)
    assert pose is not None
    xi = pose.pose.minus(rig.motion.pose(true))
    assert xi @ np.linalg.solve(pose.covariance, xi) < 20.0


def test_an_encoder_scale_that_is_seen_only_is_paid_for_all_around(tmp_path: Path) -> None:
    ratios = []
    for seed in range(4):
        rig = draw_rig(2 + seed, places=25)
        observations = simulate_observations(rig, seed=seed, stripe_step_px=20.0)
        scaled = replace(
            observations,
            places=tuple(replace(p, turntable_angle_rad=p.turntable_angle_rad / 1.02) for p in observations.places),
        )
        estimate = refine(rig, scaled)
        assert estimate.motion.reading_scale == 1.0
        assert estimate.parameter_names[10] == "encoder_scale"
        write_calibration(tmp_path / "c.json", estimate.calibration())
        known = read_turntable_calibration(tmp_path / "c.json")
        middle = float(rig.turntable_angle_rad.mean())
        for turn in (0.5 * np.pi, np.pi):
            # What the table reads where it stands `turn` from the middle of the arc.
            pose = known.uncertain_pose((middle + turn) / 1.02)
            assert pose is not None
            metres, radians = pose.pose.distance(rig.motion.pose(middle + turn))
            ratios.append(radians / np.sqrt(np.trace(pose.rotation_covariance())))
            ratios.append(metres / np.sqrt(np.trace(pose.centre_covariance())))
    # Nearly all of the error is the effect's, squared once: both ways within a fifth (it was a hundred times).
    assert min(ratios) > 0.8
    assert max(ratios) < 1.25


def test_unknown_options_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown parameter"):
        JointOptions(estimate=("speed",))
    with pytest.raises(ValueError, match="positive"):
        JointOptions(want_mm=0.0)


@pytest.mark.parametrize(
    ("blunders", "words"),
    [
        (Blunders(black_range_bias_m=3e-3), "black squares"),
        (Blunders(black_range_bias_m=1e-3), "black squares"),
        (Blunders(range_offset_m=5e-3), "offset"),
    ],
    ids=["black 3 mm", "black 1 mm", "offset 5 mm"],
)
def test_an_effect_that_is_named_but_not_estimated_is_in_the_covariance(blunders: Blunders, words: str) -> None:
    inside, away = [], []
    for seed in range(6):
        rig = draw_rig(1 + seed % 3, places=20)
        middle = float(rig.turntable_angle_rad.mean())
        estimate = refine(rig, simulate_observations(rig, stripe_step_px=20.0, seed=seed, blunders=blunders))
        assert estimate.quality.verdict == "doubtful"
        assert any(words in reason and "standard deviations contain" in reason for reason in estimate.quality.reasons)
        inside.append(errors(estimate, rig, middle))
        away.append(errors(estimate, rig, middle + np.pi))
    # The bound of the 99.9 % ellipsoid; without the effect's share the squares are hundreds to thousands.
    assert max(e[2] for e in [*inside, *away]) < 22.5
    # Nor is it more than the effect: the standard deviation stays within some times the error.
    sigma = 1e3 * np.sqrt(np.trace(estimate.uncertain_pose(middle).centre_covariance()))
    assert sigma < 5.0 * np.sqrt(np.mean([e[0] ** 2 for e in inside]))


@pytest.mark.parametrize("scale", [1.0, 1.01])
def test_a_scale_that_the_data_cannot_tell_is_said(scale: float) -> None:
    rig = draw_rig(2, places=4, step_deg=3.0)
    observations = simulate_observations(rig, stripe_step_px=20.0, seed=3)
    places = [
        replace(p, scan_lines={k: replace(s, range_m=scale * s.range_m) for k, s in p.scan_lines.items()})
        for p in observations.places
    ]
    estimate = refine(rig, replace(observations, places=tuple(places)))
    extra = {e.name: e for e in estimate.extras}["range_scale"]
    assert not extra.observable or abs(extra.value) < 3.5 * extra.sigma
    assert any("do not show whether the ranges are true" in reason for reason in estimate.quality.reasons)


def test_a_sound_session_pays_for_no_effect() -> None:
    rig = draw_rig(2, places=20)
    estimate = refine(rig, simulate_observations(rig, stripe_step_px=20.0, seed=3))
    assert estimate.quality.reasons == ()
    assert errors(estimate, rig, float(rig.turntable_angle_rad.mean()))[0] < 0.6


def test_the_noise_of_many_stripe_pixels_is_no_evidence_for_another_focal_length() -> None:
    rig = draw_rig(3, family="far-axis", places=12)
    found = []
    for seed in range(1, 5):
        estimate = refine_turntable(simulate_observations(rig, seed=seed), rig.motion, rig.T_camera_panel)
        found += [e.value / e.sigma for e in estimate.extras if e.name == "focal_scale"]
    # Four of unit variance: the mean's standard deviation is a half.
    assert abs(np.mean(found)) < 1.6
