"""Sections 1 and 2 of the turntable paper against rigs whose truth is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lidarpose.errors import UndeterminedError
from lidarpose.model.observation import ScanLine
from lidarpose.solve.paper import solve_paper

FAMILIES: list[dict[str, Any]] = [
    {},
    {"upside_down": True},
    {"axis_flipped": True},
    {"across": True, "arc_deg": 12.0},
    {"first_deg": 130.0, "step_order": -1},
    {"first_deg": -190.0, "upside_down": True, "axis_flipped": True},
    {"radius_m": 0.0},
    {"radius_m": 0.6, "arc_deg": 8.0},
    {"roll_deg": 30.0, "arc_deg": 12.0},
    {"places": 3},
    {"tilt_deg": 15.0, "dihedral_deg": 100.0},
]


@pytest.mark.parametrize("family", FAMILIES, ids=str)
@pytest.mark.parametrize("function", ["readings", "circles"])
def test_exact_observations_come_out_exact(
    rig_maker: Callable[..., Any], family: dict[str, Any], function: Any
) -> None:
    rig = rig_maker(3, **family)
    solution = solve_paper(rig.observe(), function=function)
    assert not solution.left_out
    for reading in (*rig.readings_rad, rig.readings_rad[0] + np.pi):
        metres, radians = solution.motion.pose(reading).distance(rig.motion.pose(reading))
        assert metres < 1e-9
        assert radians < 1e-9
    assert max(solution.deviations.table().values()) < 1e-6


def test_noise_leaves_the_function_right_inside_the_arc_and_far_from_it(rig_maker: Callable[..., Any]) -> None:
    rig = rig_maker(1, places=87)
    solution = solve_paper(rig.observe(5, corner_px=0.1, stripe_px=0.15, range_m=1e-3))
    errors = np.array([solution.motion.pose(a).distance(rig.motion.pose(a)) for a in rig.readings_rad])
    assert errors[:, 0].mean() < 0.46e-3  # what the paper's own closed form reached (method notes)
    assert np.rad2deg(errors[:, 1].mean()) < 0.03
    metres, radians = solution.motion.pose(np.pi).distance(rig.motion.pose(np.pi))
    assert metres < 1e-3
    assert np.rad2deg(radians) < 0.1


def test_single_bad_places_do_not_matter_and_are_named(rig_maker: Callable[..., Any]) -> None:
    rig = rig_maker(2, places=20)
    observations = rig.observe(1, 0.05, 0.1, 1e-3)
    places = list(observations.places)
    for k in (3, 11):  # exchanged scan lines: the mirrored solution
        lines = places[k].scan_lines
        places[k] = replace(places[k], scan_lines={0: lines[1], 1: lines[0]})
    lines = dict(places[7].scan_lines)
    lines[1] = ScanLine(lines[1].angle_rad[:3], lines[1].range_m[:3], lines[1].sigma_m[:3])
    places[7] = replace(places[7], scan_lines=lines)
    solution = solve_paper(replace(observations, places=tuple(places)))
    assert {item.what for item in solution.left_out} == {"position 003", "position 011", "position 007"}
    metres, radians = solution.motion.pose(rig.readings_rad[5]).distance(rig.motion.pose(rig.readings_rad[5]))
    assert metres < 1e-3
    assert radians < 1e-3


def test_what_determines_nothing_is_refused(rig_maker: Callable[..., Any]) -> None:
    two = rig_maker(0, places=2).observe()
    with pytest.raises(UndeterminedError, match="three or more different readings"):
        solve_paper(two)
    observations = rig_maker(0, places=5).observe()
    same = tuple(replace(p, turntable_angle_rad=0.1) for p in observations.places)
    with pytest.raises(UndeterminedError, match="1 can be used"):
        solve_paper(replace(observations, places=same))
    parallel = {"": (observations.corners[""][0], observations.corners[""][0])}
    with pytest.raises(UndeterminedError, match="parallel"):
        solve_paper(replace(observations, corners=parallel))
    dark = tuple(replace(p, stripes={0: p.stripes[0]}) for p in observations.places)
    with pytest.raises(UndeterminedError, match="no usable stripe on panel 2"):
        solve_paper(replace(observations, places=dark))
    darker = tuple(replace(p, stripes={}) for p in observations.places)
    with pytest.raises(UndeterminedError, match="no image shows it"):
        solve_paper(replace(observations, places=darker))
