"""The world job: from a corner session to the pose in the world, by the paper's methods and by one joint estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from lidarpose.detect.paper_corners import harris_corner, ransac_corner
from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.geometry.robust import box_plot_inliers
from lidarpose.geometry.se3 import Pose
from lidarpose.geometry.threads import each, one_blas_thread
from lidarpose.model.calibration import WorldCalibration
from lidarpose.model.corner_result import CornerCandidate, CornerPlaceFaces, FaceReturns
from lidarpose.model.corner_session import CornerSession
from lidarpose.model.observation import LeftOut
from lidarpose.model.world_run import WorldRun
from lidarpose.refine.beam_crossing import OpenCrossing, SeenCrossing, open_crossing, seen_crossing, without_crossing
from lidarpose.refine.corner_model import (
    SETTLED,
    CornerFit,
    CornerOptions,
    CornerState,
    FreeCorner,
    estimate_world_sigma,
    fit_corner_model,
    frame_corners,
    own_turns,
)
from lidarpose.refine.corner_verdict import (
    CornerEvidence,
    PrecisionLimits,
    cornerwise_covariance,
    judge_corner_fit,
    judge_corners,
)
from lidarpose.refine.face_rims import without_rims
from lidarpose.refine.ring_offsets import (
    RingEquations,
    RingOffsets,
    Rings,
    find_rings,
    ring_equations,
    ring_offsets,
    some_returns,
)
from lidarpose.refine.spot_scatter import common_error_factor, spot_scatter, weighed_by_angle
from lidarpose.refine.wrong_coordinate import unsure_noise, wrong_coordinate
from lidarpose.solve.corner_alignment import cayley_pose, pair_scale, svd_pose
from lidarpose.solve.corner_matching import face_order
from lidarpose.workflows.corner_target import (
    FoundTarget,
    PlaceCrop,
    Tick,
    find_target,
    fit_place,
    gather,
    observe,
    observe_inner,
)
from lidarpose.workflows.recorded_corners import holds_scans, with_scans
from lidarpose.workflows.thin_face import with_thin_face
from lidarpose.workflows.turntable_share import turntable_share
from lidarpose.workflows.world_evidence import corners_run, joint_run

WorldMethod = Literal["joint", "paper", "paper-approx", "ransac", "harris"]
WORLD_METHODS: tuple[WorldMethod, ...] = ("joint", "paper", "paper-approx", "ransac", "harris")

# Frames whose corner is this far out are of another scene: someone walked by, the target was being moved.
JOINT_WHISKER = 3.0
# The same of frames with less than this share of the returns that others have on the faces.
FEWER_RETURNS = 0.6
MIN_FRAMES_FOR_BOX_PLOT = 5
# Returns around the target, of all frames of a place together, from which the first estimate is made.
FIRST_RETURNS = 3000
# What is left to go after that estimate's last step, in standard deviations.
FIRST_SETTLED = 0.01
SMALL_TURN_RAD = np.radians(3.0)
# Offsets of rings, and how much else spots err together, are estimated in turn.
RING_STEPS = 3
# So are a crossing of the beams and the errors of the world's coordinates.
CROSSING_STEPS = 3
# Twice the gain in log likelihood at which uncertain world coordinates are believed in.
CONVINCING_GAIN = 9.0


@dataclass(frozen=True, eq=False)
class LocatedTarget:
    """The target's sightings, and its surroundings cut from all frames."""

    found: FoundTarget
    crops: tuple[PlaceCrop, ...]


def locate_target(session: CornerSession, *, seed: int = 0, tick: Tick = lambda: None) -> LocatedTarget:
    """Find the target at all places and cut it from all frames.

    Raises
    ------
    InputError
        If a cloud cannot be read.
    UndeterminedError
        If no corner, or more than one, moves as the world coordinates say.
    """
    session = with_scans(session)
    with one_blas_thread():
        return _located(session, seed, tick)


def _located(session: CornerSession, seed: int, tick: Tick) -> LocatedTarget:
    found = find_target(session, seed=seed, tick=tick)
    if found.ambiguous:
        raise UndeterminedError(
            "more than one corner of the scene moves as the world coordinates say",
            remedy="Tell which is the target's by near_x_m,near_y_m,near_z_m in the table of positions.",
        )
    return LocatedTarget(found, gather(session, found, tick=tick))


def calibrate_world(
    session: CornerSession,
    method: WorldMethod = "joint",
    *,
    estimate_scale: bool | None = None,
    wishes: Mapping[str, float] | None = None,
    seed: int = 0,
    provenance: Mapping[str, Any] | None = None,
    located: LocatedTarget | None = None,
    tick: Tick = lambda: None,
) -> WorldCalibration:
    """The calibration of `world_run`, for those who need no more."""
    run = world_run(
        session,
        method,
        estimate_scale=estimate_scale,
        wishes=wishes,
        seed=seed,
        provenance=provenance,
        located=located,
        tick=tick,
    )
    return run.calibration


def world_run(
    session: CornerSession,
    method: WorldMethod = "joint",
    *,
    estimate_scale: bool | None = None,
    wishes: Mapping[str, float] | None = None,
    seed: int = 0,
    provenance: Mapping[str, Any] | None = None,
    located: LocatedTarget | None = None,
    tick: Tick = lambda: None,
) -> WorldRun:
    """The pose of the clouds' frame in the world, with what a reader needs to see to judge it.

    Parameters
    ----------
    session
        Places with known world coordinates and the frames recorded at each.
    method
        `joint`, one maximum-likelihood estimate of everything; `paper`, corners of each frame's RANSAC planes, box plot
        and mean over frames, Cayley's form iterated and then singular values; `paper-approx`, the same before that
        optimisation; `ransac`, plain RANSAC planes of single frames; `harris`, 3D Harris corners.
    estimate_scale
        Also estimate the factor of eq. (2); by default what the session says.
    wishes
        `want_mm` and `want_deg`, standard deviations that are good enough.
    provenance
        What to record of the run in the calibration, beside method and counts.
    located
        What `locate_target` found, to spare the search where several methods are tried on one session.
    tick
        Called once for each frame read or searched.

    Raises
    ------
    InputError
        If a cloud cannot be read.
    UndeterminedError
        If the data determine no pose.
    """
    scale_too = session.estimate_scale if estimate_scale is None else estimate_scale
    session = with_scans(replace(session, estimate_scale=scale_too))
    located, origin = _from_their_middle(located or locate_target(session, seed=seed, tick=tick))
    found, crops = located.found, located.crops
    if found.by_edges and method != "joint":
        raise _two_faces()
    limits = PrecisionLimits(**(wishes or {}))
    with one_blas_thread():
        if method == "joint":
            run = _joint_with_all_faces(session, located, scale_too, limits)
        else:
            run = _cornerwise(session, found, crops, method, scale_too, limits, seed)
    run = _from_the_origin(run, origin)
    recorded = {**(provenance or {}), **run.calibration.provenance}
    return replace(run, calibration=replace(run.calibration, provenance=recorded))


def _from_their_middle(located: LocatedTarget) -> tuple[LocatedTarget, FloatArray]:
    """The world's coordinates counted from the middle of the target's corners, and that middle (3,).

    National grids put a room thousands of kilometres from their origin; about that, a turn and a shift are all but one
    thing, and the normal equations of a good session are singular to the last digit.
    """
    found = located.found
    origin = np.asarray(found.world.mean(axis=0))
    match = replace(found.match, T_world_lidar=_shift(-origin) @ found.match.T_world_lidar)
    return replace(located, found=replace(found, world=found.world - origin, match=match)), origin


def _from_the_origin(run: WorldRun, origin: FloatArray) -> WorldRun:
    """The run with the world's coordinates counted from their own origin again."""
    back = _shift(origin)
    calibration = run.calibration
    covariance, whole = calibration.covariance, calibration.parameter_covariance
    if covariance is not None:
        covariance = _about(back, covariance)
    if whole is not None:
        whole = _about(back, whole)
    calibration = replace(
        calibration,
        T_world_source=back @ calibration.T_world_source,
        covariance=covariance,
        parameter_covariance=whole,
    )
    places = tuple(replace(p, corner_world=p.corner_world + origin) for p in run.places)
    return replace(run, calibration=calibration, places=places)


def _shift(by: FloatArray) -> Pose:
    return Pose(np.eye(3), by)


def _about(shift: Pose, covariance: FloatArray) -> FloatArray:
    """The covariance (n, n) of a pose's left perturbation, and of other parameters behind it, in a shifted frame."""
    J = np.eye(len(covariance))
    J[:6, :6] = shift.adjoint()
    moved = J @ covariance @ J.T
    return np.asarray(0.5 * (moved + moved.T))


def _usable_world(session: CornerSession, found: FoundTarget) -> CornerSession:
    """The session with the world coordinates under which its corners fit."""
    places = tuple(replace(p, corner_world=w) for p, w in zip(session.places, found.world, strict=True))
    return replace(session, places=places)


def _joint_with_all_faces(
    session: CornerSession, located: LocatedTarget, scale_too: bool, limits: PrecisionLimits
) -> WorldRun:
    """The joint estimate; again with the thin face from all places together where single places lack it."""
    run, failure = None, None
    try:
        if located.found.by_edges:
            raise _two_faces()
        run = _joint(session, located.found, located.crops, scale_too, limits)
    except UndeterminedError as error:
        failure = error
    if run is not None and (_rank(run) == 0 or _shows_all_faces(run, session)):
        return run
    mended = with_thin_face(located.found, located.crops)
    if mended is not None:
        try:
            second = _joint(session, mended, gather(session, mended), scale_too, limits, own_fits=False)
        except UndeterminedError:
            second = None
        if second is not None and (run is None or _rank(second) < _rank(run)):
            return second
    if run is None:
        assert failure is not None
        raise failure
    return run


def _two_faces() -> UndeterminedError:
    return UndeterminedError(
        "only two faces of the target are seen by more than a line at the places; the third is needed as well",
        remedy="Bring the target nearer, or turn it so that several scan lines cross each face, or use joint.",
    )


def _rank(run: WorldRun) -> int:
    quality = run.calibration.quality
    return 2 if quality is None else ("good", "doubtful", "rejected").index(quality.verdict)


def _shows_all_faces(run: WorldRun, session: CornerSession) -> bool:
    """Whether three faces were seen at all places but a few."""
    return sum(len(place.faces) == 3 for place in run.places) > 0.7 * len(session.places)


def _joint(
    session: CornerSession,
    found: FoundTarget,
    crops: Sequence[PlaceCrop],
    scale_too: bool,
    limits: PrecisionLimits,
    *,
    own_fits: bool = True,
) -> WorldRun:
    mended = _usable_world(session, found)
    # First from a part of the returns, which tells where the faces are to a fraction of what all of them will.
    few = [crop.thinned(FIRST_RETURNS) for crop in crops]
    # A face that single places do not determine leads their own fits astray; and good sightings are as good a start.
    alone = own_fits and not found.by_motion
    fits = _place_fits(session, found, few) if alone else [None] * len(few)
    start, sigma_m = _start(mended, found, fits)
    corners = _corners(start, fits, found, sighted=not alone)
    places = observe_inner(mended, found, few, corners, start.normals, sigma_m)
    fit, first = _fit(mended, places, start, sigma_m, scale_too, FIRST_SETTLED)
    # Then from all, with the faces' beams selected by the estimate itself.
    corners = _expected(fit, places, found.world)
    observed, left_out = observe(mended, found, crops, corners, fit.state.normals, fit.range_sigma_m)
    by_frame = _corners_by_frame(observed, corners, fit)
    places, frame_scatter, dropped = _without_odd_frames(observed, by_frame)
    # Where faces end is told to a fraction of the noise, which the first estimate does not reach.
    common_error = _common_error(fit, first, places)
    fit, _ = _fit(mended, places, fit.state, fit.range_sigma_m, scale_too, FIRST_SETTLED)
    corners = _expected(fit, places, found.world)
    places = without_rims(places, fit.state.normals, corners, fit.range_sigma_m, common_error)
    fit, used = _fit(mended, places, fit.state, fit.range_sigma_m, scale_too)
    fit, used, offsets, crossing, possible = _without_ring_offsets(mended, fit, used)
    scatter = spot_scatter(fit, used)
    if offsets is None and (crossing is None or not crossing.told):
        fit = weighed_by_angle(fit, used, scatter)
    left_out += [
        LeftOut(f"{name}: {n} frames", "their corner, or how much of the faces they show, is far from the others'")
        for name, n in dropped.items()
    ]
    share = turntable_share(session, fit, used)
    wrong = wrong_coordinate(fit)
    further = [part.covariance for part in (share, wrong, possible) if part is not None]
    if session.world_sigma_m is None and fit.world_sigma_m > 0.0:
        further.append(unsure_noise(fit))
    further_covariance = np.asarray(sum(further)) if further else None
    evidence = CornerEvidence(
        tuple(p.position for p in used),
        tuple(left_out),
        found.oddity,
        session.world_sigma_m,
        session.lidar.range_sigma_m,
        session.cloud_frame,
        frame_scatter,
        _turns(session, fits, fit, used),
        0.0 if offsets is None else offsets.told,
        {} if offsets is None else offsets.figures,
        crossing,
        further_covariance,
        scatter,
        wrong,
        possible,
        share is None and holds_scans(session),
    )
    quality = judge_corner_fit(fit, used, evidence, limits)
    covariance = fit.covariance * float(quality.figures["covariance_factor"])
    if further_covariance is not None:
        covariance = covariance + further_covariance
    calibration = WorldCalibration(
        fit.state.T_world_lidar,
        session.cloud_frame,
        fit.state.scale,
        covariance[:6, :6],
        fit.names,
        covariance,
        quality,
        _provenance(session, "joint"),
    )
    return joint_run(session, calibration, fit, used, by_frame)


def _expected(fit: CornerFit, places: Sequence[CornerPlaceFaces], world: FloatArray) -> FloatArray:
    """The corners (P, 3) of all places by an estimate from those that have faces."""
    errors = np.zeros_like(world)
    errors[[i for i, p in enumerate(places) if p.faces]] = fit.state.world_errors
    return replace(fit.state, world_errors=errors).corners(world)


def _corners_by_frame(places: Sequence[CornerPlaceFaces], corners: FloatArray, fit: CornerFit) -> dict[str, FloatArray]:
    """By position: the corner of each frame alone (F, 3), where there are three faces and several frames."""
    tasks = [(p, c) for p, c in zip(places, corners, strict=True) if len(p.faces) == 3 and p.frames > 1]

    def of_frames(task: tuple[CornerPlaceFaces, FloatArray]) -> FloatArray:
        place, corner = task
        return frame_corners(place.faces, fit.state.normals, corner, place.frames, fit.range_sigma_m)

    largest = max((len(f) for p, _ in tasks for f in p.faces.values()), default=0)
    return {p.position: c for (p, _), c in zip(tasks, each(of_frames, tasks, largest), strict=True)}


def _common_error(fit: CornerFit, first: Sequence[CornerPlaceFaces], places: Sequence[CornerPlaceFaces]) -> float:
    """By how much spots' means will scatter more than the noise allows, in squares, by the part that was fitted first:
    what they err together does not fall as their noise does."""
    count, few = (sum(len(f) for p in some for f in p.faces.values()) for some in (places, first))
    return 1.0 + (common_error_factor(fit, first) - 1.0) * count / few


def _turns(
    session: CornerSession, fits: Sequence[FreeCorner | None], fit: CornerFit, used: Sequence[CornerPlaceFaces]
) -> dict[str, tuple[float, float]]:
    """By place: how far its own faces are turned from the common ones, and how surely.

    Small turns by all returns that met the common faces; far-turned faces lose theirs, and the place's own fit, which
    follows a target however far it is turned, tells.
    """
    small = {used[k].position: turn for k, turn in own_turns(fit).items()}
    turns = {}
    for place, own in zip(session.places, fits, strict=True):
        turn = small.get(place.position) if own is None else own.turn_statistic(fit.state.normals)
        if turn is not None:
            turns[place.position] = turn if turn[0] > SMALL_TURN_RAD else small.get(place.position, turn)
    return turns


def _provenance(session: CornerSession, method: str) -> dict[str, Any]:
    frames = sum(len(p.clouds) for p in session.places)
    return {
        "session": session.name,
        "method": method,
        "places": len(session.places),
        "frames": frames,
    }


def _place_fits(session: CornerSession, found: FoundTarget, crops: Sequence[PlaceCrop]) -> list[FreeCorner | None]:
    first_guess = session.lidar.range_sigma_m
    return [
        None if s is None else fit_place(crop, s, first_guess or 2.0 * s.sigma_m)
        for s, crop in zip(found.sightings, crops, strict=True)
    ]


def _start(session: CornerSession, found: FoundTarget, fits: Sequence[FreeCorner | None]) -> tuple[CornerState, float]:
    """The closed form on the corners of the places: fitted ones, or as sighted where too few could be fitted."""
    corners, normals, sigmas, world = [], [], [], []
    enough = sum(f is not None for f in fits) >= 3
    for place, sighting, fit in zip(session.places, found.sightings, fits, strict=True):
        if fit is not None:
            corners.append(fit.corner)
            normals.append(fit.normals)
            sigmas.append(fit.sigma_m)
        elif sighting is not None and not enough:
            corners.append(sighting.corner)
            normals.append(sighting.normals)
            sigmas.append(2.0 * sighting.sigma_m)
        else:
            continue
        world.append(place.corner_world)
    reference = normals[0]
    aligned = np.stack([n[list(face_order(n, reference)[0])] for n in normals])
    common = np.median(aligned, axis=0)
    common /= np.linalg.norm(common, axis=1, keepdims=True)
    errors = np.zeros((len(session.places), 3))
    pose = svd_pose(np.stack(world), np.stack(corners))
    return CornerState(pose, common, 1.0, errors), float(np.median(sigmas))


def _corners(start: CornerState, fits: Sequence[FreeCorner | None], found: FoundTarget, *, sighted: bool) -> FloatArray:
    """Each place's corner (P, 3): by its own fit, or as sighted where sightings stand for fits, or as predicted."""
    corners = start.corners(found.world)
    for k, (fit, sighting) in enumerate(zip(fits, found.sightings, strict=True)):
        if fit is not None:
            corners[k] = fit.corner
        elif sighted and sighting is not None:
            corners[k] = sighting.corner
    return corners


def _without_odd_frames(
    places: Sequence[CornerPlaceFaces], by_frame: Mapping[str, FloatArray]
) -> tuple[list[CornerPlaceFaces], dict[str, FloatArray], dict[str, int]]:
    """Leave out frames whose corner is far from the others', coordinate by coordinate (the paper's box plot), and those
    that have far fewer returns on the faces than the others: there something stood before them, or they elsewhere."""
    kept, scatter, dropped = [], {}, {}
    for place in places:
        corners = by_frame.get(place.position)
        if corners is not None and place.frames >= MIN_FRAMES_FOR_BOX_PLOT:
            known = np.isfinite(corners).all(axis=1)
            good = _full_frames(place)
            known &= good
            if known.sum() >= MIN_FRAMES_FOR_BOX_PLOT:
                # Quartiles of a few frames scatter themselves.
                whisker = JOINT_WHISKER * (1.0 + MIN_FRAMES_FOR_BOX_PLOT / known.sum())
                inside = [box_plot_inliers(corners[known, k], whisker) for k in range(3)]
                good[known] = np.all(inside, axis=0)
                scatter[place.position] = corners[good & known].std(axis=0, ddof=1)
            if not good.all():
                dropped[place.position] = int(np.count_nonzero(~good))
                faces = {j: _frames_only(f, good) for j, f in place.faces.items()}
                place = replace(place, faces=faces)
        kept.append(place)
    return kept, scatter, dropped


def _full_frames(place: CornerPlaceFaces) -> BoolArray:
    """Which frames (F,) of a place have about as many returns on the faces as the others."""
    count = sum(np.bincount(returns.frame, minlength=place.frames) for returns in place.faces.values())
    return np.asarray(count >= FEWER_RETURNS * np.median(count))


def _frames_only(returns: FaceReturns, good: Any) -> FaceReturns:
    return returns.subset(np.flatnonzero(good[returns.frame]))


def _fit(
    session: CornerSession,
    places: Sequence[CornerPlaceFaces],
    start: CornerState,
    sigma_m: float,
    scale_too: bool,
    settled: float = SETTLED,
) -> tuple[CornerFit, list[CornerPlaceFaces]]:
    """The joint estimate over the places that have faces; the world's noise as stated, or as the data show it."""
    rows = [i for i, p in enumerate(places) if p.faces]
    used = [places[i] for i in rows]
    start = replace(start, world_errors=np.zeros((len(used), 3)))
    stated = session.world_sigma_m
    fit = fit_corner_model(used, start, sigma_m, CornerOptions(stated or 0.0, scale_too), settled=settled)
    if stated is None:
        estimated, gain = estimate_world_sigma(fit)
        if gain > CONVINCING_GAIN:
            options = CornerOptions(estimated, scale_too)
            fit = fit_corner_model(used, fit.state, fit.range_sigma_m, options, settled=settled)
    return fit, used


def _without_ring_offsets(
    session: CornerSession, fit: CornerFit, used: list[CornerPlaceFaces]
) -> tuple[CornerFit, list[CornerPlaceFaces], RingOffsets | None, SeenCrossing | None, OpenCrossing | None]:
    """The joint estimate beside offsets of a multi-beam LiDAR's rings, where the data speak for any, and where its
    beams seem to cross, or may cross."""
    few = some_returns(used) if session.cloud_frame == "lidar" else []
    few_rings = find_rings(few)
    if few_rings is None:
        return fit, used, None, None, None
    estimate, clean, offsets = fit, used, None
    equations: RingEquations | None = ring_equations(fit, few, few_rings)
    if ring_offsets(fit, few, few_rings, equations=equations) is not None:
        estimate, clean, offsets = _with_rings(session, fit, used)
        equations = None
    crossing = _crossing(session, estimate, clean, few, few_rings, offsets, equations)
    if crossing is not None and crossing.told:
        estimate = replace(estimate, covariance=estimate.covariance + np.outer(crossing.move, crossing.move))
    stated = session.lidar.beam_crossing_m is not None
    possible = None if crossing is None or stated else open_crossing(crossing, few_rings)
    return estimate, clean, offsets, crossing, possible


def _crossing(
    session: CornerSession,
    fit: CornerFit,
    clean: list[CornerPlaceFaces],
    few: list[CornerPlaceFaces],
    rings: Rings,
    offsets: RingOffsets | None,
    equations: RingEquations | None,
) -> SeenCrossing | None:
    """Where the beams seem to cross, from some returns `few`, with their `equations` at the fit if these are known;
    `clean` are all, without offsets of rings."""
    told, ring_sigma_m = (0.0, 0.0) if offsets is None else (offsets.told, offsets.sigma_m)
    factor = common_error_factor(fit, some_returns(clean), told)
    first = seen_crossing(fit, few, rings, ring_sigma_m, factor, equations)
    if first is None or first.told or session.world_sigma_m is not None or not fit.world_sigma_m > 0.0:
        return first
    # What a crossing does has passed for errors of the world's coordinates: are there any where it is taken out?
    total, last = first.crossing_m, first
    for _ in range(CROSSING_STEPS):
        taken = without_crossing(clean, fit, total)
        fit, _ = _fit(session, taken, fit.state, fit.range_sigma_m, "log_scale" in fit.names)
        factor = common_error_factor(fit, some_returns(taken), told)
        again = seen_crossing(fit, without_crossing(few, fit, total), rings, ring_sigma_m, factor)
        if again is None:
            return first
        total, last = total + again.crossing_m, again
    estimated = 8.0 if "log_scale" in fit.names else 7.0
    return SeenCrossing(total, last.sigma_m, first.by_metre, 3.0 * len(clean) - estimated)


def _with_rings(
    session: CornerSession, fit: CornerFit, used: list[CornerPlaceFaces]
) -> tuple[CornerFit, list[CornerPlaceFaces], RingOffsets | None]:
    rings = find_rings(used)
    offsets = None if rings is None else ring_offsets(fit, used, rings)
    clean, estimate = used, fit
    for _ in range(RING_STEPS):
        if rings is None or offsets is None:
            return fit, used, None
        clean = offsets.corrected(used)
        estimate, _ = _fit(session, clean, estimate.state, estimate.range_sigma_m, "log_scale" in fit.names)
        factor = common_error_factor(estimate, clean, offsets.told)
        offsets = ring_offsets(estimate, clean, rings, offsets.offset_m, factor)
    if offsets is None:
        return fit, used, None
    return replace(estimate, covariance=offsets.covariance), clean, offsets


# ---- the paper's methods: a corner for each frame, a mean for each place, a closed form for the pose ----


@dataclass(frozen=True, eq=False)
class _PlaceMean:
    position: str
    corner: FloatArray
    scatter: FloatArray
    frames: int


def _cornerwise(
    session: CornerSession,
    found: FoundTarget,
    crops: Sequence[PlaceCrop],
    method: WorldMethod,
    scale_too: bool,
    limits: PrecisionLimits,
    seed: int,
) -> WorldRun:
    means: list[_PlaceMean] = []
    world = []
    left_out = []
    for place, sighting, crop, w in zip(session.places, found.sightings, crops, found.world, strict=True):
        mean = None if sighting is None else _mean_corner(place.position, sighting, crop, method, seed)
        if mean is None:
            left_out.append(LeftOut(place.position, "no frame gave a corner"))
            continue
        means.append(mean)
        world.append(w)
    if len(means) < 3:
        raise UndeterminedError(
            f"the method {method} finds the corner at {len(means)} places; at least three are needed",
            remedy="Use the method joint, or bring the target nearer.",
        )
    w, p = np.stack(world), np.stack([m.corner for m in means])
    scale = pair_scale(w, p) if scale_too else 1.0
    pose = _closed_form(method, w, p, scale)
    covariance = cornerwise_covariance(pose, w, scale * p, np.stack([m.scatter / np.sqrt(m.frames) for m in means]))
    evidence = CornerEvidence(
        tuple(m.position for m in means),
        tuple(left_out),
        found.oddity,
        session.world_sigma_m,
        session.lidar.range_sigma_m,
        session.cloud_frame,
        {m.position: m.scatter for m in means},
    )
    quality = judge_corners(pose, w, scale * p, covariance, evidence, limits)
    calibration = WorldCalibration(
        pose, session.cloud_frame, scale, covariance, quality=quality, provenance=_provenance(session, method)
    )
    corners = {m.position: (place, m.corner) for m, place in zip(means, w, strict=True)}
    return corners_run(session, calibration, method, corners)


def _closed_form(method: WorldMethod, world: FloatArray, lidar: FloatArray, scale: float) -> Pose:
    if method == "paper":
        approximate = cayley_pose(world, lidar, iterations=3, scale=scale)
        turned = approximate @ (scale * lidar)
        return svd_pose(world, turned) @ approximate
    return cayley_pose(world, lidar, scale=scale)


def _mean_corner(
    position: str, sighting: CornerCandidate, crop: PlaceCrop, method: WorldMethod, seed: int
) -> _PlaceMean | None:
    """The corner of each frame, those outside the box plot left out, and the mean (section 3.1)."""
    by_frame = []
    for k in range(crop.frames):
        points = crop.points[crop.frame == k]
        if method == "harris":
            corner = harris_corner(points, sighting.corner)
        else:
            corner = ransac_corner(points, sighting, seed=seed + k, screening=method != "ransac")
        if corner is not None:
            by_frame.append(corner)
        if method in ("ransac", "harris") and corner is not None:
            break
    if not by_frame:
        return None
    corners = np.stack(by_frame)
    if len(corners) >= MIN_FRAMES_FOR_BOX_PLOT:
        corners = corners[np.all([box_plot_inliers(corners[:, k]) for k in range(3)], axis=0)]
    scatter = corners.std(axis=0, ddof=1) if len(corners) > 2 else np.full(3, 0.005)
    return _PlaceMean(position, corners.mean(axis=0), scatter, len(corners))
