"""What a finished page must satisfy in a browser, whatever it shows."""

from __future__ import annotations

from typing import Any

from tests_support.browser import Page

# Text of drawings: pairs that overlap, and pieces that leave their drawing. Hidden variants have no boxes.
_TEXT_TROUBLE = """
(() => {
  const out = [];
  for (const svg of document.querySelectorAll("svg")) {
    const frame = svg.getBoundingClientRect();
    if (!frame.width) continue;
    const texts = [...svg.querySelectorAll("text")].map((t) => [t.textContent, t.getBoundingClientRect()]);
    for (const [name, box] of texts) {
      if (box.left < frame.left - 1 || box.right > frame.right + 1 || box.top < frame.top - 1
          || box.bottom > frame.bottom + 1) out.push("cut off: " + name + " in " + svg.getAttribute("aria-label"));
    }
    for (let i = 0; i < texts.length; i++) for (let j = 0; j < i; j++) {
      const a = texts[i][1], b = texts[j][1];
      if (Math.min(a.right, b.right) - Math.max(a.left, b.left) > 0.5
          && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 2)
        out.push("overlap: " + texts[i][0] + " / " + texts[j][0] + " in " + svg.getAttribute("aria-label"));
    }
  }
  return out;
})()
"""

# Elements wider than their place whose text nobody can scroll to.
_CUT_OFF = """
[...document.querySelectorAll("main *:not(svg *)")].filter((e) => {
  if (e.closest(".scroll") || e.closest("svg")) return false;
  const box = e.getBoundingClientRect();
  return box.width > 0 && (box.right > innerWidth + 1 || box.left < -1 || e.scrollWidth > e.clientWidth + 1)
    && getComputedStyle(e).display !== "inline";
}).map((e) => e.tagName + "." + e.className + ": " + e.textContent.slice(0, 60))
"""

# Cells whose text leaves them.
_CELLS = """
[...document.querySelectorAll("td, th")].filter((cell) => {
  const range = document.createRange();
  range.selectNodeContents(cell);
  const text = range.getBoundingClientRect(), box = cell.getBoundingClientRect();
  return box.width > 0 && text.width > 0 && (text.right > box.right + 1 || text.left < box.left - 1);
}).map((cell) => cell.textContent.slice(0, 60))
"""

# Tables that have to be scrolled sideways to be read.
_SCROLLED = """
[...document.querySelectorAll(".scroll")].filter((e) => e.scrollWidth > e.clientWidth + 1)
  .map((e) => e.textContent.slice(0, 60))
"""

# Every visible drawing has a size and at least one mark beyond its axes.
_FIGURES = """
[...document.querySelectorAll("figure")].map((f) => {
  const drawn = [...f.querySelectorAll("svg[role=img]")].filter((s) => s.getBoundingClientRect().width > 50);
  const marks = drawn.flatMap((s) => [...s.querySelectorAll("path, rect, image")].filter((m) =>
    !m.closest("clipPath") && !["grid", "axis"].includes(m.getAttribute("class"))));
  const canvas = f.querySelector("canvas");
  return [f.querySelector("h3").textContent, canvas ? Number(canvas.dataset.drawn) : marks.length];
})
"""

_INK = """
(() => {
  const c = document.createElement("canvas"), scene = document.getElementById("scene");
  c.width = scene.width;
  c.height = scene.height;
  c.getContext("2d", { willReadFrequently: true }).drawImage(scene, 0, 0);
  const data = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
  let inked = 0, sum = 0;
  for (let k = 3; k < data.length; k += 4) if (data[k] > 40) { inked++; sum = (sum * 31 + k) % 1000000007; }
  return [inked / (c.width * c.height), sum];
})()
"""


def assert_sound(page: Page) -> None:
    """No script error, no request, every figure drawn, no text cut off or on top of other text."""
    assert page.errors == []
    outside = [r for r in page.requests if r != page.url and not r.startswith("data:")]
    assert outside == []
    drawn = page.run(_FIGURES)
    assert drawn
    assert [title for title, marks in drawn if not marks] == []
    assert page.run("document.documentElement.scrollWidth <= innerWidth"), page.run(_CUT_OFF)
    assert page.run(_CUT_OFF) == []
    page.run("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    assert page.run(_CELLS) == []
    assert page.run(_SCROLLED) == []
    assert page.run("document.documentElement.scrollWidth <= innerWidth"), page.run(_CUT_OFF)
    assert page.run(_TEXT_TROUBLE) == []


def scene_ink(page: Page) -> tuple[float, int]:
    """Share of the 3D scene's pixels that are drawn, and a number that changes with the picture."""
    share, mark = page.run(_INK)
    return float(share), int(mark)


def scene_middle(page: Page) -> tuple[float, float]:
    """The middle of the 3D scene in the window, after it was scrolled into view."""
    box: Any = page.run(
        "(() => { const c = document.getElementById('scene'); c.scrollIntoView({block: 'center'});"
        " const b = c.getBoundingClientRect(); return [b.left + b.width / 2, b.top + b.height / 2]; })()"
    )
    return float(box[0]), float(box[1])
