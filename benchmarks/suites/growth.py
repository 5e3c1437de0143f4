"""How processor time and memory grow with the work: places, frames, points.

Exponents by least squares over the logarithms.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from benchmarks.calibrate import simulate
from benchmarks.report import Curve, Effort, Report, Table
from benchmarks.timing import exponent, in_child
from lidarpose.simulate.corner_scene import CornerSceneSpec, simulate_corner_session
from lidarpose.storage.corner_session import write_corner_session

SIZES = {
    "places": (11, 22, 44, 87),
    "frames": (12, 30, 60, 120),
    "points": (60_000, 200_000, 700_000, 2_000_000, 3_200_000, 5_000_000),
    "assembled": (1_000_000, 4_000_000, 16_000_000),
    "written": (300_000, 1_500_000, 7_500_000),
}
ROUNDS = {"places": 3, "frames": 9, "points": 5, "assembled": 5, "written": 5}
# How places fall to processes differs from run to run, and what each of them holds at its peak with it.
MEMORY_RUNS = {"places": 5}
LEAST_MB = 1.0
# What takes less than this, or than this share of what the largest size takes, is found in memory that the process has
# in stock, and says nothing of growth.
STOCK_MB, STOCK_SHARE = 5.0, 0.1
WORK = {
    "places": "`calibrate`, turntable, places",
    "frames": "`calibrate`, world, frames",
    "points": "three planes of a cloud, points",
    "assembled": "assembling in memory, points",
    "written": "a PLY written, points",
}


def run(effort: Effort) -> Report:
    sizes = SIZES if not effort.quick else {"places": (6, 12), "frames": (6, 12), "points": SIZES["points"][:2]}
    with tempfile.TemporaryDirectory() as temporary:
        turntable, world = Path(temporary) / "turntable", Path(temporary) / "world"
        simulate(turntable, sizes["places"][-1])
        session, _ = simulate_corner_session(CornerSceneSpec(pose="1", frames=sizes["frames"][-1] // 6, seed=1))
        write_corner_session(world, session)
        sessions = {"places": turntable, "frames": world}
        rounds, peaks = {}, {}
        for name, values in sizes.items():
            where = str(sessions.get(name, "."))
            listed = ",".join(map(str, values))
            rounds[name] = in_child(
                "benchmarks.growing", "time", name, listed, where, str(effort.pick(ROUNDS[name], 1))
            )
            peaks[name] = [
                median(
                    in_child("benchmarks.growing", "memory", name, str(size), where)
                    for _ in range(effort.pick(MEMORY_RUNS.get(name, 1), 1))
                )
                for size in values
            ]
    figures: dict[str, float] = {}
    rows: list[list[object]] = []
    curves = []
    for name, values in sizes.items():
        seconds, memory = [median(one) for one in zip(*rounds[name], strict=True)], peaks[name]
        # Of each round by itself: its sizes ran one after the other, on a machine of one speed.
        of_time = median(exponent(values, one) for one in rounds[name])
        of_memory, first_told = memory_exponent(values, memory)
        if name in ("places", "frames", "points"):
            figures |= {f"growth.{name}_s": of_time, f"growth.{name}_mb": of_memory}
        if name == "points":
            figures["growth.points_bytes"] = 1e6 * memory[-1] / values[-1]
        # Of next to nothing an exponent says nothing.
        told = (f"{of_memory:.2f}", f"{first_told} to {values[-1]}") if memory[-1] > LEAST_MB else ("-", "-")
        row = [WORK[name], f"{values[0]} to {values[-1]}", seconds[-1], f"{of_time:.2f}", memory[-1], *told]
        rows.append(row)
        curves.append(
            Curve(
                f"growth-{name}",
                f"Growth: {WORK[name]}",
                WORK[name].rpartition(", ")[2],
                "processor seconds, and MB beside them",
                values,
                {"processor seconds": seconds, "MB above the input": memory},
            )
        )
    columns = ["work", "sizes", "processor s at the last", "exponent", "MB at the last", "exponent", "over sizes"]
    return Report(figures, [Table("Growth", columns, rows, _TEXT)], curves)


def memory_exponent(sizes: Sequence[int], memory: Sequence[float]) -> tuple[float, int]:
    """The exponent over those of the sizes, in ascending order, that take more than what a process has in stock, and
    the least of these; over all if they are fewer than two."""
    least = max(STOCK_MB, STOCK_SHARE * memory[-1])
    told = [(size, mb) for size, mb in zip(sizes, memory, strict=True) if mb > least]
    if len(told) < 2:
        told = list(zip(sizes, memory, strict=True))
    return exponent(*zip(*told, strict=True)), told[0][0]


_TEXT = (
    "Processor time of all cores, all sizes in turn in one warm process; the exponent is the median of those of the "
    "rounds. Memory: each size in a process of its own, after a small one of the same kind, how far the process rises "
    "above where it stood with its input in place (the turntable's and the world's input are files); its exponent is "
    "over the sizes named last: those that take less than 5 MB, or than a tenth of the largest, are found in what the "
    "process has in stock. Of places the median of five runs, as they are shared by processes."
)
