"""Make the pictures of docs/gallery.md and of the README: simulate, calibrate, measure, open the pages, photograph.

    make gallery

Needs Chromium. Everything else is made up from seeds, so that the same version gives the same pages.
"""

from __future__ import annotations

import csv
import shutil
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
MOST_BYTES = 300_000
sys.path.insert(0, str(ROOT / "tests"))

from lidarpose.cli.main import run  # noqa: E402
from tests_support.browser import Browser, Page, find_browser  # noqa: E402

# Where a picture's part of the page is: from one element to another, with some air around.
_BOX = """
(() => {
  const heads = [...document.querySelectorAll("h1, h2, h3")];
  const find = (t) => "#.".includes(t[0]) ? document.querySelector(t)
    : heads.find((e) => e.textContent.startsWith(t)).closest("figure, .card, section");
  const a = find(%s).getBoundingClientRect(), b = find(%s).getBoundingClientRect();
  const left = Math.max(0, Math.min(a.left, b.left) - 14), top = Math.max(0, a.top + scrollY - 14);
  const right = Math.min(innerWidth, Math.max(a.right, b.right) + 14);
  return {x: left, y: top, width: right - left, height: b.bottom + scrollY + 14 - top};
})()
"""


def main() -> None:
    program = find_browser()
    if program is None:
        sys.exit("no Chromium on the path (Debian's package is called chromium)")
    folder = Path(tempfile.mkdtemp(prefix="lidarpose-gallery-"))
    try:
        pages = make_pages(folder)
        IMAGES.mkdir(exist_ok=True)
        with Browser(program) as browser:
            photograph(browser, pages)
    finally:
        shutil.rmtree(folder)


def make_pages(folder: Path) -> dict[str, Path]:
    """The reports, made by the commands that a user would type."""
    command("simulate", "turntable", folder / "turntable", "--seed", 5)
    command("calibrate", folder / "turntable", "-o", folder / "turntable-result")
    mix_up_readings(folder / "turntable" / "positions.csv")
    command("calibrate", folder / "turntable", "-o", folder / "doubtful", "--any-order")
    command("simulate", "corners", folder / "corners", "--frames", 10, "--seed", 1)
    command("calibrate", folder / "corners", "-o", folder / "world")
    command("simulate", "disk", folder / "disk", "--seed", 1)
    report = folder / "disk.html"
    command("measure", "disk", folder / "disk", folder / "disk.calibration.json", "--report", report)
    pages = {name: folder / name / "report.html" for name in ("turntable-result", "doubtful", "world")}
    return {**pages, "disk": report}


def command(*arguments: object, expected: int = 0) -> None:
    status = run([str(a) for a in arguments])
    if status != expected:
        sys.exit(f"lidarpose {' '.join(map(str, arguments))} ended with status {status}, expected {expected}")


def mix_up_readings(positions: Path) -> None:
    """The mistake of a tired afternoon: from the 20th place on every reading stands one row too low."""
    with positions.open(newline="") as file:
        rows = list(csv.DictReader(file))
    readings = [row["turntable_angle_deg"] for row in rows]
    for k in range(20, len(rows)):
        rows[k]["turntable_angle_deg"] = readings[k - 1]
    with positions.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


def photograph(browser: Browser, pages: dict[str, Path]) -> None:
    good = browser.open(pages["turntable-result"], width=1180, height=900)
    part(good, "report", ".top", ".controls", scale=0.8)
    part(good, "rig", "Camera, board", "Camera, board")
    part(good, "board", "The board as the camera", "The board as the camera", scale=0.55)
    part(good, "scan", "The scan of place", "The same scan")
    part(good, "residuals", "Residuals of the stripe", "Ranges", scale=0.8)
    part(good, "uncertainty", "Centre of the LiDAR", "A scanned point")
    good.close()
    for name, page, first, last in (
        ("doubtful", "doubtful", ".top", ".tiles"),
        ("world", "world", ".top", ".controls"),
        ("faces", "world", "Place ", "Residuals of the corners"),
        ("disk", "disk", ".top", "Beams and circle"),
    ):
        opened = browser.open(pages[page], width=1180, height=900)
        part(opened, name, first, last, scale=0.8)
        opened.close()
    phone = browser.open(pages["turntable-result"], width=390, height=844, dark=True)
    save("phone", phone.screenshot({"x": 0, "y": 0, "width": 390, "height": 1180}, scale=0.9))
    phone.close()


def part(page: Page, name: str, first: str, last: str, scale: float = 1.0) -> None:
    save(name, page.screenshot(page.run(_BOX % (repr(first), repr(last))), scale=scale))


def save(name: str, picture: bytes) -> None:
    if len(picture) > MOST_BYTES:
        sys.exit(f"{name}.png has {len(picture)} bytes, more than {MOST_BYTES}")
    (IMAGES / f"{name}.png").write_bytes(picture)
    print(f"docs/images/{name}.png  {len(picture) // 1024} kB")


if __name__ == "__main__":
    main()
