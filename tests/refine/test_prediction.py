"""The uncertainty that geometry alone predicts, against that of an estimate from simulated observations."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lidarpose.errors import UndeterminedError
from lidarpose.model.rig_family import Family
from lidarpose.refine.prediction import ExpectedNoise, predict_uncertainty
from lidarpose.refine.turntable import refine_turntable
from lidarpose.simulate.observations import simulate_observations
from lidarpose.simulate.rig import draw_rig


@pytest.mark.parametrize("family", ["paper", "far-axis"])
def test_prediction_agrees_with_the_estimate(family: Family) -> None:
    rig = draw_rig(3, family=family, places=12)
    estimate = refine_turntable(simulate_observations(rig, seed=1), rig.motion, rig.T_camera_panel)
    predicted = predict_uncertainty(
        rig.camera, rig.panels, rig.T_camera_panel, rig.motion, rig.turntable_angle_rad, ExpectedNoise()
    )
    figures = estimate.quality.figures
    assert 1e3 * predicted.inside.position_m.max() == pytest.approx(figures["sigma_inside_arc_mm"], rel=0.25)
    assert 1e3 * predicted.around.position_m[0] == pytest.approx(figures["sigma_half_a_turn_away_mm"], rel=0.25)
    assert predicted.directions[0].sigma_mm > 0.0


def test_what_would_stay_open_is_named_beforehand() -> None:
    rig = draw_rig(3, places=5)
    same = replace(rig, turntable_angle_rad=np.full(5, rig.turntable_angle_rad[0]))
    with pytest.raises(UndeterminedError, match="axis"):
        predict_uncertainty(rig.camera, rig.panels, rig.T_camera_panel, rig.motion, same.turntable_angle_rad)


def test_placements_can_be_seen_from_readings_of_their_own() -> None:
    rig = draw_rig(3, places=8)
    (poses,) = rig.T_camera_panel.values()
    both = {"a": poses, "b": poses}
    angles = rig.turntable_angle_rad

    def sigma(**how: Any) -> float:
        found = predict_uncertainty(rig.camera, rig.panels, both, rig.motion, angles, **how)
        return float(found.inside.position_m.max())

    halves = sigma(placements=["a"] * 4 + ["b"] * 4)
    assert sigma() < 0.8 * halves
    with pytest.raises(ValueError, match="argument"):
        sigma(placements=["a"])
