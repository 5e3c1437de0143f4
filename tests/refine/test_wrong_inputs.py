"""Sessions with a fault in them: none may pass as good with a wrong answer, and most are named."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.se3 import Pose
from lidarpose.model.observation import PanelCorners, PlaceObservation, ScanLine, TurntableObservations
from lidarpose.model.turntable_result import TurntableEstimate
from lidarpose.refine.joint_options import Start
from lidarpose.refine.turntable import JointOptions, refine_turntable
from lidarpose.simulate.observations import Blunders, simulate_observations
from lidarpose.simulate.rig import draw_rig
from lidarpose.solve.paper import solve_paper

RIG = draw_rig(1, places=25)
SOUND = simulate_observations(RIG, seed=3, stripe_step_px=20.0)
N = len(SOUND.places)


def closed_form(observations: TurntableObservations) -> Start:
    solution = solve_paper(observations)
    return solution.motion, {n: tuple(p.T_camera_panel for p in poses) for n, poses in solution.panel_poses.items()}


def calibrate(observations: TurntableObservations) -> TurntableEstimate:
    motion, poses = closed_form(observations)
    return refine_turntable(observations, motion, poses, JointOptions(restart=closed_form))


def places(change: Callable[[int, PlaceObservation], PlaceObservation]) -> TurntableObservations:
    return replace(SOUND, places=tuple(change(i, p) for i, p in enumerate(SOUND.places)))


def scans_of(source: Callable[[int], int]) -> TurntableObservations:
    return places(lambda i, p: replace(p, scan_lines=SOUND.places[source(i)].scan_lines))


def readings(change: Callable[[int, float], float]) -> TurntableObservations:
    return places(lambda i, p: replace(p, turntable_angle_rad=change(i, p.turntable_angle_rad)))


def lines(change: Callable[[int, ScanLine], ScanLine]) -> TurntableObservations:
    return places(lambda i, p: replace(p, scan_lines={k: change(i, v) for k, v in p.scan_lines.items()}))


def squares(factor: float, panel: int | None = None) -> TurntableObservations:
    def scaled(k: int, corners: PanelCorners) -> PanelCorners:
        return replace(corners, corners_panel=corners.corners_panel * (factor if panel in (None, k) else 1.0))

    corners = {name: tuple(scaled(k, c) for k, c in enumerate(cs)) for name, cs in SOUND.corners.items()}
    return replace(SOUND, corners=corners)


def reverse_beams(line: ScanLine) -> ScanLine:
    assert line.intensity is not None
    return ScanLine(-line.angle_rad[::-1], line.range_m[::-1], line.sigma_m[::-1], line.intensity[::-1])


def moved_board(first: int) -> TurntableObservations:
    move = Pose.exp([0.01, 0.0, 0.005, 0.0, 0.017, 0.0])
    other = replace(RIG, T_camera_panel={n: tuple(move @ p for p in ps) for n, ps in RIG.T_camera_panel.items()})
    later = simulate_observations(other, seed=4, stripe_step_px=20.0)
    return replace(SOUND, places=SOUND.places[:first] + later.places[first:])


def mirrored() -> TurntableObservations:
    last = SOUND.camera.width - 1

    def flip(pixels: np.ndarray) -> np.ndarray:
        return np.column_stack([last - pixels[:, 0], pixels[:, 1]])

    corners = {
        name: tuple(replace(c, pixels=flip(c.pixels), corners_panel=c.corners_panel * [1, -1, 1]) for c in cs)
        for name, cs in SOUND.corners.items()
    }
    turned = places(
        lambda i, p: replace(
            p,
            stripes={k: replace(s, pixels=flip(s.pixels), normals=s.normals * [-1, 1]) for k, s in p.stripes.items()},
        )
    )
    return replace(turned, corners=corners)


def camera(fx: float = 1.0, cx: float = 0.0, distortion: bool = True) -> TurntableObservations:
    K = SOUND.camera.K * np.array([[fx, 1, 1], [1, fx, 1], [1, 1, 1]]) + np.array([[0, 0, cx], [0, 0, 0], [0, 0, 0]])
    D = SOUND.camera.distortion if distortion else np.zeros(0)
    return replace(SOUND, camera=replace(SOUND.camera, K=K, distortion=D))


CASES: dict[str, tuple[Callable[[], TurntableObservations], str]] = {
    "squares 5 % too large": (lambda: squares(1.05), "disagree in scale"),
    "squares 1 % too large": (lambda: squares(1.01), "disagree in scale|geometry"),
    "one panel's squares 10 % too large": (lambda: squares(1.1, 1), "squares of panel"),
    "squares in millimetres": (lambda: squares(1e3), "squares are given in millimetres"),
    "ranges in millimetres": (
        lambda: lines(lambda i, s: replace(s, range_m=s.range_m * 1e3)),
        "in millimetres, not metres",
    ),
    "scan lines on the other panel": (
        lambda: places(lambda i, p: replace(p, scan_lines={1 - k: v for k, v in p.scan_lines.items()})),
        "panels swapped|boards are swapped",
    ),
    "boards swapped": (
        lambda: replace(SOUND, corners={n: cs[::-1] for n, cs in SOUND.corners.items()}),
        "boards are swapped",
    ),
    "board moved": (lambda: moved_board(15), "board or camera moved|slipped"),
    "scans in opposite order": (lambda: scans_of(lambda i: N - 1 - i), "opposite order"),
    "half of the scans reversed": (
        lambda: lines(lambda i, s: s if i < N // 2 else reverse_beams(s)),
        "other way round",
    ),
    "scans one place late": (lambda: scans_of(lambda i: max(i - 1, 0)), "not of the same places|very same scan"),
    "encoder 2 % off": (lambda: readings(lambda i, r: 1.02 * r), "readings seem to be off by a factor"),
    "readings doubled": (lambda: readings(lambda i, r: 2.0 * r), "halved"),
    "degrees taken as radians": (lambda: readings(lambda i, r: float(np.rad2deg(r))), "taken as radians|contradict"),
    "radians taken as degrees": (lambda: readings(lambda i, r: float(np.deg2rad(r))), "radians that were read"),
    "the encoder slipped by a degree": (
        lambda: readings(lambda i, r: r + (np.deg2rad(1.0) if i > N // 2 else 0.0)),
        "slipped|contradict",
    ),
    "a scan copied": (lambda: scans_of(lambda i: 9 if i == 10 else i), "very same scan"),
    "the LiDAR's data froze": (lambda: scans_of(lambda i: 0), "very same scan"),
    "mirrored image": (mirrored, "mirrored|geometry"),
    "focal length 5 % off": (lambda: camera(fx=1.05), "focal length"),
    "principal point 30 px off": (lambda: camera(cx=30.0), "principal point"),
    "distortion forgotten": (lambda: camera(distortion=False), "geometry|focal"),
    "ranges 10 mm long": (
        lambda: simulate_observations(RIG, seed=3, stripe_step_px=20.0, blunders=Blunders(range_offset_m=0.01)),
        "offset|geometry|beam angles",
    ),
    "black squares 1 mm long": (
        lambda: simulate_observations(RIG, seed=3, stripe_step_px=20.0, blunders=Blunders(black_range_bias_m=1e-3)),
        "black squares",
    ),
    "ranges scatter by 5 cm": (
        lambda: simulate_observations(RIG, seed=3, stripe_step_px=20.0, range_sigma_m=0.05),
        "ranges scatter",
    ),
    "corners scatter by 3 px": (
        lambda: simulate_observations(RIG, seed=3, stripe_step_px=20.0, corner_sigma_px=3.0),
        "chessboard corners scatter",
    ),
}


def test_the_sound_session_is_good() -> None:
    estimate = calibrate(SOUND)
    assert estimate.quality.verdict == "good"
    assert estimate.quality.reasons == ()


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CASES))
def test_faults_are_found_and_named(name: str) -> None:
    make, words = CASES[name]
    try:
        estimate = calibrate(make())
    except UndeterminedError as error:
        said = str(error)
    else:
        assert estimate.quality.verdict != "good"
        said = "; ".join(estimate.quality.reasons)
    assert any(word in said for word in words.split("|")), said


@pytest.mark.parametrize("name", ["squares 5 % too large", "encoder 2 % off", "board moved", "black squares 1 mm long"])
def test_common_faults_are_found_and_named(name: str) -> None:
    test_faults_are_found_and_named(name)


def test_all_scans_reversed_are_a_lidar_upside_down() -> None:
    """Beam angles negated throughout are what a LiDAR mounted upside down measures: no data can tell the two apart.

    The answer is right for the beams as they are counted.
    """
    sound, other = calibrate(SOUND), calibrate(lines(lambda i, s: reverse_beams(s)))
    upside_down = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    expected = sound.motion.pose(0.1) @ upside_down
    metres, radians = other.motion.pose(0.1).distance(expected)
    assert metres < 1e-5
    assert radians < 1e-5


def test_a_reversed_turntable_is_one_with_its_axis_turned_round() -> None:
    sound, other = calibrate(SOUND), calibrate(readings(lambda i, r: -r))
    assert other.motion.axis_direction_camera @ sound.motion.axis_direction_camera < -0.999
    assert other.motion.pose(-0.1).distance(sound.motion.pose(0.1))[0] < 1e-5
