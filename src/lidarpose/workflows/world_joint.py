"""The joint world estimate: from what was cut out around the target at all places to the pose, and its verdict.

First from a part of the returns, which tells where the faces are to a fraction of what all of them will; then from all,
with the faces' beams selected by that estimate; then without frames and rims that are of something else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.geometry.robust import box_plot_inliers, mad_sigma, median, medians
from lidarpose.geometry.threads import each
from lidarpose.model.calibration import Quality, WorldCalibration
from lidarpose.model.corner_result import CornerPlaceFaces, FaceReturns
from lidarpose.model.corner_session import CornerSession
from lidarpose.model.observation import LeftOut
from lidarpose.model.world_run import WorldRun
from lidarpose.refine.corner_model import CornerFit, CornerState, own_turns, stepped, undetected_world_noise
from lidarpose.refine.corner_verdict import CornerEvidence, PrecisionLimits, judge_corner_fit
from lidarpose.refine.face_rims import without_rims
from lidarpose.refine.face_shape import face_shape
from lidarpose.refine.face_systems import MIN_RETURNS, MIN_SIGMA_M
from lidarpose.refine.frame_corners import PlaceFrames
from lidarpose.refine.free_corner import FreeCorner
from lidarpose.refine.slipped_place import free_fit, loses_returns, slipped_place
from lidarpose.refine.spot_scatter import common_error_factor, spot_scatter, weighed_by_angle
from lidarpose.refine.wrong_coordinate import unsure_noise, wrong_coordinate
from lidarpose.solve.corner_alignment import svd_pose
from lidarpose.solve.corner_matching import Stray, face_order
from lidarpose.workflows.corner_target import FoundTarget, PlaceCrop, fit_place, observe, observe_inner, stray_in_words
from lidarpose.workflows.recorded_corners import holds_scans
from lidarpose.workflows.turntable_share import turntable_share
from lidarpose.workflows.world_estimate import BesideRings, fit_places, without_rings
from lidarpose.workflows.world_evidence import joint_run, provenance

# Frames whose corner is this far out are of another scene: someone walked by, the target was being moved.
JOINT_WHISKER = 3.0
# The same of frames with less than this share of the returns that others have on the faces.
FEWER_RETURNS = 0.6
MIN_FRAMES_FOR_BOX_PLOT = 5
# Returns around the target, of all frames of a place together, from which the first estimate is made.
FIRST_RETURNS = 3000
# What is left to go after that estimate's last step, in standard deviations.
FIRST_SETTLED = 0.01
# One step from it leaves next to nothing of so many standard deviations of all returns together.
FAR_SIGMAS = 60.0
# Errors of the world's coordinates that large beside the stated standard deviation are a reason to ask why.
UNLIKELY_SIGMAS = 4.0
SMALL_TURN_RAD = np.radians(3.0)


@dataclass(frozen=True, eq=False)
class _First:
    """The estimate from a part of the returns: with these, and with what each place said by itself, if it was asked."""

    fit: CornerFit
    places: list[CornerPlaceFaces]
    used: list[CornerPlaceFaces]
    alone: list[FreeCorner | None]


@dataclass(frozen=True, eq=False)
class _Selected:
    """All returns of the faces, frames of something else left out; why, and each frame's corner and their scatter.

    `frames` are the places' faces frame by frame, `good` which frames were kept.
    """

    places: list[CornerPlaceFaces]
    left_out: list[LeftOut]
    frames: list[PlaceFrames]
    good: list[BoolArray]
    by_frame: dict[str, FloatArray]
    scatter: dict[str, FloatArray]


def joint_estimate(
    session: CornerSession,
    found: FoundTarget,
    crops: Sequence[PlaceCrop],
    scale_too: bool,
    limits: PrecisionLimits,
    *,
    own_fits: bool = True,
) -> WorldRun:
    """The pose by all returns of all places together.

    Parameters
    ----------
    found, crops
        The target and what is around it.
    scale_too
        Whether the scale is estimated.
    own_fits
        Whether each place's own planes are a start: not where single places lack a face.

    Raises
    ------
    UndeterminedError
        If the data determine no pose.
    """
    mended = _usable_world(session, found)
    first = _first_estimate(mended, found, crops, scale_too, own_fits)
    selected = _selected(mended, found, crops, first)
    fit, used = _whole_estimate(mended, found, first, selected, scale_too)
    others = _without_slipped_place(mended, found, fit, used)
    if others is not None:
        # The other places alone may lie on one line.
        with suppress(UndeterminedError):
            return joint_estimate(session, others, crops, scale_too, limits, own_fits=own_fits)
    beside = without_rings(mended, fit, used)
    return _judged(session, found, first, selected, beside, limits)


def _first_estimate(
    mended: CornerSession, found: FoundTarget, crops: Sequence[PlaceCrop], scale_too: bool, own_fits: bool
) -> _First:
    few = [crop.thinned(FIRST_RETURNS) for crop in crops]
    # A face that single places do not determine leads their own fits astray; and good sightings are as good a start.
    alone = own_fits and not found.by_motion
    fits: list[FreeCorner | None] = _place_fits(mended, found, few) if alone else [None] * len(few)
    start, sigma_m = _start(mended, found, fits)
    corners = _corners(start, fits, found, sighted=not alone)
    places = observe_inner(mended, found, few, corners, start.normals, sigma_m)
    fit, used = fit_places(mended, places, start, sigma_m, scale_too, FIRST_SETTLED)
    return _First(fit, places, used, fits)


def _selected(mended: CornerSession, found: FoundTarget, crops: Sequence[PlaceCrop], first: _First) -> _Selected:
    """All returns of the faces by the first estimate, frame by frame."""
    fit = first.fit
    corners = _expected(fit, first.places, found.world)
    observed, left_out = observe(mended, found, crops, corners, fit.state.normals, fit.range_sigma_m)

    def frame_by_frame(task: tuple[CornerPlaceFaces, FloatArray]) -> PlaceFrames:
        place, corner = task
        return PlaceFrames.of(place.faces, fit.state.normals, corner, place.frames, fit.range_sigma_m)

    largest = max((len(f) for p in observed for f in p.faces.values()), default=0)
    frames = each(frame_by_frame, list(zip(observed, corners, strict=True)), largest)
    by_frame = {p.position: f.corners() for p, f in zip(observed, frames, strict=True) if len(f.faces) == 3}
    by_frame = {position: c for position, c in by_frame.items() if len(c) > 1}
    places, good, scatter = _without_odd_frames(observed, frames, by_frame)
    left_out += [
        LeftOut(
            f"{place.position}: {np.count_nonzero(~kept)} frames",
            "their corner, or how much of the faces they show, is far from the others'",
        )
        for place, kept in zip(places, good, strict=True)
        if not kept.all()
    ]
    return _Selected(places, left_out, frames, good, by_frame, scatter)


def _whole_estimate(
    mended: CornerSession, found: FoundTarget, first: _First, selected: _Selected, scale_too: bool
) -> tuple[CornerFit, list[CornerPlaceFaces]]:
    """The estimate from all returns but those at the faces' rims."""
    common_error = _common_error(first, selected.places)
    # Where faces end is told to a fraction of the noise, which the first estimate does not reach.
    fit, seen_at = _one_step(first, selected), first.places
    if fit is None:
        fit, _ = fit_places(mended, selected.places, first.fit.state, first.fit.range_sigma_m, scale_too, FIRST_SETTLED)
        seen_at = selected.places
    corners = _expected(fit, seen_at, found.world)
    places = without_rims(selected.places, fit.state.normals, corners, fit.range_sigma_m, common_error)
    return fit_places(mended, places, fit.state, fit.range_sigma_m, scale_too, near=True)


def _one_step(first: _First, selected: _Selected) -> CornerFit | None:
    """The first estimate's state and noise by all returns; None where it was too far from what these say."""
    rows = [i for i, place in enumerate(first.places) if place.faces]
    systems, residuals = {}, []
    for k, i in enumerate(rows):
        for j, system in selected.frames[i].systems(selected.good[i]).items():
            if len(selected.places[i].faces[j]) >= MIN_RETURNS:
                systems[k, j] = system
                residuals.append(selected.frames[i].faces[j].sums.residual)
    if not systems:
        return None
    state, length = stepped(first.fit, systems)
    if not length < FAR_SIGMAS:
        return None
    sigma_m = mad_sigma(np.concatenate(residuals), centred=True, near=first.fit.range_sigma_m)
    return replace(first.fit, state=state, range_sigma_m=max(sigma_m, MIN_SIGMA_M))


def _without_slipped_place(
    mended: CornerSession, found: FoundTarget, fit: CornerFit, used: Sequence[CornerPlaceFaces]
) -> FoundTarget | None:
    """The target without a place whose world coordinates alone are plainly wrong; None where none is."""
    stated = mended.world_sigma_m or 0.0
    agree = float(np.linalg.norm(fit.state.world_errors, axis=1).max()) <= UNLIKELY_SIGMAS * stated
    if agree and not loses_returns(fit, used):
        return None
    free = free_fit(used, fit, FIRST_SETTLED)
    slip = None if free is None else slipped_place(free, stated)
    if slip is None:
        return None
    place = [p.position for p in mended.places].index(used[slip.place].position)
    stray = Stray(found.world[place] + slip.off, slip.off, 0.0, 0.0)
    sightings = tuple(None if k == place else s for k, s in enumerate(found.sightings))
    words = {**found.strays, place: stray_in_words(mended, found.world, place, stray)}
    return replace(found, sightings=sightings, strays=words)


def _judged(
    session: CornerSession,
    found: FoundTarget,
    first: _First,
    selected: _Selected,
    beside: BesideRings,
    limits: PrecisionLimits,
) -> WorldRun:
    """The calibration with its verdict."""
    fit, used = beside.fit, beside.places
    scatter = spot_scatter(fit, used)
    if beside.offsets is None and (beside.crossing is None or not beside.crossing.told):
        fit = weighed_by_angle(fit, used, scatter)
    share = turntable_share(session, fit, used)
    wrong = wrong_coordinate(fit)
    shape = face_shape(fit, used)
    further = [part.covariance for part in (share, wrong, beside.possible, shape) if part is not None]
    if session.world_sigma_m is None:
        further.append(unsure_noise(fit) if fit.world_sigma_m > 0.0 else undetected_world_noise(fit))
    further_covariance = np.asarray(sum(further)) if further else None
    evidence = CornerEvidence(
        tuple(p.position for p in used),
        tuple(selected.left_out),
        found.oddity,
        session.world_sigma_m,
        session.lidar.range_sigma_m,
        session.cloud_frame,
        selected.scatter,
        _turns(session, first.alone, fit, used),
        0.0 if beside.offsets is None else beside.offsets.told,
        {} if beside.offsets is None else beside.offsets.figures,
        beside.crossing,
        further_covariance,
        scatter,
        wrong,
        beside.possible,
        share is None and holds_scans(session),
        shape,
        doubt=found.doubt,
    )
    quality = judge_corner_fit(fit, used, evidence, limits)
    covariance = fit.covariance * float(quality.figures["covariance_factor"])
    if further_covariance is not None:
        covariance = covariance + further_covariance
    return joint_run(session, _calibration(session, fit, covariance, quality), fit, used, selected.by_frame)


def _calibration(session: CornerSession, fit: CornerFit, covariance: FloatArray, quality: Quality) -> WorldCalibration:
    return WorldCalibration(
        fit.state.T_world_lidar,
        session.cloud_frame,
        fit.state.scale,
        covariance[:6, :6],
        fit.names,
        covariance,
        quality,
        provenance(session, "joint"),
    )


def _usable_world(session: CornerSession, found: FoundTarget) -> CornerSession:
    """The session with the world coordinates under which its corners fit."""
    places = tuple(replace(p, corner_world=w) for p, w in zip(session.places, found.world, strict=True))
    return replace(session, places=places)


def _expected(fit: CornerFit, places: Sequence[CornerPlaceFaces], world: FloatArray) -> FloatArray:
    """The corners (P, 3) of all places by an estimate from those that have faces."""
    errors = np.zeros_like(world)
    errors[[i for i, p in enumerate(places) if p.faces]] = fit.state.world_errors
    return replace(fit.state, world_errors=errors).corners(world)


def _common_error(first: _First, places: Sequence[CornerPlaceFaces]) -> float:
    """By how much spots' means will scatter more than the noise allows, in squares, by the part that was fitted first:
    what they err together does not fall as their noise does."""
    count, few = (sum(len(f) for p in some for f in p.faces.values()) for some in (places, first.used))
    return 1.0 + (common_error_factor(first.fit, first.used) - 1.0) * count / few


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
    common = medians(aligned, axis=0)
    common /= np.linalg.norm(common, axis=1, keepdims=True)
    errors = np.zeros((len(session.places), 3))
    pose = svd_pose(np.stack(world), np.stack(corners))
    return CornerState(pose, common, 1.0, errors), median(np.array(sigmas))


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
    places: Sequence[CornerPlaceFaces], frames: Sequence[PlaceFrames], by_frame: Mapping[str, FloatArray]
) -> tuple[list[CornerPlaceFaces], list[BoolArray], dict[str, FloatArray]]:
    """Leave out frames whose corner is far from the others', coordinate by coordinate (the paper's box plot), and those
    that have far fewer returns on the faces than the others: there something stood before them, or they elsewhere.

    Returns
    -------
    The places, which frames (F,) each has kept, and the scatter (3,) of the corners of these.
    """
    left, kept, scatter = [], [], {}
    for place, parts in zip(places, frames, strict=True):
        corners = by_frame.get(place.position)
        good = np.ones(place.frames, dtype=bool)
        if corners is not None and place.frames >= MIN_FRAMES_FOR_BOX_PLOT:
            good = parts.returns >= FEWER_RETURNS * median(parts.returns.astype(np.float64))
            known = np.isfinite(corners).all(axis=1) & good
            if known.sum() >= MIN_FRAMES_FOR_BOX_PLOT:
                # Quartiles of a few frames scatter themselves.
                whisker = JOINT_WHISKER * (1.0 + MIN_FRAMES_FOR_BOX_PLOT / known.sum())
                inside = [box_plot_inliers(corners[known, k], whisker) for k in range(3)]
                good[known] = np.all(inside, axis=0)
                scatter[place.position] = corners[good & known].std(axis=0, ddof=1)
            if not good.all():
                place = replace(place, faces={j: _frames_only(f, good) for j, f in place.faces.items()})
        left.append(place)
        kept.append(good)
    return left, kept, scatter


def _frames_only(returns: FaceReturns, good: BoolArray) -> FaceReturns:
    return returns.subset(np.flatnonzero(good[returns.frame]))
