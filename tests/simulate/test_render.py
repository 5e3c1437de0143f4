"""Rendered images and scans against geometry and statistics computed another way."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lidarpose.model.rig_family import FAMILIES, Family
from lidarpose.simulate.camera_render import Photography, View, pixel_rays
from lidarpose.simulate.lidar import LidarBehaviour, scan_scene
from lidarpose.simulate.rig import TurntableRig, draw_rig, paper_camera
from lidarpose.simulate.session import SimulatedSession, SimulationOptions, simulate_session
from lidarpose.simulate.turntable_scene import draw_scene


@pytest.fixture(scope="module")
def rig() -> TurntableRig:
    return draw_rig(0, places=9, size=(1083, 823))


@pytest.fixture(scope="module")
def clean(rig: TurntableRig) -> SimulatedSession:
    return simulate_session(rig, options=SimulationOptions(noise_free=True))


@pytest.fixture(scope="module")
def noisy(rig: TurntableRig) -> SimulatedSession:
    return simulate_session(rig)


def test_pixel_rays_are_those_of_the_camera() -> None:
    camera = paper_camera()
    rays = pixel_rays(camera)
    rng = np.random.default_rng(0)
    u, v = rng.integers(0, camera.width, 200), rng.integers(0, camera.height, 200)
    np.testing.assert_allclose(camera.project(rays[v, u]), np.column_stack([u, v]), atol=1e-6)


def test_a_pixel_is_the_mean_over_its_area() -> None:
    """Against 40 x 40 exact rays through each of some pixels, cast at the plates one ray at a time."""
    small = draw_rig(0, places=3, size=(406, 308))
    scene = draw_scene(small, "", 0)
    view = View.of(small.camera, scene)
    image = np.zeros(small.camera.width * small.camera.height)
    for layer in view.layers[:2]:
        np.add.at(image, layer.pixel, layer.albedo)
    rng = np.random.default_rng(1)
    offsets = (np.arange(40) + 0.5) / 40 - 0.5
    for pixel in rng.choice(np.concatenate([layer.pixel for layer in view.layers[:2]]), 150):
        centre = np.array([pixel % small.camera.width, pixel // small.camera.width])
        rays = small.camera.rays(centre + np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2))
        hits = scene.cast(np.zeros(3), rays)
        on_board = (hits.surface == 0) | (hits.surface == 1)
        expected = np.where(on_board, scene.albedo(hits), 0.0).mean()
        assert abs(image[pixel] - expected) < 0.015


def test_corners_are_where_the_rig_has_them(clean: SimulatedSession) -> None:
    rig = clean.rig
    image = clean.session.board_images[""][0].load()
    for panel, T_camera_panel in zip(rig.panels, rig.T_camera_panel[""], strict=True):
        truth = rig.camera.project(T_camera_panel @ panel.corners_panel())
        start = (truth + np.random.default_rng(2).uniform(-0.5, 0.5, truth.shape)).astype(np.float32)
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
        found = cv2.cornerSubPix(image, start.reshape(-1, 1, 2), (7, 7), (-1, -1), criteria).reshape(-1, 2)
        off = found - truth
        assert np.sqrt((off**2).mean()) < 0.05
        assert np.abs(off.mean(axis=0)).max() < 0.005


def test_the_stripe_lies_on_the_sheets_line_with_the_sheets_width(clean: SimulatedSession) -> None:
    """On the white margin beside the squares: centroid and spread of the profile along image columns."""
    rig, how = clean.rig, clean.truth["photography"]
    place = 4
    stripe_images = [p.stripe_image.load() for p in clean.session.places if p.stripe_image is not None]
    assert len(stripe_images) == len(clean.session.places)
    light = stripe_images[place].astype(float)
    dim = np.median([stripe_images[k] for k in (0, 8)], axis=0)
    checked = 0
    for k in (0, 1):
        T_camera_panel, plate = rig.T_camera_panel[""][k], rig.plates[k]
        ends = rig.chord(place, k)
        assert ends is not None
        share = np.linspace(0.0, 1.0, 4001)[:, None]
        line_panel = (1 - share) * ends[0] + share * ends[1]
        # Only points 5 mm inside the margin that the sheet leaves through: white on all sides.
        depth = line_panel[:, 1] - plate.y_min
        width = plate.y_max - plate.y_min
        in_margin = (np.minimum(depth, width - depth) > 0.004) & (np.minimum(depth, width - depth) < 0.010)
        pixels = rig.camera.project(T_camera_panel @ line_panel[in_margin])
        for u in np.unique(np.round(pixels[:, 0])):
            near = np.abs(pixels[:, 0] - u) < 0.6
            v = np.interp(u, *np.sort(pixels[near], axis=0).T) if near.sum() > 3 else np.nan
            if not np.isfinite(v):
                continue
            slope = np.polyfit(pixels[near, 0], pixels[near, 1], 1)
            v = float(np.polyval(slope, u))
            rows = np.arange(round(v) - 14, round(v) + 15)
            profile = np.maximum(light[rows, int(u)] - dim[rows, int(u)], 0.0)
            centre = (profile @ rows) / profile.sum()
            assert abs(centre - v) < 0.12
            # Thickness on the panel, seen along the column: from the sheet's gradient at this pixel.
            spread = np.sqrt(profile @ (rows - centre) ** 2 / profile.sum())
            h = 0.5
            d = [sheet_distance(rig, place, k, np.array([u, v + s])) for s in (-h, h)]
            per_px = (d[1] - d[0]) / (2 * h)
            distance = np.linalg.norm(point_on_panel(rig, k, np.array([u, v])) - rig.T_camera_lidar(place).translation)
            sigma = how["sheet_sigma_m"] + how["sheet_divergence_rad"] * distance
            expected = np.sqrt((sigma / per_px) ** 2 + how["blur_px"] ** 2 + 1 / 12)
            assert abs(spread / expected - 1.0) < 0.1
            checked += 1
    assert checked > 15


def point_on_panel(rig: TurntableRig, panel: int, pixel: np.ndarray) -> np.ndarray:
    R, t = rig.T_camera_panel[""][panel].rotation, rig.T_camera_panel[""][panel].translation
    ray = rig.camera.rays(pixel)
    x, y, _ = np.linalg.solve(np.column_stack([R[:, 0], R[:, 1], -ray]), -t)
    return np.asarray(t + x * R[:, 0] + y * R[:, 1])


def sheet_distance(rig: TurntableRig, place: int, panel: int, pixel: np.ndarray) -> float:
    return float((rig.T_camera_lidar(place).inverse() @ point_on_panel(rig, panel, pixel))[2])


def test_noise_grows_with_light_as_photons_do(noisy: SimulatedSession) -> None:
    how = noisy.truth["photography"]
    first, second = (noisy.session.board_images[""][k].load().astype(float) for k in (0, 1))
    level, half_square = 0.5 * (first + second) - how["black_level"], 0.5 * (first - second) ** 2
    levels, variances = [], []
    for low in range(8, 180, 12):
        here = (level >= low) & (level < low + 12)
        if here.sum() > 1500:
            levels.append(level[here].mean())
            variances.append(half_square[here].mean())
    slope, intercept = np.polyfit(levels, variances, 1)
    assert slope == pytest.approx(1.0 / how["electrons_per_level"], rel=0.1)
    # Rounding to whole levels adds a twelfth.
    assert intercept == pytest.approx(how["read_noise_levels"] ** 2 + 1 / 12, abs=0.15)


def test_a_seed_decides_every_pixel_and_beam(rig: TurntableRig) -> None:
    small = draw_rig(4, places=3, size=(406, 308))
    first, again, other = simulate_session(small, 1), simulate_session(small, 1), simulate_session(small, 2)
    for a, b, c in zip(first.session.places, again.session.places, other.session.places, strict=True):
        assert a.stripe_image is not None
        assert b.stripe_image is not None
        assert c.stripe_image is not None
        image = a.stripe_image.load()
        np.testing.assert_array_equal(image, b.stripe_image.load())
        np.testing.assert_array_equal(image, a.stripe_image.load())
        assert not np.array_equal(image, c.stripe_image.load())
        np.testing.assert_array_equal(a.scan.load().range_m, b.scan.load().range_m)
    shots = first.session.board_images[""]
    assert not np.array_equal(shots[0].load(), shots[1].load())


def panel_ranges(rig: TurntableRig, place: int, panel: int) -> np.ndarray:
    """Where each beam meets a panel's plane, by Cramer's rule on plane and beam; NaN off the plate."""
    T = rig.T_panel_lidar(place, panel)
    out = np.full(len(rig.beam_angle_rad), np.nan)
    for i, a in enumerate(rig.beam_angle_rad):
        direction = T.rotation @ [np.cos(a), np.sin(a), 0.0]
        s = -T.translation[2] / direction[2]
        if s > 0 and rig.plates[panel].contains(T.translation + s * direction, inset_m=0.006):
            out[i] = s
    return out


def test_scans_have_the_stated_noise_on_panels_and_defects_elsewhere(noisy: SimulatedSession) -> None:
    residuals = []
    lost = 0
    for place in range(len(noisy.rig)):
        scan = noisy.session.places[place].scan.load()
        assert np.isnan(scan.range_m).any()
        for k in (0, 1):
            off = scan.range_m - panel_ranges(noisy.rig, place, k)
            lost += np.isnan(scan.range_m[np.isfinite(panel_ranges(noisy.rig, place, k))]).sum()
            residuals.append(off[np.isfinite(off)])
    r = np.concatenate(residuals)
    assert abs(r.std() / 0.001 - 1.0) < 4.0 / np.sqrt(2 * len(r))
    assert abs(r.mean()) < 4.0 * 0.001 / np.sqrt(len(r))
    assert 0 < lost < 0.02 * len(r)


def test_noise_free_scans_are_exact(clean: SimulatedSession) -> None:
    for place in (0, 4, 8):
        scan = clean.session.places[place].scan.load()
        for k in (0, 1):
            expected = panel_ranges(clean.rig, place, k)
            on = np.isfinite(expected)
            np.testing.assert_allclose(scan.range_m[on], expected[on], atol=1e-9)


def test_beams_at_edges_are_mixed_and_no_others(rig: TurntableRig) -> None:
    """With the spot as the only defect, ranges differ from a thin beam's only where the surface changes nearby."""
    scene = draw_scene(rig, "", 0)
    spot = LidarBehaviour(dropout_share=0.0, least_echo=0.0, largest_range_m=np.inf)
    mixed = 0
    for place in range(len(rig)):
        rng = np.random.default_rng(0)
        T, angles = rig.T_camera_lidar(place), rig.beam_angle_rad
        thin = scan_scene(scene, T, angles, 0.0, LidarBehaviour.ideal(), rng).range_m
        thick = scan_scene(scene, T, angles, 0.0, spot, rng).range_m
        changed = np.abs(np.nan_to_num(thick, nan=-1.0) - np.nan_to_num(thin, nan=-1.0)) > 1e-9
        x, y = T.rotation[:, 0], T.rotation[:, 1]
        hits = scene.cast(T.translation, np.cos(angles)[:, None] * x + np.sin(angles)[:, None] * y)
        change = np.diff(hits.surface) != 0
        # The spot reaches two sigmas, a few millirad: at most three beams to either side.
        near_change = np.convolve(change, np.ones(6), "full")[2 : 2 + len(angles)] > 0
        assert not np.any(changed & ~near_change)
        mixed += int(changed.sum())
    assert mixed >= 2 * len(rig)


def test_several_sweeps_share_beams_but_not_noise(rig: TurntableRig) -> None:
    session = simulate_session(rig, options=SimulationOptions(lidar=LidarBehaviour(sweeps=3)))
    scan = session.session.places[0].scan.load()
    count = len(rig.beam_angle_rad)
    assert len(scan) == 3 * count
    assert scan.sweep is not None
    np.testing.assert_array_equal(scan.sweep, np.repeat([0, 1, 2], count))
    sweeps = scan.range_m.reshape(3, count)
    seen = np.all(np.isfinite(sweeps), axis=0)
    spread = sweeps[:, seen].std(axis=0, ddof=1)
    assert np.sqrt(np.median(spread**2) / np.log(2.0)) == pytest.approx(0.001, rel=0.15)


@pytest.mark.parametrize("family", FAMILIES)
def test_nothing_hides_the_board(family: Family) -> None:
    rig = draw_rig(0, family=family)
    scene = draw_scene(rig, "", 0)
    for k, panel in enumerate(rig.panels):
        corners = rig.T_camera_panel[""][k] @ panel.corners_panel()
        assert np.all(scene.cast(np.zeros(3), corners).surface == k)
        for place in (0, len(rig) // 2, len(rig) - 1):
            ends = rig.chord(place, k)
            assert ends is not None
            share = np.linspace(0.02, 0.98, 40)[:, None]
            on_line = rig.T_camera_panel[""][k] @ ((1 - share) * ends[0] + share * ends[1])
            origin = rig.T_camera_lidar(place).translation
            assert np.all(scene.cast(origin, on_line - origin).surface == k)


def test_saturation_ambient_light_and_lit_stripes() -> None:
    small = draw_rig(4, places=3, size=(406, 308))
    plain = replace(Photography(), glare_share=0.0)

    def middle(options: SimulationOptions) -> np.ndarray:
        image = simulate_session(small, 1, options).session.places[1].stripe_image
        assert image is not None
        return image.load()

    normal = middle(SimulationOptions(photography=plain))
    assert np.mean(normal == 255) < 1e-3
    assert np.percentile(normal, 99.9) > 100
    saturated = middle(SimulationOptions(photography=replace(plain, stripe_level=900.0)))
    assert np.mean(saturated == 255) > 2e-3
    lit = middle(SimulationOptions(photography=plain, lit_stripes=True))
    assert np.median(lit) > 30 > 15 > np.median(normal)
