"""Is a world calibration good? What the data say against it, by name, and the figures behind the verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.geometry.se3 import Pose, UncertainPose, nearest_rotation, skew
from lidarpose.model.calibration import Quality, Verdict
from lidarpose.model.corner_result import CornerPlaceFaces
from lidarpose.model.corner_session import CloudFrame
from lidarpose.model.observation import LeftOut
from lidarpose.refine.beam_crossing import MAKERS_CROSSING_M, OpenCrossing, SeenCrossing
from lidarpose.refine.corner_model import CornerFit
from lidarpose.refine.face_shape import FaceShape
from lidarpose.refine.slipped_place import TURN_DEG, TURN_STATISTIC
from lidarpose.refine.spot_scatter import SpotScatter, common_error_factor
from lidarpose.refine.wrong_coordinate import WrongCoordinate

# A turn of the target where a place stands by itself: far beyond chance (six degrees of freedom).
OWN_TURN_STATISTIC, OWN_TURN_DEG = 60.0, 0.3
# World coordinates that disagree by more than this with one another are no measurement.
WORLD_SIGMA_DOUBTFUL_MM = 10.0
NOISE_RATIO_DOUBTFUL = 3.0
# Where distances disagree by less, nobody asks why.
LEAST_MISFIT_M = 0.002
# A crossing that the data leave open is named where it is at least so likely, and moves the pose so far beyond chance.
OPEN_CHANCE, OPEN_SIGMAS = 0.05, 3.0
# By how often faces' shape may multiply the pose's standard deviation.
SHAPE_TIMES = 2.0
# The z of the sensor's up: so low is odd where one reflected in the places' plane stands so much straighter.
MOST_TILTED, MORE_UPRIGHT = 0.5, 0.4


@dataclass(frozen=True, eq=False)
class CornerEvidence:
    """What the workflow knows beside the fit.

    `rings_told` are the degrees of freedom that offsets of rings have taken from the residuals; `crossing` is where a
    multi-beam LiDAR's beams seem to cross, None where that was not asked. `further_covariance` (n, n) is of
    what the residuals cannot tell; `scatter` is that of the spots, where it is known. `wrong` is the place whose world
    coordinates alone may be wrong, `possible` a crossing of the beams that the data leave open, `shape` what faces are
    off planes by; all are in that covariance. `turntable_unknown`: clouds have the errors of a turntable whose
    calibration states none. `doubt` is why the target itself may be another, empty if it cannot.
    """

    positions: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    oddity: str
    stated_world_sigma_m: float | None
    stated_range_sigma_m: float | None
    cloud_frame: CloudFrame
    frame_scatter_m: Mapping[str, FloatArray]
    turns: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rings_told: float = 0.0
    further_figures: Mapping[str, Any] = field(default_factory=dict)
    crossing: SeenCrossing | None = None
    further_covariance: FloatArray | None = None
    scatter: Mapping[tuple[int, int], SpotScatter] | None = None
    wrong: WrongCoordinate | None = None
    possible: OpenCrossing | None = None
    turntable_unknown: bool = False
    shape: FaceShape | None = None
    doubt: str = ""


@dataclass(frozen=True)
class PrecisionLimits:
    """Standard deviations (worst direction) that are good enough; ten times as much is rejected."""

    want_mm: float = 5.0
    want_deg: float = 0.1


class _Verdict:
    """Collects reasons; the worst decides."""

    def __init__(self) -> None:
        self.verdict: Verdict = "good"
        self.reasons: list[str] = []

    def reject(self, reason: str) -> None:
        self.verdict = "rejected"
        self.reasons.append(reason)

    def doubt(self, reason: str) -> None:
        if self.verdict == "good":
            self.verdict = "doubtful"
        self.reasons.append(reason)


def judge_corner_fit(
    fit: CornerFit, places: Sequence[CornerPlaceFaces], evidence: CornerEvidence, limits: PrecisionLimits
) -> Quality:
    """Verdict on the joint estimate, with reasons and figures."""
    verdict = _Verdict()
    factor = common_error_factor(fit, places, evidence.rings_told, evidence.scatter)
    moves, statistic, known = fit.discrepancies
    # Each place's corner by its own returns, at the common orientation: what the world coordinates are held against.
    corners = fit.state.scale * (fit.state.corners(fit.world) + np.where(known[:, None], moves[:, :3], 0.0))
    covariance = fit.covariance * factor
    if evidence.further_covariance is not None:
        covariance = covariance + evidence.further_covariance
    figures = _figures(fit.state.T_world_lidar, covariance[:6, :6], evidence)
    figures |= {
        "range_sigma_mm": 1e3 * fit.range_sigma_m,
        "world_sigma_mm": 1e3 * fit.world_sigma_m,
        "covariance_factor": factor,
        "returns": fit.returns,
        "steps": fit.steps,
        "places_used": len(places),
        "faces_angles_deg": _face_angles_deg(fit.state.normals),
        **evidence.further_figures,
    }
    if "log_scale" in fit.names:
        figures["scale_sigma"] = float(np.sqrt(covariance[6, 6])) * fit.state.scale
    _judge_common(verdict, fit.state.T_world_lidar, fit.world, corners, figures, evidence, limits)
    _judge_turns(verdict, places, moves, statistic, known, evidence)
    _judge_world(verdict, fit, places, evidence)
    _judge_noise(verdict, fit, evidence)
    _judge_strangers(verdict, places, evidence)
    if evidence.crossing is not None:
        figures["beam_crossing_left_out_mm"] = {
            "value": 1e3 * evidence.crossing.crossing_m,
            "sigma": 1e3 * evidence.crossing.sigma_m,
        }
        _judge_crossing(verdict, evidence.crossing)
    if evidence.possible is not None:
        _judge_open_crossing(verdict, evidence.possible, factor * fit.pose_covariance)
    if evidence.shape is not None:
        figures["faces_off_planes_mm"] = {f"face {j + 1}": 1e3 * off for j, off in evidence.shape.off_m.items()}
        _judge_shape(verdict, evidence.shape, fit.state.T_world_lidar, covariance[:6, :6])
    if evidence.turntable_unknown:
        verdict.doubt(
            "the turntable's calibration states no covariance, so that its errors are not in the standard deviations: "
            "calibrate the turntable with the joint method, whose file holds one"
        )
    return Quality(verdict.verdict, tuple(verdict.reasons), figures)


def _judge_strangers(verdict: _Verdict, places: Sequence[CornerPlaceFaces], evidence: CornerEvidence) -> None:
    """Places of which a face has no return where the estimate has it: they have no say, and no residuals."""
    strangers = sorted({places[i].position for (i, _), s in (evidence.scatter or {}).items() if s.spots == 0})
    for position in strangers:
        verdict.doubt(
            f"no return from a face at {position} fits the estimate from the other places: its world coordinates are "
            "far off, or the target was turned there"
        )


def _judge_crossing(verdict: _Verdict, seen: SeenCrossing) -> None:
    if not seen.told:
        return
    far, sigma = 1e3 * abs(seen.crossing_m), 1e3 * seen.sigma_m
    if seen.crossing_m > 0.0:
        verdict.doubt(
            f"the LiDAR's beams seem to cross {far:.0f} mm (standard deviation {sigma:.0f}) before its axis, beyond "
            "what the clouds hold: its driver may let all beams start at one point; state the distance of the maker's "
            "manual as beam_crossing_m under [lidar] (VLP-16: 0.0419)"
        )
    else:
        verdict.doubt(
            f"the LiDAR's beams seem to cross {far:.0f} mm (standard deviation {sigma:.0f}) nearer to its axis, or "
            "farther behind it, than the clouds hold: correct beam_crossing_m under [lidar], or leave it out"
        )


def _judge_open_crossing(verdict: _Verdict, possible: OpenCrossing, covariance: FloatArray) -> None:
    move = possible.move[:6]
    far = float(np.sqrt(move @ np.linalg.solve(covariance, move)))
    if possible.chance > OPEN_CHANCE and far > OPEN_SIGMAS:
        verdict.doubt(
            "the beams rise by a VLP-16's odd degrees, all from one point, and the pose depends on it: those of a real "
            f"one cross {1e3 * MAKERS_CROSSING_M:.0f} mm before its axis, which its driver has then left out (the ROS "
            f"driver did until June 2023). State beam_crossing_m = {MAKERS_CROSSING_M:g} under [lidar] in session.toml "
            "for clouds of a real one, 0 for simulated beams that start at one point"
        )


def _judge_shape(verdict: _Verdict, shape: FaceShape, pose: Pose, covariance: FloatArray) -> None:
    """`covariance` (6, 6) of the pose holds what the shape does to it."""
    with_it, without = (_worst(pose, c) for c in (covariance, covariance - shape.covariance[:6, :6]))
    if max(a / b for a, b in zip(with_it, without, strict=True)) > SHAPE_TIMES:
        faces = ", ".join(f"face {j + 1} by {1e3 * off:.1f} mm" for j, off in sorted(shape.off_m.items()))
        verdict.doubt(
            f"parts of the target are off the planes of their faces, alike at all places (standard deviations: {faces}"
            "): it is bent, or something is fixed to it or stands right beside it"
        )


def judge_corners(
    T_world_lidar: Pose,
    world: FloatArray,
    lidar: FloatArray,
    covariance: FloatArray,
    evidence: CornerEvidence,
    limits: PrecisionLimits,
) -> Quality:
    """Verdict on a pose from corners alone (the paper's methods)."""
    verdict = _Verdict()
    figures = _figures(T_world_lidar, covariance, evidence)
    residual = T_world_lidar @ lidar - world
    figures["corner_rms_mm"] = 1e3 * float(np.sqrt((residual**2).sum(axis=1).mean()))
    figures["places_used"] = len(world)
    _judge_common(verdict, T_world_lidar, world, lidar, figures, evidence, limits)
    _judge_single_places(verdict, world, lidar, evidence)
    if figures["corner_rms_mm"] > 30.0:
        verdict.doubt(f"the corners miss their world coordinates by {figures['corner_rms_mm']:.0f} mm RMS")
    return Quality(verdict.verdict, tuple(verdict.reasons), figures)


def _figures(pose: Pose, covariance: FloatArray, evidence: CornerEvidence) -> dict[str, Any]:
    position_m, rotation_rad = _worst(pose, covariance)
    return {
        "sigma_position_mm": 1e3 * position_m,
        "sigma_rotation_deg": float(np.degrees(rotation_rad)),
        "left_out": [{"what": item.what, "reason": item.reason} for item in evidence.left_out],
        "corner_scatter_mm": {k: [round(1e3 * float(x), 4) for x in v] for k, v in evidence.frame_scatter_m.items()},
    }


def _worst(pose: Pose, covariance: FloatArray) -> tuple[float, float]:
    """Standard deviations of the LiDAR's centre and of the rotation, in their worst directions."""
    uncertain = UncertainPose(pose, covariance)
    parts = (uncertain.centre_covariance(), uncertain.rotation_covariance())
    position, rotation = (float(np.sqrt(np.linalg.eigvalsh(part)[-1])) for part in parts)
    return position, rotation


def _face_angles_deg(normals: FloatArray) -> list[float]:
    return [
        float(np.degrees(np.arccos(np.clip(normals[a] @ normals[b], -1.0, 1.0)))) for a, b in ((0, 1), (0, 2), (1, 2))
    ]


def _judge_common(
    verdict: _Verdict,
    pose: Pose,
    world: FloatArray,
    lidar: FloatArray,
    figures: dict[str, Any],
    evidence: CornerEvidence,
    limits: PrecisionLimits,
) -> None:
    if evidence.oddity:
        verdict.reject(evidence.oddity)
    if evidence.doubt:
        verdict.doubt(evidence.doubt)
    for item in evidence.left_out:
        if "," not in item.what and ":" not in item.what:
            verdict.doubt(f"{item.what} is left out: {item.reason}")
    _judge_handedness(verdict, pose, world, lidar, evidence)
    _judge_swaps(verdict, pose, world, lidar, evidence)
    _judge_scale(verdict, pose, world, lidar)
    rotation, position = figures["sigma_rotation_deg"], figures["sigma_position_mm"]
    layout = _layout_remark(world)
    if not (rotation <= 10.0 * limits.want_deg and position <= 10.0 * limits.want_mm):
        verdict.reject(f"the pose is known to {rotation:.2g} deg and {position:.2g} mm only{layout}")
    elif not (rotation <= limits.want_deg and position <= limits.want_mm):
        verdict.doubt(f"the pose is known to {rotation:.2g} deg and {position:.2g} mm{layout}")


def _layout_remark(world: FloatArray) -> str:
    """What about the places makes the pose uncertain, and what to do."""
    spread = np.linalg.svd(world - world.mean(axis=0), compute_uv=False) / np.sqrt(len(world))
    if spread[0] < 0.3:
        return f": the places are too close together ({spread[0]:.2f} m RMS); move the target farther"
    if spread[1] < 0.15 * spread[0]:
        return ": the places are nearly on one line; move the target off it"
    return ""


def _judge_handedness(
    verdict: _Verdict, pose: Pose, world: FloatArray, lidar: FloatArray, evidence: CornerEvidence
) -> None:
    """Left-handed coordinates: they fit mirrored only; or, places in one plane, they turn the LiDAR upside down."""
    cw, cp = world - world.mean(axis=0), lidar - lidar.mean(axis=0)
    proper = _rms(cw - cp @ nearest_rotation(cw.T @ cp).T)
    U, _, Vt = np.linalg.svd(cw.T @ cp)
    if np.linalg.det(U @ Vt) > 0.0:
        U = U * [1.0, 1.0, -1.0]
    mirrored = _rms(cw - cp @ (U @ Vt).T)
    if mirrored < 0.3 * proper and proper > 0.01:
        verdict.reject("the world coordinates are left-handed (mirrored): they fit only if one axis is turned round")
        return
    flat_sigma = np.linalg.svd(cp, compute_uv=False)[2] / np.sqrt(len(cp))
    if flat_sigma > 0.02:
        return
    up = np.array([0.0, 0.0, 1.0]) if evidence.cloud_frame == "lidar" else np.array([0.0, -1.0, 0.0])
    upright = float((pose.rotation @ up)[2])
    # With x and y exchanged, or one of them turned round, the corners fit as well, by a pose reflected in their plane.
    normal = np.linalg.svd(cw)[2][2]
    otherwise = upright - 2.0 * float(normal @ pose.rotation @ up) * float(normal[2])
    if upright < MOST_TILTED and otherwise > upright + MORE_UPRIGHT:
        turns = "turns the sensor upside down" if upright < 0.0 else "lays the sensor on its side"
        verdict.doubt(
            f"all places lie in one plane, and the result {turns}: either it is mounted so (or the "
            "world's z points down), or the world coordinates are left-handed; a place off that plane tells"
        )


def _judge_swaps(verdict: _Verdict, pose: Pose, world: FloatArray, lidar: FloatArray, evidence: CornerEvidence) -> None:
    """Two rows exchanged: a misfit that an exchange removes."""
    residual = _rms(pose @ lidar - world)
    if residual < 0.02 or len(world) > 12 or len(world) < 4:
        return
    cw, cp = world - world.mean(axis=0), lidar - lidar.mean(axis=0)
    for a, b in combinations(range(len(world)), 2):
        swapped = cw.copy()
        swapped[[a, b]] = cw[[b, a]]
        if _rms(swapped - cp @ nearest_rotation(swapped.T @ cp).T) < 0.2 * residual:
            names = f"{evidence.positions[a]} and {evidence.positions[b]}"
            verdict.reject(f"the rows of {names} look swapped: exchanged they fit")
            return


def _judge_scale(verdict: _Verdict, pose: Pose, world: FloatArray, lidar: FloatArray) -> None:
    """A misfit that another scale removes: tape and LiDAR disagree about the metre."""
    cw, cp = world - world.mean(axis=0), lidar - lidar.mean(axis=0)
    turned = cp @ nearest_rotation(cw.T @ cp).T
    scale = float((cw * turned).sum() / (turned * turned).sum())
    if len(world) < 4:
        return
    misfit, rest = _rms(cw - turned), _rms(cw - scale * turned)
    # The F statistic of one more parameter; 100 is beyond chance from four places on.
    if misfit > LEAST_MISFIT_M and misfit**2 - rest**2 > 100.0 * rest**2 / (3 * len(world) - 7):
        verdict.doubt(
            f"distances between the world coordinates are {scale:.4f} times those between the corners: check the "
            "unit, or ask for the scale as well"
        )


def _judge_single_places(verdict: _Verdict, world: FloatArray, lidar: FloatArray, evidence: CornerEvidence) -> None:
    """A single place that disagrees with all others about its own coordinates."""
    if len(world) < 5:
        return
    worst: tuple[float, str] | None = None
    for k, position in enumerate(evidence.positions):
        others = np.arange(len(world)) != k
        mean_w, mean_p = world[others].mean(axis=0), lidar[others].mean(axis=0)
        R = nearest_rotation((world[others] - mean_w).T @ (lidar[others] - mean_p))
        rest = _rms(world[others] - mean_w - (lidar[others] - mean_p) @ R.T)
        miss = float(np.linalg.norm(world[k] - mean_w - R @ (lidar[k] - mean_p)))
        if miss > 8.0 * rest + 0.005 and (worst is None or miss > worst[0]):
            worst = miss, position
    if worst is not None:
        verdict.doubt(f"the world coordinates of {worst[1]} are {1e3 * worst[0]:.0f} mm from where the others put it")


def _judge_turns(
    verdict: _Verdict,
    places: Sequence[CornerPlaceFaces],
    moves: FloatArray,
    statistic: FloatArray,
    known: BoolArray,
    evidence: CornerEvidence,
) -> None:
    """Places whose faces are turned against the others', by the joint estimate or by their own planes."""
    turn_deg = np.degrees(np.linalg.norm(moves[:, 3:], axis=1))
    suspects = {
        p.position: float(turn)
        for p, turn, chance, sure in zip(places, turn_deg, statistic, known, strict=True)
        if sure and chance > TURN_STATISTIC and turn > TURN_DEG
    }
    for position, (tilt_rad, chance) in evidence.turns.items():
        tilt_deg = float(np.degrees(tilt_rad))
        if chance > OWN_TURN_STATISTIC and tilt_deg > OWN_TURN_DEG:
            suspects[position] = max(tilt_deg, suspects.get(position, 0.0))
    if suspects:
        worst = max(suspects, key=lambda p: suspects[p])
        verdict.doubt(
            f"the target seems turned by {suspects[worst]:.1f} deg at {worst} against the other places; it must keep "
            "its orientation"
        )


def _judge_world(
    verdict: _Verdict, fit: CornerFit, places: Sequence[CornerPlaceFaces], evidence: CornerEvidence
) -> None:
    errors_mm = 1e3 * np.linalg.norm(fit.state.world_errors, axis=1)
    if fit.world_sigma_m <= 0.0:
        return
    wrong = evidence.wrong
    if wrong is not None and wrong.told and evidence.stated_world_sigma_m is None:
        also = [f"those of {places[k].position} by {1e3 * off_m:.1f} mm" for k, off_m in wrong.also]
        or_others = f" (or {', or '.join(also)})" if also else ""
        verdict.doubt(
            f"the world coordinates of {places[wrong.place].position} are off by {1e3 * wrong.off_m:.1f} mm{or_others} "
            "if all others are right, which explains what disagrees better than errors of all: measure them again"
        )
    worst = int(np.argmax(errors_mm))
    name = places[worst].position
    if evidence.stated_world_sigma_m:
        if errors_mm[worst] > 5.0e3 * evidence.stated_world_sigma_m:
            verdict.doubt(
                f"the world coordinates of {name} are off by {errors_mm[worst]:.1f} mm, far more than the "
                f"{1e3 * evidence.stated_world_sigma_m:.1f} mm stated"
            )
    elif 1e3 * fit.world_sigma_m > WORLD_SIGMA_DOUBTFUL_MM or verdict.verdict != "good":
        # Good to the precision asked for, nobody asks why it is no better.
        verdict.doubt(
            f"world coordinates and clouds disagree by {1e3 * fit.world_sigma_m:.2g} mm a coordinate, most at {name} "
            f"({errors_mm[worst]:.2g} mm)"
        )


def _judge_noise(verdict: _Verdict, fit: CornerFit, evidence: CornerEvidence) -> None:
    stated = evidence.stated_range_sigma_m
    if stated is not None and fit.range_sigma_m > NOISE_RATIO_DOUBTFUL * stated:
        verdict.doubt(
            f"ranges scatter by {1e3 * fit.range_sigma_m:.1f} mm, far more than the {1e3 * stated:.1f} mm stated: "
            "the faces may not be flat, or may not be the target's"
        )


def _rms(rows: FloatArray) -> float:
    return float(np.sqrt((rows**2).sum(axis=1).mean()))


def cornerwise_covariance(T_world_lidar: Pose, world: FloatArray, lidar: FloatArray, sigma: FloatArray) -> FloatArray:
    """Covariance (6, 6) of a least-squares pose from corners (P, 3) of standard deviations `sigma` (P, 3).

    The corners' own scatter, or what they miss the world by, if larger: a mean's scatter says nothing of bias.
    """
    rows = np.concatenate([np.hstack([np.eye(3), -skew(p)]) for p in T_world_lidar @ lidar])
    inverse = np.linalg.inv(rows.T @ rows)
    dof = max(3 * len(world) - 6, 1)
    misfit = float(((T_world_lidar @ lidar - world) ** 2).sum()) / dof
    noise = np.maximum((sigma**2 @ (T_world_lidar.rotation**2).T).ravel(), misfit)
    return np.asarray(inverse @ (rows.T * noise) @ rows @ inverse)
