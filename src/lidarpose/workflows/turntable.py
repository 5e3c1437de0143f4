"""The turntable job, from a session to a calibration; each function is a box of the paper's flow charts (1 and 5)."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import chain, groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarpose.errors import InputError, UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, log_so3
from lidarpose.model.calibration import Quality, TurntableCalibration
from lidarpose.model.image import GrayImage
from lidarpose.model.observation import LeftOut, PlaceFeatures, ScanLine, StripePoints, TurntableObservations
from lidarpose.model.sense import StatedSense
from lidarpose.model.session import TurntablePlace, TurntableSession
from lidarpose.model.turntable import TurntableMotion
from lidarpose.model.turntable_run import Deviation, FunctionDeviation, Method, TruthError, TurntableRun
from lidarpose.workflows.early_images import EarlyImages
from lidarpose.workflows.forked import NotAloneError, copies_likely, share
from lidarpose.workflows.named_causes import with_cause_named
from lidarpose.workflows.reversed_scans import Solved, doubt_reversed, reversed_part, reversed_scans
from lidarpose.workflows.turning_sense import check_sense, compared, turning_sense

if TYPE_CHECKING:
    from lidarpose.detect.chessboard import BoardDetection
    from lidarpose.detect.laser_stripe import StripeFinder
    from lidarpose.model.turntable_result import TurntableEstimate
    from lidarpose.refine.joint_options import JointOptions, Start
    from lidarpose.solve.light_plane import StripePair
    from lidarpose.solve.panel_pose import PanelPose
    from lidarpose.solve.paper import PaperSolution

Step = Callable[[], None]
"""Called after each image or scan that is done, for a progress bar."""


Meanwhile = Callable[[Mapping[str, "BoardDetection"]], object]
"""What is done with the boards while others search images."""

Batch = Sequence[TurntablePlace]
"""Places whose images are searched together."""

_Stripes = tuple[Mapping[int, StripePoints], list[LeftOut]]
_Detected = tuple[Mapping[str, "BoardDetection"], Sequence[tuple[ScanLine, ...] | LeftOut], Sequence[_Stripes]]

IMAGES_AT_ONCE = 12
"""Most stripe images that are fitted together: enough that single ones cost little, few for memory and progress."""

BATCHES_AHEAD = 4
"""So many batches of images are decoded while earlier ones are searched; more would only take memory."""

LEAST_SHARED = 5
"""With fewer places there is too little to share."""

MOST_CONTRADICTING = 0.15
"""Share of the places with both stripes that may contradict the others before the whole is in doubt."""


@dataclass(frozen=True)
class DetectedFeatures:
    """What detection found in a session, before anything is assigned.

    Attributes
    ----------
    boards
        By placement.
    places
        In the session's order; the places that could not be used at all are missing.
    left_out
        With their reasons.
    notes
        What the user should know, in words.
    """

    boards: Mapping[str, BoardDetection]
    places: tuple[PlaceFeatures, ...]
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class FittedBefore:
    """What the assignment has fitted: panels' poses by placement, light planes and stripes by position.

    `misfit_sigmas` is that of the motion the choice rests on; `against` the evidence that the order stated is against.
    """

    panel_poses: Mapping[str, tuple[PanelPose, ...]]
    stripe_pairs: Mapping[str, StripePair]
    misfit_sigmas: float = 0.0
    against: str | None = None


def calibrate_turntable(
    session: TurntableSession,
    *,
    method: Method = "joint",
    first_panel: int | None = None,
    options: JointOptions | None = None,
    stated: StatedSense | None = None,
    provenance: Mapping[str, Any] | Callable[[], Mapping[str, Any]] | None = None,
    step: Step | None = None,
) -> TurntableRun:
    """Find the LiDAR's pose in the camera frame as a function of the turntable's reading.

    Parameters
    ----------
    session
        Board images, stripe images and scans.
    method
        `joint`: one maximum-likelihood estimate over all places. `paper`: the closed forms of the turntable paper.
    first_panel
        The user's hint: the panel (index 0 or 1) on which the scan line of smaller beam angle lies.
    options
        Of the joint estimate.
    stated
        How beams and table turn, as the user sees it on his rig, before what the session states; a result that
        contradicts it is rejected.
    provenance
        For the calibration; what makes it, if it takes time, is called while the images are searched.
    step
        Called after each place.

    Raises
    ------
    InputError
        If an image or scan cannot be read.
    UndeterminedError
        If the session does not determine the motion; the message says why, and what to record.
    """
    recorded: list[Mapping[str, Any]] = []
    panel_poses: dict[str, tuple[PanelPose, ...]] = {}

    def meanwhile(boards: Mapping[str, BoardDetection]) -> None:
        recorded.append(provenance() if callable(provenance) else provenance or {})
        _import_what_follows()
        with suppress(UndeterminedError):  # which is raised again where it belongs
            panel_poses.update(_panel_poses(session, boards))

    stated = (stated or StatedSense()).filled_from(session.stated)
    features = detect_features(session, step=step, meanwhile=meanwhile)
    try:
        observations, fitted = assign_lines(session, features, first_panel=first_panel, panel_poses=panel_poses or None)
    except UndeterminedError as error:
        tried = _parts(session, features, first_panel)
        raise with_cause_named(error, session, features.places, features.left_out, *tried) from None
    estimate = None
    samples: Mapping[str, Pose] = {}
    if method == "joint" and not any(place.stripes for place in observations.places):
        start = start_without_stripes(observations)
    else:
        paper = solve(observations, fitted)
        start = start_of(paper)
        samples = {position: sample.pose for position, sample in paper.samples.items()}
    if method == "joint":
        estimate = refine(observations, start, options)
        calibration = estimate.calibration(recorded[0])
        left_out = estimate.left_out
    else:
        calibration = TurntableCalibration(paper.motion, quality=paper_quality(paper), provenance=recorded[0])
        left_out = paper.left_out
    calibration = replace(
        calibration,
        quality=checked(calibration, session, features, observations, start[1], estimate, stated),
    )
    if fitted.against is not None:
        calibration = replace(calibration, quality=_doubt_order(calibration.quality, fitted.against))
    return TurntableRun(
        method=method,
        session=session,
        observations=observations,
        samples=samples,
        paper_motion=start[0],
        deviation=deviation_from_samples(calibration.motion, observations, samples) if samples else None,
        calibration=calibration,
        estimate=estimate,
        left_out=merge_left_out(observations.left_out, left_out),
        notes=(*features.notes, turning_sense(calibration.motion, session.places[0].turntable_angle_rad, stated)),
    )


def checked(
    calibration: TurntableCalibration,
    session: TurntableSession,
    features: DetectedFeatures,
    observations: TurntableObservations,
    panel_poses: Mapping[str, Sequence[Pose | None]],
    estimate: TurntableEstimate | None,
    stated: StatedSense,
) -> Quality | None:
    """The verdict after a look at what the estimate never saw: places left out, and what the user says of his rig."""
    quality = doubted(calibration.quality, features, observations)
    kept = {place.position for place in observations.places}
    suspects = [place.position for place in session.places if place.position not in kept]
    if estimate is not None:
        groups = [group for group in estimate.residuals if group.kind == "ranges" and not group.weights.any()]
        suspects += [group.position for group in groups if group.position is not None]
    known = {name: [p for p in found if p is not None] for name, found in panel_poses.items()}
    found = reversed_scans(session, calibration.motion, known, suspects)
    if not found and quality is not None and quality.verdict == "rejected":
        found = _reversed_part(session, features)
    quality = doubt_reversed(quality, found)
    readings = [place.turntable_angle_rad for place in session.places]
    return compared(quality, check_sense(calibration.motion, readings, stated))


def _doubt_order(quality: Quality | None, against: str) -> Quality | None:
    """The verdict where the user's order of the lines was taken although evidence speaks for the other one."""
    if quality is None or quality.verdict == "rejected":
        return quality
    reason = (
        f"--first-panel was taken at its word, but {against} speak for the other order of the scan lines, with which "
        "the LiDAR stands elsewhere: look at the rig which panel the line of smaller beam angle lies on"
    )
    return replace(quality, verdict="doubtful", reasons=(*quality.reasons, reason))


def _parts(
    session: TurntableSession, features: DetectedFeatures, first_panel: int | None
) -> tuple[Callable[[Sequence[PlaceFeatures]], tuple[int, float]], Callable[[Sequence[PlaceFeatures]], Solved]]:
    """Assignment and closed form of some of a session's places."""

    def assign_part(places: Sequence[PlaceFeatures]) -> tuple[int, float]:
        found, fitted = assign_lines(session, replace(features, places=tuple(places)), first_panel=first_panel)
        return len(found.places), fitted.misfit_sigmas

    def solve_part(places: Sequence[PlaceFeatures]) -> Solved:
        part = replace(features, places=tuple(places))
        paper = solve(*assign_lines(session, part, first_panel=first_panel))
        return paper.motion, {n: [p.T_camera_panel for p in found] for n, found in paper.panel_poses.items()}

    return assign_part, solve_part


def _reversed_part(session: TurntableSession, features: DetectedFeatures) -> tuple[str, ...]:
    """Scans that run the other way round in a session that has no sound solution as a whole."""
    if not any(place.stripes for place in features.places):
        return ()
    _, solve_part = _parts(session, features, None)
    by_name = {place.position: place for place in features.places}
    return reversed_part(session, list(by_name), lambda names: solve_part([by_name[name] for name in names]))


def doubted(quality: Quality | None, features: DetectedFeatures, observations: TurntableObservations) -> Quality | None:
    """The verdict, lowered to doubtful where many places with both stripes contradict the motion of the others.

    Such places never reach the estimate, which is then sure of the rest; but if a part of a session fits one motion
    and another part a different one, nothing says which of them is right.
    """
    kept = {place.position for place in observations.places}
    lit = [place.position for place in features.places if len(place.stripes) == 2]
    gone = [position for position in lit if position not in kept]
    if quality is None or quality.verdict == "rejected" or len(gone) <= max(1.0, MOST_CONTRADICTING * len(lit)):
        return quality
    reason = (
        f"{len(gone)} of {len(lit)} places (first {gone[0]}, last {gone[-1]}) show both stripes, but their scans do "
        "not fit the motion of the other places: readings, scans or images may be mixed up, or something moved in "
        "between"
    )
    return replace(quality, verdict="doubtful", reasons=(*quality.reasons, reason))


def _import_what_follows() -> None:
    """Modules that the job needs once its images are searched, and what is computed once a process."""
    # numpy.median imports numpy.ma when it is called first.
    for name in ("lidarpose.solve.assignment", "lidarpose.solve.paper", "lidarpose.refine.turntable", "numpy.ma"):
        import_module(name)
    import_module("lidarpose.refine.noise").gaussian_moments()


def detect_features(
    session: TurntableSession, *, step: Step | None = None, meanwhile: Meanwhile = lambda boards: None
) -> DetectedFeatures:
    """Boards, stripes and scan lines of a session (sections 1.2 to 1.4), on all cores.

    Where this process may be forked, copies of it take their share of the places; the result is the same without.
    `meanwhile` is called once, with the boards, while others search or decode images.
    """
    batches = _batches(session.places)
    copies = copies_likely() if len(session.places) >= LEAST_SHARED else 0
    found: _Detected | None = None
    if copies > 0:
        with suppress(NotAloneError), ExitStack() as stack:
            found = _detect_with_copies(session, batches, copies, step, meanwhile, stack)
    if found is None:
        found = _detect_alone(session, batches, step, meanwhile)
    boards, all_lines, all_stripes = found
    places: list[PlaceFeatures] = []
    left_out: list[LeftOut] = []
    for place, lines, (stripes, problems) in zip(chain(*batches), all_lines, all_stripes, strict=True):
        left_out += problems
        if isinstance(lines, LeftOut):
            left_out.append(lines)
        else:
            places.append(PlaceFeatures(place.position, place.turntable_angle_rad, stripes, lines, place.placement))
    notes = tuple(note for board in boards.values() for note in board.notes)
    return DetectedFeatures(boards, tuple(places), tuple(left_out), notes)


def _detect_alone(
    session: TurntableSession, batches: Sequence[Batch], step: Step | None, meanwhile: Meanwhile
) -> _Detected:
    """Boards, scan lines and stripes by this process alone.

    Images are decoded ahead by threads of their own: decoding is most of the work, and leaves the interpreter free for
    the rest, which is done here, place after place.
    """
    executor = ThreadPoolExecutor(max_workers=max(1, os.cpu_count() or 1))
    try:
        decoded = _decoded_ahead(executor, batches)
        boards, finders = _detect_boards(session)
        meanwhile(boards)
        lines = [_find_scan_lines(session, place) for batch in batches for place in batch]
        stripes: list[_Stripes] = []
        for batch in batches:
            images = (image.result() for image in next(decoded) if image is not None)
            stripes += _find_stripes(finders[batch[0].placement], batch, images)
            _advance(step, batch)
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
    return boards, lines, stripes


def _detect_with_copies(
    session: TurntableSession,
    batches: Sequence[Batch],
    copies: int,
    step: Step | None,
    meanwhile: Meanwhile,
    stack: ExitStack,
) -> _Detected:
    """The same with the help of forked copies: scans and the first images while the boards are found, then images.

    OpenCV is imported once the first copies, which do not need it, have begun; until `stack` ends it has no threads.
    """
    found: list[tuple[Mapping[str, BoardDetection], Mapping[str, StripeFinder]]] = []

    def find_boards() -> None:
        from lidarpose.detect.opencv_threads import one_opencv_thread

        stack.enter_context(one_opencv_thread())
        found.append(_detect_boards(session))

    # One scan at a time: nobody waits long for another one's last.
    places = list(chain(*batches))
    images = [place.stripe_image for place in places if place.stripe_image is not None]
    early = EarlyImages(images, (session.camera.height, session.camera.width))

    def prepare(k: int) -> tuple[ScanLine, ...] | LeftOut | bool:
        return _find_scan_lines(session, places[k]) if k < len(places) else early.decode(k - len(places))

    prepared = share(prepare, len(places) + len(early), copies=copies, first=find_boards)
    lines = [each for each in prepared if not isinstance(each, bool)]
    early.keep([each for each in prepared if isinstance(each, bool)])
    boards, finders = found[0]

    def search(k: int) -> list[_Stripes]:
        # One image after the other, as each is asked for.
        images = (early.load(place.stripe_image) for place in batches[k] if place.stripe_image is not None)
        return _find_stripes(finders[batches[k][0].placement], batches[k], images)

    stripes = share(
        search,
        len(batches),
        copies=copies,
        first=lambda: meanwhile(boards),
        done=lambda k: _advance(step, batches[k]),
    )
    return boards, lines, list(chain(*stripes))


def _advance(step: Step | None, batch: Batch) -> None:
    if step is not None:
        for _ in batch:
            step()


def _detect_boards(session: TurntableSession) -> tuple[dict[str, BoardDetection], dict[str, StripeFinder]]:
    """Board and stripe finder by placement."""
    boards, finders = {}, {}
    for placement, sources in session.board_images.items():
        boards[placement], finders[placement] = _detect_board(session, placement, [s.load() for s in sources])
    return boards, finders


def _decoded_ahead(executor: ThreadPoolExecutor, batches: Sequence[Batch]) -> Iterator[list[Future[GrayImage] | None]]:
    """The stripe images of each batch, in order; `BATCHES_AHEAD` of them are on their way at any time."""

    def start(batch: Batch) -> list[Future[GrayImage] | None]:
        return [None if p.stripe_image is None else executor.submit(p.stripe_image.load) for p in batch]

    # Not a generator from the first line on: decoding is to start now.
    waiting = deque(start(batch) for batch in batches[:BATCHES_AHEAD])

    def in_order() -> Iterator[list[Future[GrayImage] | None]]:
        for following in (*batches[BATCHES_AHEAD:], *[()] * BATCHES_AHEAD):
            yield waiting.popleft()
            waiting.append(start(following))

    return in_order()


def _detect_board(
    session: TurntableSession, placement: str, images: Sequence[Any]
) -> tuple[BoardDetection, StripeFinder]:
    from lidarpose.detect.chessboard import BoardNotFoundError, find_panels
    from lidarpose.detect.laser_stripe import StripeFinder

    try:
        board = find_panels(images, session.panels)
    except BoardNotFoundError as error:
        names = ", ".join(source.name for source in session.board_images[placement][:3])
        if error.other_sizes:  # the images are good; it is the session that describes another board
            raise InputError(session.name, f"{error.what} ({names})", field=f"board.panels.{error.panel}") from None
        raise UndeterminedError(f"{error.what} ({names})", remedy=error.remedy) from None
    return board, StripeFinder(board, images)


def _find_scan_lines(session: TurntableSession, place: TurntablePlace) -> tuple[ScanLine, ...] | LeftOut:
    """Straight lines of a place's scan, or why there are none."""
    from lidarpose.detect.scan_lines import find_lines

    scan = place.scan.load()
    if not scan.has_return.any():
        return LeftOut(f"position {place.position}", "no beam of its scan has a return")
    return find_lines(scan, session.lidar) or LeftOut(f"position {place.position}", "its scan has no straight line")


def _batches(places: Sequence[TurntablePlace]) -> list[Batch]:
    """Places in their order, some at a time, all of a batch of one placement of the board.

    Fewer towards the end, and one at last, so that no process waits long for another one's last batch.
    """
    batches: list[Batch] = []
    for _, group in groupby(places, key=lambda place: place.placement):
        own = list(group)
        while own:
            count = min(-(-len(own) // 4), IMAGES_AT_ONCE)
            batches.append(own[:count])
            own = own[count:]
    return batches


def _find_stripes(
    finder: StripeFinder, places: Sequence[TurntablePlace], images: Iterable[GrayImage]
) -> list[_Stripes]:
    """Stripes of each place by panel, and what was given up; `images` are of those places that have one."""
    detections = iter(finder.find_in(images))
    found: list[_Stripes] = []
    for place in places:
        if place.stripe_image is None:
            found.append(({}, []))
            continue
        detection = next(detections)
        lost = [LeftOut(f"position {place.position}, {p.what}", p.reason) for p in detection.problems]
        found.append((detection.stripes, lost))
    return found


def assign_lines(
    session: TurntableSession,
    features: DetectedFeatures,
    *,
    first_panel: int | None = None,
    panel_poses: Mapping[str, tuple[PanelPose, ...]] | None = None,
) -> tuple[TurntableObservations, FittedBefore]:
    """Decide by evidence which scan lines lie on which panels; with what was fitted for it.

    `panel_poses`: those of the boards, where they are known already.
    """
    from lidarpose.solve.assignment import assign

    corners = {name: board.corners for name, board in features.boards.items()}
    unassigned = TurntableObservations(session.camera, session.panels, corners, (), session.lidar, features.left_out)
    if panel_poses is None:
        panel_poses = _panel_poses(session, features.boards)
    assignment = assign(session.camera, panel_poses, features.places, panels=session.panels, first_panel=first_panel)
    left_out = merge_left_out(features.left_out, assignment.left_out)
    return replace(unassigned, places=assignment.places, left_out=left_out), FittedBefore(
        panel_poses, assignment.stripe_pairs, assignment.figures["rms_sigmas"], assignment.against
    )


def _panel_poses(session: TurntableSession, boards: Mapping[str, BoardDetection]) -> dict[str, tuple[PanelPose, ...]]:
    """The panels' poses by placement."""
    from lidarpose.solve.paper import board_poses

    return {name: board_poses(session.camera, board.corners, name) for name, board in boards.items()}


def solve(observations: TurntableObservations, fitted: FittedBefore | None = None) -> PaperSolution:
    """The paper's closed forms (its sections 1 and 2), with the fits that are there already."""
    from lidarpose.solve.paper import solve_paper

    if fitted is None:
        return solve_paper(observations)
    return solve_paper(observations, stripe_pairs=fitted.stripe_pairs, panel_poses=fitted.panel_poses)


def start_of(paper: PaperSolution) -> Start:
    """Motion and panels of the closed form, where the joint estimate starts."""
    poses = {name: tuple(p.T_camera_panel for p in panels) for name, panels in paper.panel_poses.items()}
    return paper.motion, poses


def start_without_stripes(observations: TurntableObservations) -> Start:
    """Motion from boards and scans alone, for a laser that no camera sees: each scan line lies on its panel's plane."""
    from lidarpose.solve.assignment_blind import motion_without_stripes
    from lidarpose.solve.paper import board_poses

    panels = {name: board_poses(observations.camera, c, name) for name, c in observations.corners.items()}
    motion = motion_without_stripes(observations, panels)
    return motion, {name: tuple(p.T_camera_panel for p in found) for name, found in panels.items()}


def refine(observations: TurntableObservations, start: Start, options: JointOptions | None = None) -> TurntableEstimate:
    """The joint estimate, started from the closed form."""
    from lidarpose.refine.joint_options import JointOptions
    from lidarpose.refine.turntable import refine_turntable

    def restart(other: TurntableObservations) -> Start:
        return start_of(solve(other))

    return refine_turntable(observations, *start, replace(options or JointOptions(), restart=restart))


def paper_quality(paper: PaperSolution) -> Quality:
    """The paper's method states no uncertainty, so that nothing better than `doubtful` can be said of it."""
    reason = (
        "The paper's method states no uncertainty; deviations from its own samples are no error against the truth. "
        "Use --method joint for a verdict."
    )
    return Quality("doubtful", (reason,), {"table_1": paper.deviations.table()})


def deviation_from_samples(
    motion: TurntableMotion, observations: TurntableObservations, samples: Mapping[str, Pose]
) -> FunctionDeviation:
    """Table 1 of the paper for any motion: its deviation from the single places' poses."""
    from lidarpose.solve.turntable_function import deviations

    readings = {place.position: place.turntable_angle_rad for place in observations.places}
    found = deviations(motion, [readings[position] for position in samples], list(samples.values()))
    return FunctionDeviation(
        _deviation(1e3 * found.centre_m), _deviation(np.rad2deg(found.z_rad)), _deviation(np.rad2deg(found.x_rad))
    )


def error_against_truth(motion: TurntableMotion, truth: TurntableMotion, readings_rad: Sequence[float]) -> TruthError:
    """How far a motion is from the true one, over the session's readings and over the whole turn."""
    arc = [_pose_error(motion, truth, angle) for angle in np.linspace(min(readings_rad), max(readings_rad), 25)]
    turn = [_pose_error(motion, truth, angle) for angle in np.arange(72) * (2.0 * np.pi / 72)]
    columns = [1e3 * np.array(arc)[:, 0], np.rad2deg(np.array(arc)[:, 1])]
    columns += [1e3 * np.array(turn)[:, 0], np.rad2deg(np.array(turn)[:, 1])]
    return TruthError(*(_deviation(column) for column in columns))


def _pose_error(motion: TurntableMotion, truth: TurntableMotion, angle: float) -> tuple[float, float]:
    mine, true = motion.pose(angle), truth.pose(angle)
    rotation = float(np.linalg.norm(log_so3(mine.rotation @ true.rotation.T)))
    return float(np.linalg.norm(mine.translation - true.translation)), rotation


def _deviation(values: FloatArray) -> Deviation:
    return Deviation(float(np.mean(values)), float(np.max(values)))


def merge_left_out(first: Iterable[LeftOut], second: Iterable[LeftOut]) -> tuple[LeftOut, ...]:
    """Both lists, each entry once."""
    return tuple(dict.fromkeys((*first, *second)))
