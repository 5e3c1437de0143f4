"""A gate against growing slower: work is counted, not timed, so that a busy machine changes nothing.

For every job: how many functions it calls (Python's and C's; with arrays of a fixed size, slower code calls more), how
much memory it holds at once, and how both grow with the work. Limits are what was measured and half as much again,
for other versions of Python and NumPy. The last tests put a slow or greedy version in place of a part, and the gate
must notice.
"""

import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from benchmarks.assemble import MOTION, recording
from benchmarks.counting import calls, over_reference, peak_bytes
from benchmarks.suites.plane_search import scene

from lidarpose.detect import cloud_planes, patch_evidence, plane_sample
from lidarpose.detect.chessboard import find_panels
from lidarpose.detect.cloud_planes import PlaneSearch, segment_planes
from lidarpose.detect.laser_stripe import StripeFinder
from lidarpose.geometry import compiled
from lidarpose.measure import assemble as assembling
from lidarpose.measure.assemble import assemble
from lidarpose.model.cloud import Cloud
from lidarpose.model.image import GrayImage, ImageSource
from lidarpose.model.observation import TurntableObservations
from lidarpose.model.recording import SweepRecording
from lidarpose.model.session import TurntableSession
from lidarpose.model.turntable import TurntableMotion
from lidarpose.refine import joint_equations, turntable_joint
from lidarpose.refine.least_squares import line_moments
from lidarpose.refine.turntable import JointOptions, refine_turntable
from lidarpose.simulate.corner_scene import CornerSceneSpec, simulate_corner_session
from lidarpose.simulate.observations import simulate_observations
from lidarpose.simulate.rig import draw_rig
from lidarpose.simulate.session import simulate_session
from lidarpose.solve.paper import solve_paper
from lidarpose.storage.clouds import ply, read_cloud, write_cloud
from lidarpose.storage.corner_session import write_corner_session
from lidarpose.workflows.turntable import calibrate_turntable
from lidarpose.workflows.world import calibrate_world

Work = Callable[[], object]


@pytest.fixture(autouse=True)
def by_numpy() -> Iterator[None]:
    """What is counted is NumPy's way, whether or not an earlier test has imported numba."""
    with compiled.forced(False):
        yield


@dataclass(frozen=True)
class Gate:
    """A job, and what it may cost.

    Attributes
    ----------
    make
        Prepares the input and gives the job.
    most_calls
        Measured times one and a half.
    most_bytes
        Likewise; None where memory is not the matter.
    """

    make: Callable[[], Work]
    most_calls: int
    most_bytes: int | None = None

    def check(self) -> None:
        work = self.make()
        work()  # what is cached or imported once is no cost of the job
        assert calls(work) <= self.most_calls
        if self.most_bytes is not None:
            assert peak_bytes(work) <= self.most_bytes


# --- the jobs -------------------------------------------------------------------------------------------------------


def assembling_sweeps(sweeps: int) -> Work:
    source = recording(sweeps, 1000)
    return lambda: assemble(source, MOTION, compiled=False)


def finding_planes(points: int) -> Work:
    cloud, _ = scene(points, None, 1)
    return lambda: segment_planes(cloud, PlaneSearch(max_planes=3))


@lru_cache(maxsize=2)
def observations_of(places: int) -> TurntableObservations:
    return simulate_observations(draw_rig(1, places=places), stripe_step_px=4.0)


def solving(places: int) -> Work:
    observations = observations_of(places)
    return lambda: solve_paper(observations)


def refining(places: int) -> Work:
    observations = observations_of(places)
    start = solve_paper(observations)
    poses = {name: tuple(p.T_camera_panel for p in ps) for name, ps in start.panel_poses.items()}
    options = JointOptions(search_alternatives=False)
    return lambda: refine_turntable(observations, start.motion, poses, options)


@lru_cache(maxsize=1)
def rendered() -> TurntableSession:
    """Eight places with their images in memory."""
    return simulate_session(draw_rig(1, places=8, step_deg=2.6, size=(812, 617))).session


@lru_cache(maxsize=1)
def board_images() -> tuple[GrayImage, ...]:
    return tuple(source.load() for source in rendered().board_images[""])


@lru_cache(maxsize=1)
def finder() -> StripeFinder:
    return StripeFinder(find_panels(board_images(), rendered().panels), board_images())


def finding_boards() -> Work:
    return lambda: find_panels(board_images(), rendered().panels)


def finding_a_stripe() -> Work:
    source = rendered().places[3].stripe_image
    assert source is not None
    image = source.load()
    return lambda: finder().find(image)


def finding_stripes() -> Work:
    """Eight images at once, as `calibrate` does."""
    images = [place.stripe_image.load() for place in rendered().places if place.stripe_image is not None]
    return lambda: finder().find_in(images)


@lru_cache(maxsize=1)
def frames() -> Work:
    session, _ = simulate_corner_session(CornerSceneSpec(pose="1", frames=2, places=3, seed=1))
    return lambda: calibrate_world(session)


POINTS = 300_000
CLOUD = Cloud(np.random.default_rng(0).uniform(-9.0, 9.0, (POINTS, 3)).astype(np.float32))
CLOUD_BYTES = CLOUD.points.nbytes

GATES = {
    "assembling half a million points": Gate(lambda: assembling_sweeps(500), 650, 10_000_000),
    "assembling five million points": Gate(lambda: assembling_sweeps(5000), 2_350, 75_000_000),
    "three planes of 60 k points": Gate(lambda: finding_planes(60_000), 7_000, 4_000_000),
    "three planes of 240 k points": Gate(lambda: finding_planes(240_000), 11_500, 12_000_000),
    "the closed form of 15 places": Gate(lambda: solving(15), 69_500),
    "the joint estimate of 15 places": Gate(lambda: refining(15), 111_500, 6_800_000),
    "both boards": Gate(finding_boards, 23_000, 20_000_000),
    "a stripe image": Gate(finding_a_stripe, 13_300, 1_700_000),
    "eight stripe images": Gate(finding_stripes, 27_200, 6_100_000),
    "the world pose from six frames": Gate(frames, 70_000, 40_000_000),
}


@pytest.mark.parametrize("name", GATES)
def test_a_job_costs_no_more_than_it_did(name: str) -> None:
    GATES[name].check()


@pytest.mark.parametrize("job", [solving, refining])
def test_twice_the_places_cost_at_most_twice_the_calls(job: Callable[[int], Work]) -> None:
    few, many = (calls(job(places)) for places in (15, 30))
    assert many <= 2.2 * few


@pytest.mark.parametrize("suffix", ["ply", "pcd", "npy"])
def test_a_cloud_is_written_without_copies_and_read_with_one(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"cloud.{suffix}"
    write_cloud(path, CLOUD)
    assert calls(lambda: write_cloud(path, CLOUD)) <= 750
    assert peak_bytes(lambda: write_cloud(path, CLOUD)) <= 0.1 * CLOUD_BYTES
    read_cloud(path)
    assert calls(lambda: read_cloud(path)) <= 550
    assert peak_bytes(lambda: read_cloud(path)) <= 1.1 * CLOUD_BYTES


def assembling_over_sines() -> float:
    """CPU time of assembling over that of one simple pass over the result, in the same process."""
    source = recording(500, 2000)
    points = np.zeros((500, 2000, 3), dtype=np.float32)
    other = np.zeros_like(points)
    return over_reference(
        lambda: assemble(source, MOTION, out=points, compiled=False), lambda: np.sin(points, out=other)
    )


# What counts cannot show, more passes over the data. Measured 2.3 to 3.7 on a busy machine.
def test_assembling_costs_no_more_than_some_passes_over_the_result() -> None:
    assert assembling_over_sines() < 5.5


def finding_planes_over_sines() -> float:
    """Likewise for three planes of a dense cloud, over a simple pass over its points."""
    points = scene(400_000, None, 1)[0].astype(np.float32)
    out = np.zeros_like(points)
    search = PlaneSearch(max_planes=3)
    return over_reference(lambda: segment_planes(points, search), lambda: np.sin(points, out=out))


# Measured 19 to 25 on a busy machine, with BLAS in one thread and in two: threads of it that wait count as well.
def test_planes_of_a_dense_cloud_cost_no_more_than_some_passes_over_it() -> None:
    assert finding_planes_over_sines() < 42.0


class CountingImage:
    """An image in memory that counts how often it is read."""

    def __init__(self, source: ImageSource) -> None:
        self.name = source.name
        self.image = source.load()
        self.loads = 0

    def load(self) -> GrayImage:
        self.loads += 1
        return self.image


def test_calibrate_reads_every_image_once() -> None:
    session = rendered()
    images: list[CountingImage] = []

    def counted(source: ImageSource) -> CountingImage:
        images.append(CountingImage(source))
        return images[-1]

    places = tuple(
        replace(p, stripe_image=None if p.stripe_image is None else counted(p.stripe_image)) for p in session.places
    )
    boards = {name: tuple(counted(source) for source in sources) for name, sources in session.board_images.items()}
    calibrate_turntable(replace(session, places=places, board_images=boards))
    assert len(images) > len(places)
    assert max(image.loads for image in images) <= 1


def modules_of(*arguments: str) -> set[str]:
    code = "import sys, runpy, io\n"
    if arguments:
        code += f"sys.argv = ['lidarpose', *{list(arguments)!r}]; sys.stdout = io.StringIO()\n"
        code += "try:\n    runpy.run_module('lidarpose', run_name='__main__')\nexcept SystemExit:\n    pass\n"
    else:
        code += "import lidarpose\n"
    code += "sys.stderr.write(' '.join(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], check=True, stderr=subprocess.PIPE, text=True)
    return set(done.stderr.split())


def test_starting_imports_no_more_than_it_did() -> None:
    bare = {"numpy", "scipy", "cv2", "rich", "cyclopts", "pydantic", "numba"}
    package = modules_of()
    assert not package & bare
    assert len(package) <= 80
    command = modules_of("--help")
    assert not command & {"numpy", "scipy", "cv2", "pydantic", "numba", "ruamel", "laspy", "markdown_it"}
    assert len(command) <= 340


def test_a_command_on_a_plain_corner_session_imports_no_scipy(tmp_path: Path) -> None:
    """Its import takes longer than all the searches for neighbours and pieces for which it would be used."""
    session, _ = simulate_corner_session(CornerSceneSpec(pose="1", frames=2, seed=1))
    write_corner_session(tmp_path / "session", session)
    command = modules_of("calibrate", str(tmp_path / "session"), "-o", str(tmp_path / "out"), "--quiet")
    assert (tmp_path / "out" / "report.html").is_file()
    assert not command & {"scipy", "cv2", "pydantic", "numba", "numpy.ma"}
    assert len(command) <= 560


# --- the gate notices -----------------------------------------------------------------------------------------------


def sweep_by_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of one sweep in place of many."""

    def in_threads(work: Callable[[int, int], None], count: int, step: int) -> None:
        for first in range(count):
            work(first, first + 1)

    monkeypatch.setattr(assembling, "_in_threads", in_threads)


def all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """One block of everything: intermediate arrays as large as the result."""
    monkeypatch.setattr(assembling, "_in_threads", lambda work, count, step: work(0, count))


def hypothesis_by_hypothesis(monkeypatch: pytest.MonkeyPatch) -> None:
    """Local planes one after the other in place of all at once."""
    together = patch_evidence.local_planes_of

    def one_by_one(chosen: np.ndarray) -> object:
        parts = [together(one[None]) for one in chosen]
        return tuple(np.concatenate([part[k] for part in parts]) for k in range(2))

    for module in (plane_sample, patch_evidence):
        monkeypatch.setattr(module, "local_planes_of", one_by_one)


def line_by_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Moments of lines summed point by point."""
    together = line_moments

    def point_by_point(columns: np.ndarray, weight: np.ndarray, start: np.ndarray) -> object:
        out = together(columns, weight, start)
        for row in columns:
            np.outer(row, row)
        return out

    for module in (joint_equations, turntable_joint):
        monkeypatch.setattr(module, "line_moments", point_by_point)


def twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every stripe image searched twice."""
    once = StripeFinder.find_in

    def find_in(self: StripeFinder, images: list[GrayImage]) -> object:
        once(self, images)
        return once(self, images)

    monkeypatch.setattr(StripeFinder, "find_in", find_in)


def one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stripe images searched one after the other."""
    together = StripeFinder.find_in
    monkeypatch.setattr(StripeFinder, "find_in", lambda self, images: [together(self, [image]) for image in images])


def by_einsum(recording: SweepRecording, motion: TurntableMotion, points: np.ndarray) -> Callable[[int, int], None]:
    """Eq. (28) by full matrices for every point, in double precision: measured 10 to 13."""
    origins, directions = assembling.beam_origins_and_directions(motion, recording)

    def work(first: int, last: int) -> None:
        identity = np.broadcast_to(np.eye(3), (last - first, 3, 3))
        turned = np.einsum("nij,nmj->nmi", identity, directions[first:last])
        turned = np.einsum("nij,nmj->nmi", identity, turned)
        points[first:last] = origins[first:last, None] + turned * recording.range_m[first:last, :, None]

    return work


def test_the_gate_notices_more_work_a_point(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assembling, "_block_per_sweep", by_einsum)
    assert assembling_over_sines() > 5.5


def test_the_gate_notices_a_look_at_all_points_for_each_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    # As it was before: measured 64, and 100 to 150 where BLAS has two threads.
    monkeypatch.setattr(cloud_planes, "DENSE", 10**9)
    assert finding_planes_over_sines() > 42.0


@pytest.mark.parametrize(
    ("spoil", "name"),
    [
        (sweep_by_sweep, "assembling half a million points"),
        (all_at_once, "assembling five million points"),
        (hypothesis_by_hypothesis, "three planes of 60 k points"),
        (line_by_line, "the joint estimate of 15 places"),
        (twice, "a stripe image"),
        (one_by_one, "eight stripe images"),
    ],
)
def test_the_gate_notices(
    spoil: Callable[[pytest.MonkeyPatch], None], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil(monkeypatch)
    with pytest.raises(AssertionError):
        GATES[name].check()


def test_the_gate_notices_a_copy_of_a_cloud(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    read = ply.read
    monkeypatch.setattr(ply, "read", lambda path: Cloud(read(path).points.astype(np.float64).astype(np.float32)))
    with pytest.raises(AssertionError):
        test_a_cloud_is_written_without_copies_and_read_with_one("ply", tmp_path)
