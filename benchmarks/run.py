"""All benchmarks by one command: every suite in a process of its own, one JSON, one page.

    python -m benchmarks.run [--quick] [--only SUITE ...] [--write] [--compare docs/benchmarks.json]

Without `--write` the page goes to standard output. `--only` with `--write` keeps the other suites' results as they are.
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
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from benchmarks.metrics import BY_KEY
from benchmarks.page import drawings, measured, page
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


def compare(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Figures that differ by more than their tolerance."""
    old, new = measured(before), measured(now)
    out = []
    for key in sorted(old.keys() & new.keys()):
        metric = BY_KEY[key]
        if not metric.agrees(old[key], new[key]):
            out.append(f"{key}: {old[key]:.3g} before, {new[key]:.3g} now; tolerance {100 * metric.tolerance:.0f} %")
    return out


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
    results = everything(options.only or SUITES, options.quick, options.write)
    if options.compare:
        different = compare(json.loads(options.compare.read_text(encoding="utf-8")), results)
        print("\n".join(different) or "every figure is within its tolerance")
    elif not options.write:
        print(page(results))
    if any(suite.get("failed") for suite in results["suites"].values()):
        sys.exit(1)


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
