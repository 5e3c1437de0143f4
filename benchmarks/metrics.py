"""The one list of what is measured: name, unit, which way is better, how far two runs may differ, and the target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Better = Literal["lower", "higher"]


@dataclass(frozen=True)
class Metric:
    """One figure of the table.

    Attributes
    ----------
    key
        Its name in the JSON, `suite.figure`.
    what
        In words, for the table.
    unit
        "x" for a ratio.
    tolerance
        Two runs on one idle machine differ by less than this share of the value.
    absolute
        The tolerance is no share but a difference: for exponents, where a share of nearly nothing is nothing.
    target
        At most this where lower is better, at least this where higher is; None where nothing is asked.
    bound
        Where the target is missed: what bounds the figure, and what was tried; a line end begins a new paragraph.
        Metrics that share it are printed together, with it once.
    """

    key: str
    what: str
    unit: str
    tolerance: float
    target: float | None = None
    better: Better = "lower"
    bound: str = ""
    absolute: bool = False

    def met(self, value: float) -> bool | None:
        """Whether a value reaches the target; None without one."""
        if self.target is None:
            return None
        return value <= self.target if self.better == "lower" else value >= self.target

    def agrees(self, first: float, second: float) -> bool:
        """Whether two runs gave the same figure within the tolerance."""
        return abs(first - second) <= self.tolerance * (1.0 if self.absolute else max(abs(first), abs(second)))

    @property
    def tolerance_text(self) -> str:
        """The tolerance for a reader."""
        return f"± {self.tolerance:g}" if self.absolute else f"{100 * self.tolerance:.0f} %"


def _exponent(key: str, what: str) -> Metric:
    return Metric(key, what, "", 0.15, 1.1, absolute=True)


_PLANES = (
    "In processor time, three planes of 700 k points take 16 ms in a process that has loaded its kernels: 3 for "
    "hypotheses and 3 for testing patches in a subsample of 8192 points, on one core, then 9 for the one pass over "
    "all points, on all cores; the table has that pass alone, and the mere reading of all points. Without kernels "
    "these are 3, 4 and 20. Tried: bits for votes, kernels for the pass and for the testing, terms of what patches "
    "claim kept from the pass for all that follows, brute force in place of trees for neighbours (no sooner for 200 "
    "of 4096 points), vector instructions for the claims' terms (3 % of the pass), other sizes of blocks, threads "
    "that take blocks themselves in place of a pool that is waited for (a tenth of the wakes). Clouds of less than "
    "200 k points are searched whole: 60 k take 17 ms, without kernels 23, of which a third goes to a thousand "
    "hypotheses."
)

_STRIPES = (
    "In processor time an image takes 2.3 ms by kernels, 0.5 of it for the line in the reduced image, of that a third "
    "reading the image; by NumPy 6.2. Tried: all images of a batch in one table, twelve in place of eight (0.2 ms), "
    "light shares looked up several pixels at once (a fifth of that kernel's time), what only the bright image tells "
    "found once, each image searched while it is in the cache, a third of the profiles for the first curve, 150 "
    "profiles in place of 250 for the width (0.3 ms), one search in the reduced image without images of ridges (0.2), "
    "kernels for curves, steps, noise and points (1.1), for ranges, ambient light and first guesses (0.2). Without "
    "gain: sums of blocks in whole words, maps for cutting out, partial sorting for the noise's bins."
)
_CALIBRATE = (
    "`calibrate.least` is what images and stripes at 3 ms take by themselves, shared without loss. It leaves 0.6 of "
    "decoding for all else below 1.3, so that no single part forbids it; the sum does: the parts' wall times are in "
    "the table of this suite.\n"
    "Processor time of a run, the least of several: images 0.62 s (kornia-rs; OpenCV takes 1.49), stripes 0.34 s by "
    "kernels and 0.63 by NumPy, boards 0.13 s, scan lines 0.08 s by kernels, half of that reading the scans, and 0.20 "
    "by NumPy, all shared by two processes, with a tenth more for memory that is new to a process, two forks, and each "
    "waiting for the other's last image; then, once all places are known, on one core assignment and closed "
    "form 0.09 s (0.15 before), joint estimate 0.13 s (0.22 before), report 0.12 s.\n"
    "Tried: stripes in batches and by kernels, forked copies of the process, a faster decoder, lines, light planes, "
    "stripes and poses of all places as tables, inputs hashed, what follows imported and the panels' poses fitted "
    "while others search images, fewer searches for garbage (a tenth of a command), foreign threads looked for in "
    "the first fork instead of by one before it, scans and last images one at a time, scan lines by kernels (0.15 s "
    "by NumPy, 0.036), the first sixteen images decoded by who has no more scans while the boards are found, into "
    "memory that both share (all scans take 0.1 s less than the boards), no choice of lines refined twice. In the "
    "joint estimate: most steps on 32 rows a line, held parameters left out, small steps to first order without "
    "derivatives anew, the next stage begun as soon as one has settled (8 steps for 11), sums of neighbouring "
    "rows found only as far as they count, in place of a Fourier transform, effects of lines written "
    "out two by two.\n"
    "Without gain: PNG by zlib (8.7 ms an image before its filters are undone, kornia-rs 7.4 in all), larger memory "
    "pools, NumPy's passes over stripes in place, the assignment's candidates found by two processes (0.053 s by "
    "one; 0.087 s of processor time with the fork and what is sent) or batch by batch with the images (0.08 s in "
    "small batches), no search for garbage before the fork or in it (less than 2 ms a process), memory that is not "
    "given back to the system (as many first touches after a fork). What is left on one core is many small calls: too "
    "little for a fork, which takes 5 ms and the time to send what it found.\n"
    "Not tried: kernels for the moments of lines and for light planes (0.03 s together); the joint estimate begun "
    "on the places that have been searched, which would move its first steps, 0.04 s, to where both cores share "
    "them, and needs an assignment of its own; images decompressed by vector instructions (ISA-L undoes a stream in "
    "0.44 of zlib's time; with a kernel for the filters about 0.05 s of wall time), which needs another library."
)
_COMMAND = (
    "As for `calibrate`, and: a command starts, imports and reads its session before anything can be shared (NumPy "
    "and the command line's parser are two fifths of it). That start took 0.29 of decoding on an idle machine, and "
    "`calibrate` in a process that has its kernels 1.26: together 1.55, above 1.3 whatever kernels would cost. They "
    "cost more than they bring: importing numba takes 0.36 s and loading them 0.05 s, before the command forks, and "
    "saves each of two processes 0.15 s; a command forced to take them took 1.93 s in place of 1.54 (six runs of "
    "each in turn). So it searches by NumPy: stripes add 0.25 of decoding, boards and scan lines 0.25, the part on one "
    "core 0.3. `calibrate.least_command` is the start and `calibrate.least`. Against a process that only decodes "
    "(`calibrate.plain_process`) the reference has its own start, Python and the import of OpenCV, in it as well.\n"
    "Tried: sessions read without pydantic (0.05 s), which is imported where something is wrong with them; what only "
    "the result needs imported while others search images; no search for garbage at the end."
)
_FRAMES_COMMAND = (
    "In processor time the process that reads takes 0.17 s, of which reading the frames is a fifth and the rest "
    "Python's start, NumPy and the readers; the command takes 0.44, without report 0.40 (least of nine each). Of that "
    "0.2 s are imports (NumPy and the line's parser 0.07, the methods' modules 0.05, printing 0.015, versions for the "
    "record 0.01) and 0.16 the job by NumPy, as above: kernels would take longer to load than they save. For 2, a "
    "tenth of a second would have to go, more than half of the job.\n"
    "Tried: neighbours and pieces of small clouds without SciPy, whose import took 0.2 s for 3 ms of work; what "
    "reports, recordings and masked arrays need imported only for those. Before that the command took 0.65 s."
)
_FRAMES = (
    "Kernels are what a process that runs on has; a single run takes NumPy's way and does not wait for them. "
    "Parts of both ways, and what no way can leave out, are measured beside the whole. By NumPy that alone is 2.6 "
    "times reading, above 2; by kernels it is 1.8, and the least that finding takes 0.1: 3 ms are left of 2 for the "
    "corner's search at six places, evidence and verdict, which take 50 ms. Before the last fit, whose"
    " two passes over all returns take half a millisecond each by kernels, the estimate takes one that serves "
    "each frame's corner, a step of the estimate and its noise, and one along the faces' sides; about two fifths "
    "of its time goes into evidence (foreign spots, sides of faces, rings, where beams cross), in many small "
    "calls on 18 faces. Done already: frames looked at where they lie in memory that is used again, steps "
    "lengthened by what weights leave, equations of all faces in one product, a single map of what moved, whole "
    "faces without another search, threads for places and faces, BLAS held to one thread (two took 1.2 to 1.4 "
    "times the processor time). The sightings' own returns in place of a first estimate saved 0.3, but lost one "
    "to four per cent of the returns. Wide boxes cut in a thread while the target is searched cost 1.3 times the "
    "processor time of both and no less time; a pass of the fit in two threads 1.5 times that of one. Larger "
    "memory pools change nothing. Finding: by kernels half of it is two searches for planes among 1000 and 2400 "
    "points and a fifth the sightings at the places, two kernels each; the rest is reading and telling what moved "
    "(`world.find_least`) and calls of Python, some 3 us each. By NumPy it is as many passes in small calls. Cutting: "
    "a frame's bytes cost half of what reading it as the reference does, one pass in vector instructions 0.2 of it, "
    "headers and calls the rest, which the cores cannot share. Mapped files, with all their pages at once too, and "
    "blocks of 64 and 128 kB take as long as whole frames into the same memory; a voxel map of which few pages are "
    "touched saves half a millisecond; a frame opened and read once, header and points together, takes the same "
    "processor time as both apart. Cutting to the faces' own slabs would leave four fifths of the returns. Not "
    "tried: single precision for selecting; merging returns of one beam over frames, which need not repeat them."
)

METRICS: tuple[Metric, ...] = (
    # Starting
    Metric("start.import_s", "`import lidarpose`, warm", "s", 0.5, 0.15),
    Metric("start.help_s", "`lidarpose --help`, warm", "s", 0.3, 0.2),
    Metric("start.import_cold_s", "`import lidarpose`, no byte code, files out of the page cache", "s", 0.6),
    Metric("start.help_cold_s", "`lidarpose --help`, no byte code, files out of the page cache", "s", 0.6),
    # The turntable's calibration
    Metric(
        "calibrate.least",
        "the least that any such calibration takes here: its images by the fastest decoder and 3 ms of stripes each, "
        "shared by the cores, over decoding them by OpenCV",
        "x",
        0.25,
    ),
    Metric("calibrate.least_command", "the same and the start of a command, in a new process", "x", 0.25),
    Metric(
        "calibrate.report",
        "`calibrate`, 87 places, report written, over decoding its images",
        "x",
        0.25,
        2.0,
        bound=_CALIBRATE,
    ),
    Metric("calibrate.plain", "the same without the report", "x", 0.25, 1.3, bound=_CALIBRATE),
    Metric(
        "calibrate.report_command",
        "the whole command in a new process, over decoding",
        "x",
        0.25,
        2.0,
        bound=_COMMAND,
    ),
    Metric("calibrate.plain_command", "the same with `--no-report`", "x", 0.25, 1.3, bound=_COMMAND),
    Metric(
        "calibrate.report_process",
        "the whole command, over a new process that only decodes the images",
        "x",
        0.25,
        2.0,
        bound=_COMMAND,
    ),
    Metric("calibrate.plain_process", "the same with `--no-report`", "x", 0.25, 1.3, bound=_COMMAND),
    # Boards and stripes
    Metric("boards.s", "both boards of one image", "s", 0.3, 0.1),
    Metric("boards.error", "RMS error of their corners, over OpenCV's SB with ACCURACY", "x", 0.02, 1.0),
    Metric("boards.time", "their time, over OpenCV's SB with ACCURACY", "x", 0.3),
    Metric("stripes.ms", "a stripe image beyond decoding it, kernels loaded", "ms", 0.3, 3.0, bound=_STRIPES),
    Metric("stripes.ms_numpy", "the same by NumPy, as a single command searches", "ms", 0.3),
    Metric("stripes.ms_per_megapixel", "the same a megapixel", "ms", 0.3),
    Metric("stripes.decoding", "a stripe image, over decoding it", "x", 0.3),
    # Planes
    Metric(
        "planes.open3d",
        "Open3D segment_plane at its defaults, 700 k points, over ours",
        "x",
        0.4,
        50.0,
        "higher",
        _PLANES,
    ),
    Metric("planes.open3d_first", "the same, over a process's first clouds, without kernels", "x", 0.4, None, "higher"),
    Metric("planes.open3d_1000", "the same with 1000 iterations, over ours", "x", 0.4, None, "higher"),
    Metric("planes.subsample", "Open3D on a random subsample of 20 k, over ours", "x", 0.4, 5.0, "higher", _PLANES),
    Metric("planes.pyransac3d", "pyransac3d at its defaults, 700 k points, over ours", "x", 0.4, None, "higher"),
    Metric("planes.error", "normals' RMS error, over the best peer's, three like faces", "x", 0.5, 1.0),
    # Whether the best peer misses the small face by a degree or altogether is its luck, and not the same in two runs.
    Metric("planes.error_small", "worst normal with a face of 2 % of the points, over the best peer's", "x", 0.99, 1.0),
    # Assembling and files
    Metric("assemble.copy", "assembling 19 M points, over a memory copy of the result", "x", 0.2, 1.0),
    Metric("assemble.stream", "`scan` to a PLY, over writing the same bytes", "x", 0.4),
    Metric("assemble.stream_mb", "largest memory of that process", "MB", 0.2),
    Metric("files.pcd_write", "binary PCD written, over np.save", "x", 0.4, 1.5),
    Metric("files.pcd_read", "binary PCD read, over np.load", "x", 0.4, 1.5),
    Metric("files.ply_write", "PLY written, over np.save", "x", 0.4, 3.0),
    Metric("files.ply_read", "PLY read, over np.load", "x", 0.4, 3.0),
    Metric("files.laz_write", "LAZ written, over laspy's own", "x", 0.3),
    Metric("files.laz_read", "LAZ read, over laspy's own", "x", 0.3),
    # The world
    Metric("world.reading", "`calibrate` of 120 HDL-32 frames, over reading them", "x", 0.3, 2.0, bound=_FRAMES),
    Metric("world.find", "of it, finding the target", "x", 0.3),
    Metric("world.cut", "of it, reading all frames and cutting the target out, on all cores", "x", 0.3),
    Metric("world.least", "what cannot be left out: read, cut, select and fit once, all known before", "x", 0.3),
    Metric("world.estimate", "of it, the estimate and its verdict", "x", 0.3),
    Metric("world.kernels", "the same in a process that runs on and has loaded its kernels", "x", 0.3),
    Metric("world.kernels_find", "of that, finding the target", "x", 0.3),
    Metric("world.kernels_cut", "of that, reading all frames and cutting the target out, on all cores", "x", 0.3),
    Metric("world.kernels_estimate", "of that, the estimate and its verdict", "x", 0.3),
    Metric("world.find_least", "of finding, a frame of each place read and what moved told, by kernels", "x", 0.3),
    Metric("world.cut_least", "of cutting, the files' bytes alone, on all cores", "x", 0.3),
    Metric("world.kernels_least", "what cannot be left out, by kernels", "x", 0.3),
    Metric("world.open3d_reading", "`calibrate` of them, over Open3D's reading of the same files", "x", 0.4),
    Metric(
        "world.process",
        "the whole command on these frames, over a new process that only reads them",
        "x",
        0.3,
        2.0,
        bound=_FRAMES_COMMAND,
    ),
    Metric("world.process_plain", "the same with `--no-report`", "x", 0.3, 2.0, bound=_FRAMES_COMMAND),
    Metric("world.process_open3d", "the whole command, over a new process that only reads them with Open3D", "x", 0.3),
    # Growth
    _exponent("growth.places_s", "exponent of calibrate's processor time over places"),
    _exponent("growth.places_mb", "exponent of its memory over places"),
    _exponent("growth.frames_s", "exponent of the world job's processor time over frames"),
    _exponent("growth.frames_mb", "exponent of its memory over frames"),
    _exponent("growth.points_s", "exponent of plane segmentation's processor time over points"),
    _exponent("growth.points_mb", "exponent of its memory over points, from where a tenth of the largest is taken"),
    Metric("growth.points_bytes", "its memory a point of five million, beside the cloud", "bytes", 0.1, 36.0),
    # Accuracy, on simulated observations: seeded, so that only rounding may differ from run to run
    Metric("turntable.joint_mm", "joint estimate's centre, over the Cramer-Rao bound", "x", 0.02, 1.1),
    Metric("turntable.joint_deg", "its rotation, over the Cramer-Rao bound", "x", 0.02, 1.1),
    Metric("turntable.paper_mm", "closed form's centre, over the Cramer-Rao bound", "x", 0.02),
    Metric("turntable.blind_mm", "joint estimate without the stripe, over the bound without it", "x", 0.02),
    Metric(
        "turntable.peer_mm",
        "best of the literature's methods without a stripe: centre, over the Cramer-Rao bound",
        "x",
        0.2,
    ),
    Metric("corner.joint_deg", "world pose's rotation, one frame a place, over the Cramer-Rao bound", "x", 0.02, 1.3),
    Metric("corner.joint_mm", "its position, over the Cramer-Rao bound", "x", 0.02, 1.3),
    Metric("corner.paper_mm", "the corner paper's method from the same frames", "x", 0.02),
    Metric("corner.peer_mm", "best peer's position from the same frames", "x", 0.02),
)

BY_KEY = {metric.key: metric for metric in METRICS}
