"""Assembling a cloud against copying it, and streaming one to a PLY against writing the same bytes."""

from __future__ import annotations

from benchmarks.assemble import first_compiling, in_memory, one_shot, streamed
from benchmarks.report import Effort, Report, Table


def run(effort: Effort) -> Report:
    sweeps, beams = effort.pick(6000, 600), 3240
    memory = in_memory(sweeps, beams, effort.pick(9, 3))
    stream = streamed(effort.pick(50_000_000, 2_000_000), beams, effort.pick(5, 1))
    rates, over = memory["million_points_per_s"], memory["time_over_copy"]
    # Without numba the NumPy way is what a user has.
    figures = {
        "assemble.copy": min(ratio for name, ratio in over.items() if name != "copy"),
        "assemble.stream": stream["ratio"],
        "assemble.stream_mb": stream["memory_mb"],
    }
    rows: list[list[object]] = [[name, rate, over[name]] for name, rate in rates.items()]
    text = f"{memory['points']} points in memory, float32; assembling on all cores, the copy as NumPy makes it."
    # After the runs above have stored the kernels: the same small work with and without them on the disk.
    first, compiling = one_shot(100 * beams, beams)[1], first_compiling(beams)
    if first is None or compiling is None:
        text += " numba is not installed."
    else:
        text += (
            f" The first compiled call of a process takes {first:.2f} s: numba's import, and kernels from the disk. "
            f"The first of all, which compiles and stores them, takes {compiling:.1f} s."
        )
    shots = [[points, *one_shot(points, beams)] for points in (effort.pick(5_000_000, 500_000), sweeps * beams)]
    about = (
        "A new process that makes up a recording and assembles it once: seconds beyond making it up, imports included."
    )
    return Report(
        figures,
        [
            Table("Assembling", ["way", "million points a second", "time over a copy"], rows, text),
            Table("One-shot runs", ["points", "NumPy, s", "compiled, s", "by itself, s"], shots, about),
        ],
    )
