"""The world job: from a corner session to the pose in the world, by the paper's methods and by one joint estimate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.geometry.threads import one_blas_thread
from lidarpose.model.calibration import WorldCalibration
from lidarpose.model.corner_session import CornerSession
from lidarpose.model.world_run import WorldRun
from lidarpose.refine.corner_verdict import PrecisionLimits
from lidarpose.workflows.corner_target import FoundTarget, PlaceCrop, Tick, find_target, gather
from lidarpose.workflows.recorded_corners import with_scans
from lidarpose.workflows.thin_face import with_thin_face
from lidarpose.workflows.world_cornerwise import cornerwise
from lidarpose.workflows.world_joint import joint_estimate

WorldMethod = Literal["joint", "paper", "paper-approx", "ransac", "harris"]
WORLD_METHODS: tuple[WorldMethod, ...] = ("joint", "paper", "paper-approx", "ransac", "harris")


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
            run = cornerwise(session, found, crops, method, scale_too, limits, seed)
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


def _joint_with_all_faces(
    session: CornerSession, located: LocatedTarget, scale_too: bool, limits: PrecisionLimits
) -> WorldRun:
    """The joint estimate; again with the thin face from all places together where single places lack it."""
    run, failure = None, None
    try:
        if located.found.by_edges:
            raise _two_faces()
        run = joint_estimate(session, located.found, located.crops, scale_too, limits)
    except UndeterminedError as error:
        failure = error
    if run is not None and (_rank(run) == 0 or _shows_all_faces(run, session)):
        return run
    mended = with_thin_face(located.found, located.crops)
    if mended is not None:
        try:
            second = joint_estimate(session, mended, gather(session, mended), scale_too, limits, own_fits=False)
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
