"""Which scan line lies on which panel: right, or refused, never wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lidarpose.errors import InputError, UndeterminedError
from lidarpose.model.observation import PlaceFeatures, PlaceObservation, ScanLine, TurntableObservations
from lidarpose.model.rig_family import FAMILIES
from lidarpose.simulate.observations import simulate_observations
from lidarpose.simulate.rig import draw_rig
from lidarpose.solve.assignment import Assignment, assign
from lidarpose.solve.assignment_blind import motion_without_stripes
from lidarpose.solve.paper import board_poses, solve_paper


def wall(rng: np.random.Generator) -> ScanLine | None:
    """A straight line somewhere else in the scan."""
    angle = rng.uniform(-1.5, 1.5) + np.deg2rad(np.arange(0.0, rng.uniform(3.0, 40.0), 0.25))
    cosine = np.cos(angle - rng.uniform(-3.0, 3.0))
    seen = cosine > 0.2
    if seen.sum() < 8:
        return None
    ranges = rng.uniform(0.5, 4.0) / cosine[seen] + 1e-3 * rng.normal(size=seen.sum())
    return ScanLine(angle[seen], ranges, np.full(seen.sum(), 1e-3))


def features_of(observations: TurntableObservations, seed: int) -> list[PlaceFeatures]:
    """What detection would hand over: the lines in any order, among others."""
    rng = np.random.default_rng(seed)
    places = []
    for p in observations.places:
        lines = [*p.scan_lines.values(), *(w for w in (wall(rng) for _ in range(3)) if w is not None)]
        shuffled = tuple(lines[k] for k in rng.permutation(len(lines)))
        places.append(PlaceFeatures(p.position, p.turntable_angle_rad, p.stripes, shuffled, p.placement))
    return places


def assigned(observations: TurntableObservations, seed: int = 0, **options: Any) -> Assignment:
    poses = {name: board_poses(observations.camera, c, name) for name, c in observations.corners.items()}
    return assign(observations.camera, poses, features_of(observations, seed), **options)


def wrong_places(places: tuple[PlaceObservation, ...], truth: Mapping[str, PlaceObservation]) -> list[str]:
    return [
        p.position
        for p in places
        if not all(np.array_equal(p.scan_lines[k].angle_rad, truth[p.position].scan_lines[k].angle_rad) for k in (0, 1))
    ]


def test_pieces_of_a_line_are_joined_again() -> None:
    rig = draw_rig(6, places=6)
    observations = simulate_observations(rig, stripe_step_px=6.0, seed=2)
    poses = {name: board_poses(observations.camera, c, name) for name, c in observations.corners.items()}
    features = features_of(observations, 1)
    truth = {p.position: p for p in observations.places}
    cut = []
    for place in features:
        own = truth[place.position].scan_lines[1]
        (k,) = (k for k, line in enumerate(place.lines) if line is own)
        fifth = len(own) // 5
        parts = [ScanLine(own.angle_rad[s], own.range_m[s], own.sigma_m[s]) for s in (slice(fifth), slice(fifth, None))]
        cut.append(replace(place, lines=(*place.lines[:k], *parts, *place.lines[k + 1 :])))
    found = assign(observations.camera, poses, cut)
    assert len(found.places) == 6
    assert wrong_places(found.places, truth) == []


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_of_rigs_is_assigned_rightly(family: Any) -> None:
    rig = draw_rig(5, family=family, places=None if family == "few-places" else 7)
    observations = simulate_observations(rig, stripe_step_px=6.0, seed=1)
    result = assigned(observations)
    assert wrong_places(result.places, {p.position: p for p in observations.places}) == []
    assert len(result.left_out) <= 1


@pytest.mark.parametrize("family", FAMILIES)
def test_exact_observations_of_every_family_come_out_exact(family: Any) -> None:
    rig = draw_rig(5, family=family, places=None if family == "few-places" else 7)
    observations = simulate_observations(
        rig, corner_sigma_px=0.0, stripe_sigma_px=0.0, range_sigma_m=0.0, stripe_step_px=6.0
    )
    motion = solve_paper(observations).motion
    for reading in (*rig.turntable_angle_rad, 3.0):
        metres, radians = motion.pose(reading).distance(rig.motion.pose(reading))
        assert metres < 1e-6
        assert radians < 1e-6


def test_a_board_that_is_its_own_mirror_image_is_refused_and_the_hint_decides(rig_maker: Callable[..., Any]) -> None:
    rig = rig_maker(4, places=9, symmetric=True)
    observations = rig.observe(0, 0.05, 0.1, 1e-3)
    with pytest.raises(UndeterminedError, match="--first-panel"):
        assigned(observations)
    first = observations.places[0].scan_lines
    smaller = 0 if first[0].angle_rad.mean() < first[1].angle_rad.mean() else 1
    truth = {p.position: p for p in observations.places}
    right = assigned(observations, first_panel=smaller)
    assert "--first-panel" in right.decided_by
    assert wrong_places(right.places, truth) == []
    # The other hint gives the mirrored solution: that is what nothing tells apart.
    other = assigned(observations, first_panel=1 - smaller)
    assert len(wrong_places(other.places, truth)) == len(other.places)


def test_a_hint_against_the_evidence_is_refused(rig_maker: Callable[..., Any]) -> None:
    observations = rig_maker(4, places=9).observe(0, 0.05, 0.1, 1e-3)
    first = observations.places[0].scan_lines
    smaller = 0 if first[0].angle_rad.mean() < first[1].angle_rad.mean() else 1
    assert len(assigned(observations, first_panel=smaller).places) == 9
    with pytest.raises(InputError, match="--first-panel"):
        assigned(observations, first_panel=1 - smaller)


def test_places_that_cannot_be_used_are_left_out_with_their_reasons(rig_maker: Callable[..., Any]) -> None:
    observations = rig_maker(6, places=10).observe(0, 0.05, 0.1, 1e-3)
    poses = {name: board_poses(observations.camera, c, name) for name, c in observations.corners.items()}
    places = features_of(observations, 3)
    places[1] = replace(places[1], stripes={0: places[1].stripes[0]})
    places[4] = replace(places[4], lines=places[4].lines[:1])
    places[7] = replace(places[7], turntable_angle_rad=places[7].turntable_angle_rad + 0.1)
    result = assign(observations.camera, poses, places)
    assert [item.what for item in result.left_out] == ["position 001", "position 004", "position 007"]
    assert "stripe on panel 2" in result.left_out[0].reason
    assert "do not fit the motion" in result.left_out[2].reason
    assert wrong_places(result.places, {p.position: p for p in observations.places}) == []
    with pytest.raises(UndeterminedError, match="position 001: no usable stripe on panel 2"):
        assign(observations.camera, poses, places[:3])


def test_a_rival_that_differs_at_one_place_alone_is_no_rival() -> None:
    rig = draw_rig(5, places=12)
    observations = simulate_observations(rig, stripe_step_px=6.0, seed=1)
    poses = {name: board_poses(observations.camera, c, name) for name, c in observations.corners.items()}
    places = []
    for k, p in enumerate(observations.places):
        lines = list(p.scan_lines.values())
        if k == 1:  # detection broke one line in two, and either part could be it
            n = len(lines[0])
            lines += [part_of(lines[0], 0, n * 6 // 10), part_of(lines[0], n * 4 // 10, n)]
            lines[0] = part_of(lines[0], 0, n // 8)
        places.append(PlaceFeatures(p.position, p.turntable_angle_rad, p.stripes, tuple(lines), p.placement))
    result = assign(observations.camera, poses, places)
    assert len(result.places) >= 11
    assert result.motion.pose(0.1).distance(rig.motion.pose(0.1))[0] < 5e-3


def part_of(line: ScanLine, start: int, stop: int) -> ScanLine:
    return ScanLine(line.angle_rad[start:stop], line.range_m[start:stop], line.sigma_m[start:stop])


def test_without_any_stripe_two_placements_of_the_board_decide() -> None:
    rig = draw_rig(7, family="paper", places=8, placements=2)
    observations = simulate_observations(rig, with_stripe=False, seed=1)
    result = assigned(observations, panels=observations.panels)
    assert wrong_places(result.places, {p.position: p for p in observations.places}) == []
    assert len(result.places) == 16
    poses = {name: board_poses(observations.camera, c, name) for name, c in observations.corners.items()}
    again = motion_without_stripes(replace(observations, places=result.places), poses)
    for reading in rig.turntable_angle_rad:
        for motion in (result.motion, again):
            metres, radians = motion.pose(reading).distance(rig.motion.pose(reading))
            assert metres < 0.02
            assert radians < 0.02


def test_without_any_stripe_one_placement_is_refused(rig_maker: Callable[..., Any]) -> None:
    observations = rig_maker(6, places=5).observe(0, 0.05, 0.1, 1e-3)
    dark = tuple(replace(p, stripes={}) for p in observations.places)
    with pytest.raises(UndeterminedError, match="slide along the fold"):
        assigned(replace(observations, places=dark), panels=observations.panels)


def broken(observations: TurntableObservations, seed: int, noise: float) -> list[PlaceFeatures]:
    """A session over a few degrees: lines broken at odd places, as steps from black to white do, and low sigmas."""
    rng = np.random.default_rng(seed)
    places = []
    for p in observations.places:
        lines: list[ScanLine] = []
        for line in p.scan_lines.values():
            cut = int(len(line) * rng.uniform(0.3, 0.7)) if rng.random() < 0.5 else len(line)
            lines += [part_of(line, 0, cut), *([part_of(line, cut, len(line))] if rng.random() < 0.8 else [])]
        stripes = {k: replace(s, sigma_px=s.sigma_px / noise) for k, s in p.stripes.items()}
        lines = [line for line in lines if len(line) >= 6]
        places.append(PlaceFeatures(p.position, p.turntable_angle_rad, stripes, tuple(lines), p.placement))
    return places


def panel_of_the_first_line(places: tuple[PlaceObservation, ...]) -> set[int]:
    """By place, the panel of the line of smaller beam angle."""
    return {int(p.scan_lines[0].angle_rad.mean() > p.scan_lines[1].angle_rad.mean()) for p in places}


def test_three_places_whose_lines_have_lost_most_of_themselves_are_enough() -> None:
    rig = draw_rig(6, places=3)
    observations = simulate_observations(rig, stripe_step_px=6.0, seed=2)
    poses = {name: board_poses(observations.camera, c, name) for name, c in observations.corners.items()}
    places = [
        PlaceFeatures(
            p.position,
            p.turntable_angle_rad,
            p.stripes,
            tuple(part_of(line, 0, int(0.35 * len(line))) for line in p.scan_lines.values()),
            p.placement,
        )
        for p in observations.places
    ]
    truth = panel_of_the_first_line(observations.places)
    found = assign(observations.camera, poses, places, first_panel=min(truth))
    assert len(found.places) == 3
    assert panel_of_the_first_line(found.places) == truth


@pytest.mark.parametrize("noise", [1.0, 2.0, 3.0])
def test_broken_lines_over_a_short_arc_are_assigned_rightly_or_refused_and_the_hint_helps(noise: float) -> None:
    outcomes = []
    for seed in range(30):
        rig = draw_rig(seed, family=("axis-up", "right", "mixed")[seed % 3], places=5, step_deg=1.0)
        observations = simulate_observations(rig, stripe_sigma_px=0.2 * noise, stripe_step_px=6.0, seed=seed)
        places = broken(observations, seed, noise)
        poses = {name: board_poses(observations.camera, c, name) for name, c in observations.corners.items()}
        truth = panel_of_the_first_line(observations.places)
        for hint in (None, *truth):
            try:
                found = assign(observations.camera, poses, places, first_panel=hint)
            except UndeterminedError as error:
                outcomes.append("too few places" if "needs places" in error.what else "open")
            else:
                outcomes.append("right")
                assert panel_of_the_first_line(found.places) == truth
            assert hint is None or outcomes[-1] != "open"
        try:
            other = assign(observations.camera, poses, places, first_panel=1 - min(truth))
        except (InputError, UndeterminedError):
            continue
        # What the user states against evidence that would have decided is taken, and doubted.
        assert other.against is not None or "open" in outcomes[-2:]
    assert outcomes.count("right") > len(outcomes) / 2
