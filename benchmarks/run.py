"""All benchmarks by one command: every suite in a process of its own, one JSON, one page.

    python -m benchmarks.run [--quick] [--only SUITE ...] [--write] [--compare docs/benchmarks.json]

Without `--write` the page goes to standard output. `--only` with `--write` keeps the other suites' results as they are.
`--compare` prints what differs by more than its tolerance; the exit status is 1 where a figure is worse.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from benchmarks.metrics import BY_KEY
from benchmarks.page import busy, drawings, measured, page
from benchmarks.report import Effort, Report

SUITES = (
    "starting",
    "calibrating",
    "detecting",
    "plane_search",
    "normals",
    "assembling",
    "files",
    "world_frames",
    "growth",
    "turntable_methods",
    "corner_methods",
    "paper_tables",
)
DOCS = Path(__file__).parent.parent / "docs"
NAMED = ("numpy", "scipy", "opencv-python-headless", "numba", "open3d", "pyransac3d", "small-gicp", "laspy", "plyfile")


def machine() -> dict[str, Any]:
    """What the figures depend on, without a name or a path."""
    versions = {"Python": platform.python_version()}
    for name in NAMED:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return {"cores": os.cpu_count(), "load": round(os.getloadavg()[0], 1), "versions": versions}


def run_suite(name: str, quick: bool) -> dict[str, Any]:
    """One suite in a new process."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.json"
        command = [sys.executable, "-m", "benchmarks.run", "--suite", name, "--json", str(out)]
        begin, before = time.perf_counter(), _children_cpu_s()
        status = subprocess.run([*command, *(["--quick"] if quick else [])]).returncode
        result: dict[str, Any] = json.loads(out.read_text()) if status == 0 else _failed(name)
    result["seconds"] = round(time.perf_counter() - begin, 1)
    result["cpu_seconds"] = round(_children_cpu_s() - before, 1)
    unknown = set(result["figures"]) - set(BY_KEY)
    if unknown:
        raise KeyError(f"{name} measures what the list does not name: {sorted(unknown)}")
    return result


def _children_cpu_s() -> float:
    """CPU time of all processes that this one has started and that have ended, theirs included."""
    times = os.times()
    return times.children_user + times.children_system


def _failed(name: str) -> dict[str, Any]:
    """What the page says of a suite that broke off; the others go on."""
    report = Report({}, notes=[f"**The suite `{name}` broke off.**"])
    return {**report.as_json(), "failed": True}


@dataclass(frozen=True)
class Comparison:
    """Two runs side by side: figures that differ by more than their tolerance, those that only one run has, and those
    that are seconds of a busy machine; in words, but for the number of figures that agree."""

    agree: int
    better: list[str]
    worse: list[str]
    alone: list[str]
    unjudged: list[str]

    def lines(self) -> list[str]:
        """For the terminal."""
        parts = (
            ("Worse", self.worse),
            ("Better", self.better),
            ("Not compared, for one of the machines was busy", self.unjudged),
            ("Measured in one of the runs only", self.alone),
        )
        lines = [line for title, found in parts if found for line in (f"{title}:", *(f"  {one}" for one in found))]
        judged = self.agree + len(self.better) + len(self.worse)
        return [*lines, f"{self.agree} of {judged} figures are the same within their tolerances."]


def compare(before: dict[str, Any], now: dict[str, Any]) -> Comparison:
    """Hold a run against an earlier one. Raises ValueError where one was quick and the other was not."""
    if before["quick"] != now["quick"]:
        raise ValueError("a quick run and a whole one measure different sizes")
    old, new = measured(before), measured(now)
    suites = before["suites"].keys() & now["suites"].keys()
    asked = {key for run in (before, now) for name in suites for key in run["suites"][name]["figures"]}
    agree = 0
    better: list[str] = []
    worse: list[str] = []
    unjudged: list[str] = []
    for key in sorted(old.keys() & new.keys()):
        metric = BY_KEY[key]
        line = f"{key}: {old[key]:.3g} before, {new[key]:.3g} now; tolerance {metric.tolerance_text}"
        if metric.unit in ("s", "ms"):
            slower = _slower(before, now, key)
            new[key] /= slower
            line += f", held against each other on a machine {slower:.2f} times as slow"
        if metric.unit in ("s", "ms") and (busy(before) or busy(now)):
            unjudged.append(line)
        elif metric.agrees(old[key], new[key]):
            agree += 1
        else:
            (better if (new[key] < old[key]) == (metric.better == "lower") else worse).append(line)
    alone = [f"{key}: {'before' if key in old else 'now'}" for key in sorted(asked & (old.keys() ^ new.keys()))]
    return Comparison(agree, better, worse, alone, unjudged)


def _slower(before: dict[str, Any], now: dict[str, Any], key: str) -> float:
    """How many times as long the fixed piece of work took in the suite of a figure; 1 where a run did not time it."""
    runs = (before, now)
    suites = [next(suite for suite in run["suites"].values() if key in suite["figures"]) for run in runs]
    first, second = (suite.get("pace_s") for suite in suites)
    return second / first if first and second else 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small sizes and few repeats")
    parser.add_argument("--only", nargs="+", choices=SUITES, default=[])
    parser.add_argument("--write", action="store_true", help="write docs/benchmarks.json, .md and the drawings")
    parser.add_argument("--compare", type=Path, metavar="JSON", help="say which figures differ from an earlier run")
    parser.add_argument("--suite", choices=SUITES, help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.suite:
        report = import_module(f"benchmarks.suites.{options.suite}").run(Effort(options.quick))
        options.json.write_text(json.dumps(report.as_json()))
        return
    # Read now: --write may replace it.
    before = json.loads(options.compare.read_text(encoding="utf-8")) if options.compare else None
    if before is not None and before["quick"] != options.quick:
        parser.error(f"{options.compare} is of a {'quick' if before['quick'] else 'whole'} run, this one would not be")
    results = everything(options.only or SUITES, options.quick, options.write)
    failed = any(suite.get("failed") for suite in results["suites"].values())
    if before is not None:
        comparison = compare(before, results)
        print("\n".join(comparison.lines()))
        failed |= bool(comparison.worse)
    elif not options.write:
        print(page(results))
    sys.exit(int(failed))


def everything(names: tuple[str, ...] | list[str], quick: bool, write: bool) -> dict[str, Any]:
    """Run suites one after the other; after each, the files are up to date if they are wanted."""
    stored = DOCS / "benchmarks.json"
    keep: dict[str, Any] = {}
    before = machine()  # what else it does is seen before the first suite loads it
    if write and len(names) < len(SUITES) and stored.exists():
        keep = json.loads(stored.read_text(encoding="utf-8"))["suites"]
    for name in names:
        print(f"{name} ...", end=" ", file=sys.stderr, flush=True)
        keep[name] = run_suite(name, quick)
        took = keep[name]
        print(f"{took['seconds']:.0f} s, {took['cpu_seconds']:.0f} s of CPU", file=sys.stderr, flush=True)
        results = {"machine": before, "quick": quick, "suites": {n: keep[n] for n in SUITES if n in keep}}
        if write:
            stored.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
            (DOCS / "benchmarks.md").write_text(page(results), encoding="utf-8")
            drawings(results, DOCS / "images")
    return results


if __name__ == "__main__":
    main()
