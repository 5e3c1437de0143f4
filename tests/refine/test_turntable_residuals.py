"""The measurement model against numerical derivatives and against the simulator's independent geometry."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from lidarpose.geometry.se3 import Pose
from lidarpose.model.rig_family import Family
from lidarpose.model.turntable import TurntableMotion
from lidarpose.refine.joint_equations import linearise, lines_of, moved
from lidarpose.refine.least_squares import line_moments
from lidarpose.refine.turntable_layout import JointData, lay_out, thinned
from lidarpose.refine.turntable_parameters import EXTRAS, N_GLOBAL
from lidarpose.refine.turntable_state import JointState, motion_map, regular_motion, start_state
from lidarpose.simulate.observations import simulate_observations
from lidarpose.simulate.rig import TurntableRig, draw_rig


def exact(rig: TurntableRig) -> tuple[JointData, JointState]:
    observations = simulate_observations(
        rig, corner_sigma_px=0.0, stripe_sigma_px=0.0, range_sigma_m=0.0, stripe_step_px=25.0
    )
    data = lay_out(observations)
    return data, start_state(data, rig.motion, rig.T_camera_panel)


@pytest.mark.parametrize("family", ["paper", "mixed", "flat-scan-plane", "axis-in-scan-plane"])
def test_residuals_vanish_on_exact_observations(family: Family) -> None:
    data, state = exact(draw_rig(3, family=family, places=4))
    at = linearise(data, state)
    assert np.abs(at.lines["stripes"].residual).max() < 1e-6
    assert np.abs(at.lines["ranges"].residual).max() < 1e-9
    assert max(np.abs(c.residual).max() for c in at.corners) < 1e-9
    assert at.lines["stripes"].valid.all()
    assert at.lines["ranges"].valid.all()


@pytest.mark.parametrize("kind", ["stripes", "ranges"])
def test_line_jacobians_equal_numerical_ones(kind: Literal["stripes", "ranges"]) -> None:
    data, state = exact(draw_rig(5, family="mixed", places=4, placements=2))
    here = linearise(data, state).lines[kind]
    lines = lines_of(data, kind)
    n = N_GLOBAL + 6 * len(data.slots)
    analytic = np.zeros((len(here.residual), n))
    for j in range(lines.count):
        panel = N_GLOBAL + 6 * int(lines.slot[j])
        columns = [*range(N_GLOBAL), *range(panel, panel + 6)]
        rows = np.arange(lines.start[j], lines.start[j + 1])
        analytic[np.ix_(rows, columns)] = here.basis[rows] @ here.to_parameters[j]
    for p in range(n):
        step = np.zeros(n)
        step[p] = 1e-6
        ahead = linearise(data, state.moved(step, data.centres)).lines[kind].residual
        behind = linearise(data, state.moved(-step, data.centres)).lines[kind].residual
        numerical = (ahead - behind) / 2e-6
        np.testing.assert_allclose(analytic[:, p], numerical, atol=2e-6 * max(np.abs(numerical).max(), 1.0))


def test_small_steps_are_taken_to_first_order() -> None:
    """Residuals and moments after them equal those found anew, to the step's square."""
    data, state = exact(draw_rig(5, family="mixed", places=4, placements=2))
    here = linearise(data, state)
    moments = {
        k: line_moments(r.columns, np.ones(len(r.residual)), lines_of(data, k).start) for k, r in here.lines.items()
    }
    step = 1e-5 * np.random.default_rng(0).standard_normal(N_GLOBAL + 6 * len(data.slots))
    there, moved_by = moved(data, here, state.moved(step, data.centres), step, moments, 1e-4)
    anew = linearise(data, there.state)
    for kind in moments:
        change = np.abs(anew.lines[kind].residual - here.lines[kind].residual).max()
        error = np.abs(there.lines[kind].residual - anew.lines[kind].residual).max()
        assert error < 1e-3 * change
        after = there.lines[kind]
        np.testing.assert_array_equal(after.columns[:, -1], after.residual)
        found = line_moments(after.columns, np.ones(len(after.residual)), lines_of(data, kind).start)
        np.testing.assert_allclose(moved_by[kind], found, rtol=1e-9, atol=1e-12 * np.abs(found).max())
    for k, corner in enumerate(anew.corners):
        change = np.abs(corner.residual - here.corners[k].residual).max()
        assert np.abs(there.corners[k].residual - corner.residual).max() < 1e-3 * change


def test_range_jacobian_holds_away_from_zero_extras() -> None:
    data, state = exact(draw_rig(5, places=3))
    step = np.zeros(N_GLOBAL + 12)
    step[10:N_GLOBAL] = [1e-3, 2e-3, 1e-3, 5e-4, 1e-3, 0.0, 0.0, 0.0]
    state = state.moved(step, data.centres)
    here = linearise(data, state).lines["ranges"]
    lines = data.ranges.lines
    for p in range(10, N_GLOBAL):
        change = np.zeros(N_GLOBAL + 12)
        change[p] = 1e-6
        ahead = linearise(data, state.moved(change, data.centres)).lines["ranges"].residual
        behind = linearise(data, state.moved(-change, data.centres)).lines["ranges"].residual
        analytic = np.einsum("nb,nb->n", here.basis, here.to_parameters[lines.line_of_row, :, p])
        np.testing.assert_allclose(analytic, (ahead - behind) / 2e-6, atol=1e-7)


def test_corner_jacobians_equal_numerical_ones() -> None:
    data, state = exact(draw_rig(5, family="mixed", places=3))
    for k, corner in enumerate(linearise(data, state).corners):
        camera = [10 + EXTRAS.index(name) for name in ("focal_scale", "centre_x_px", "centre_y_px")]
        columns = [*range(N_GLOBAL + 6 * k, N_GLOBAL + 6 * k + 6), *camera]
        for i, p in enumerate(columns):
            step = np.zeros(N_GLOBAL + 6 * len(data.slots))
            step[p] = 1e-6
            ahead = linearise(data, state.moved(step, data.centres)).corners[k].residual
            behind = linearise(data, state.moved(-step, data.centres)).corners[k].residual
            np.testing.assert_allclose(corner.jacobian[:, i], (ahead - behind) / 2e-6, atol=1e-5)


def test_stripe_residual_is_the_pixel_distance_across_the_stripe() -> None:
    rig = draw_rig(7, places=3)
    moved = simulate_observations(
        rig, corner_sigma_px=0.0, stripe_sigma_px=0.5, range_sigma_m=0.0, stripe_step_px=25.0, seed=4
    )
    still = simulate_observations(
        rig, corner_sigma_px=0.0, stripe_sigma_px=0.0, range_sigma_m=0.0, stripe_step_px=25.0, seed=4
    )
    data = lay_out(moved)
    residual = linearise(data, start_state(data, rig.motion, rig.T_camera_panel)).lines["stripes"].residual
    shift = [
        ((m.pixels - s.pixels) * m.normals).sum(axis=1)
        for a, b in zip(moved.places, still.places, strict=True)
        for m, s in zip(a.stripes.values(), b.stripes.values(), strict=True)
    ]
    np.testing.assert_allclose(residual, np.concatenate(shift), atol=2e-3)


@pytest.mark.parametrize("radius", [0.05, 1e-4, 0.0])
def test_internal_and_fixed_parameters_describe_the_same_poses(radius: float) -> None:
    rng = np.random.default_rng(2)
    rig = draw_rig(9, places=3)
    tilt = Pose.exp(np.concatenate([np.zeros(3), rng.normal(size=3)]))
    motion = regular_motion(rig.motion.T_camera_turntable, Pose(tilt.rotation, np.array([radius, 0.0, 0.0])))
    data = lay_out(simulate_observations(rig, stripe_step_px=50.0))
    state = start_state(data, motion, rig.T_camera_panel)
    back = state.to_motion(data.reference_rad)
    # Far from 0 the derivative by the encoder's scale is seen as well.
    for reading in (-2.0, 0.3, 1.7):
        assert back.pose(reading).distance(motion.pose(reading))[0] < 1e-8
        assert back.pose(reading).distance(motion.pose(reading))[1] < 1e-7
    to_fixed = motion_map(state, back, data.reference_rad)
    step = np.zeros(N_GLOBAL + 12)
    step[:10] = 1e-9 * rng.normal(size=10)
    step[10] = 1e-9
    moved = state.moved(step, data.centres)
    fixed_step = to_fixed @ step[:10]
    scaled = replace(back, reading_origin_rad=data.reference_rad)
    for reading in (-2.0, 0.3, 1.7):
        R, t, _ = moved.turned(np.array([reading]), data.reference_rad)
        xi = Pose(R[0], t[0]).minus(motion.pose(reading))
        predicted = back.pose_jacobian(reading) @ fixed_step + scaled.pose_by_scale(reading) * step[10]
        np.testing.assert_allclose(predicted, xi, atol=2e-13 + 2e-2 * np.abs(xi).max())


def test_radius_zero_keeps_a_side_to_move_to() -> None:
    motion = regular_motion(Pose.identity(), Pose.identity())
    assert isinstance(motion, TurntableMotion)
    assert 0.0 < motion.radius_m <= 1.1e-5
    # The LiDAR's own x axis gives the direction.
    np.testing.assert_allclose(motion.T_turntable_lidar.rotation[:, 0], [1.0, 0.0, 0.0], atol=1e-12)
    assert np.linalg.matrix_rank(np.vstack([motion.pose_jacobian(a) for a in (-1.0, 0.0, 1.0)]), tol=1e-7) == 10


def test_thinning_keeps_every_line() -> None:
    data, _ = exact(draw_rig(1, places=4))
    thin = thinned(data, 5)
    assert thin.stripes.lines.count == data.stripes.lines.count
    assert np.diff(thin.ranges.lines.start).max() == 5
    assert len(thin.stripes.rays) == thin.stripes.lines.start[-1]
