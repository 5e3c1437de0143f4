"""The frame of every report: one HTML file without a single outside reference, and the pieces that all pages share."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, Literal

from lidarpose.report.markup import Markup, el, join, json_script

# Nothing may be fetched, whatever a name in the user's files says.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"

PANEL_CLASSES = ("p1", "p2")
"""Classes of the style sheet for the board's two panels (and for other pairs)."""
FACE_CLASSES = ("p1", "p2", "lidar")
"""Classes of the style sheet for three things: a target's faces, or three axes."""
DESK_WIDE_PX, DESK_HALF_PX, PHONE_PX = 1034.0, 490.0, 336.0

Drawing = Callable[[float], Markup]
"""Draws a figure for a width in pixels."""
Size = Literal["wide", "half", "third"]
"""How much of the column a figure takes on a desktop; on a phone each takes all of it."""
Tone = Literal["good", "doubtful", "rejected", "unknown"]


@dataclass(frozen=True)
class Tile:
    """A figure that matters: what it is, its value and unit, and what it is to be compared with."""

    what: str
    value: str
    unit: str = ""
    than: str = ""
    met: bool | None = None


@dataclass(frozen=True)
class Verdict:
    """The first thing on a page: is this good, why, and what to do."""

    tone: Tone
    headline: str
    say: str
    reasons: Sequence[str] = ()
    todo: Sequence[str] = ()

    @property
    def heading(self) -> str:
        """What stands over the reasons: a good result needs none, and has remarks only."""
        return "To note" if self.tone == "good" else "Why"


def headline(tone: Tone) -> str:
    """What a calibration's verdict says first."""
    return {
        "good": "Good: use this calibration",
        "doubtful": "Doubtful: read the reasons first",
        "rejected": "Rejected: do not use this calibration",
        "unknown": "No verdict",
    }[tone]


def document(title: str, kind: str, body: Iterable[object], scene: Mapping[str, Any] | None = None) -> str:
    """A whole page. `scene` is what the 3D viewer shows, see `lidarpose.report.scene`."""
    scripts: list[Markup] = []
    if scene is not None:
        scripts = [json_script("scene-data", scene), el("script", _asset("scene.js"))]
    head = el(
        "head",
        el("meta", charset="utf-8"),
        el("meta", name="viewport", content="width=device-width, initial-scale=1"),
        el("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        el("link", rel="icon", href="data:,"),
        el("title", f"{title} – {kind}"),
        el("style", _asset("page.css")),
    )
    top = el("div", el("h1", title), el("span", kind, class_="muted"), class_="top")
    content = el("body", el("main", top, *body), *scripts)
    return f"<!doctype html>\n{el('html', head, content, lang='en')}\n"


def verdict_block(verdict: Verdict) -> Markup:
    """The verdict with its reasons and what to do about them."""
    parts: list[Markup] = [
        el("div", _SIGNS[verdict.tone], el("span", verdict.headline), class_="word"),
        el("p", verdict.say, class_="say"),
    ]
    if verdict.reasons:
        parts += [el("h3", verdict.heading), bullets(verdict.reasons)]
    if verdict.todo:
        parts.append(el("div", el("h3", "What to do"), bullets(verdict.todo, ordered=True), class_="todo"))
    return el("section", *parts, class_=f"verdict {verdict.tone}", id="verdict")


def tiles(items: Iterable[Tile]) -> Markup:
    """The figures that matter, side by side."""
    return el("div", *(_tile(item) for item in items), class_="tiles")


def section(title: str, lead: str, *content: object) -> Markup:
    """A headed part of the page; its figures stand in a grid of two columns."""
    return el(
        "section", el("h2", title), el("p", lead, class_="lead") if lead else "", el("div", *content, class_="grid")
    )


def figure(
    title: str, draw: Drawing, caption: str = "", legend: Iterable[Markup] = (), *, size: Size = "half"
) -> Markup:
    """A figure drawn once for a desktop and once for a phone."""
    return picture(title, _drawn(draw, size), caption, legend, size=size)


def _drawn(draw: Drawing, size: Size) -> Markup:
    if size == "third":
        # As wide as a phone's column: one drawing serves both.
        return draw(PHONE_PX)
    desk = draw(DESK_WIDE_PX if size == "wide" else DESK_HALF_PX)
    return join((el("div", desk, class_="desk"), el("div", draw(PHONE_PX), class_="phone")))


def picture(
    title: str, content: Markup, caption: str = "", legend: Iterable[Markup] = (), *, size: Size = "wide"
) -> Markup:
    """A figure without text of its own, which therefore serves every width."""
    keys = list(legend)
    return el(
        "figure",
        el("h3", title),
        el("ul", *keys, class_="legend") if keys else "",
        content,
        el("figcaption", caption) if caption else "",
        class_=size,
    )


def card(title: str, *content: object, size: Size = "wide") -> Markup:
    """A framed part that is not a drawing."""
    return el("div", el("h3", title) if title else "", *content, class_=f"card {size}")


def legend_key(kind: Literal["line", "dash", "dot", "box", "cross"], class_: str, text: str) -> Markup:
    """One entry of a legend: a sign as it is drawn, and what it stands for."""
    signs = {
        "line": el("path", d="M1 6H21", class_=f"line {class_}"),
        "dash": el("path", d="M1 6H21", class_=f"line dash {class_}"),
        "dot": el("path", d="M11 6h0", class_=f"dots {class_}", stroke_width=7),
        "box": el("rect", x=3, y=1, width=16, height=10, class_=f"area {class_}"),
        "cross": el("path", d="M7 2l8 8m0 -8l-8 8", class_=f"line {class_}"),
    }
    return el("li", el("svg", signs[kind], viewbox="0 0 22 12", aria_hidden="true"), el("span", text))


def table(
    header: Sequence[str],
    rows: Iterable[Sequence[object]],
    numeric: Iterable[int] = (),
    *,
    stacked_em: float | None = None,
) -> Markup:
    """A table; columns in `numeric` are set flush right.

    `stacked_em`: on a phone the last column goes below the others, and those between it and the first are so wide.
    """
    right = set(numeric)
    titles = el("tr", *(el("th", h, class_="num" if k in right else None) for k, h in enumerate(header)))
    head = el("thead", titles) if any(header) else ""
    body = [el("tr", *(el("td", c, class_="num" if k in right else None) for k, c in enumerate(row))) for row in rows]
    stacked = stacked_em is not None
    style = f"--columns:{len(header) - 2};--cell:{stacked_em:g}em" if stacked else None
    content = el("table", head, el("tbody", *body), class_="stacked" if stacked else None, style=style)
    return el("div", content, class_="scroll")


def bullets(items: Iterable[object], *, ordered: bool = False) -> Markup:
    return el("ol" if ordered else "ul", *(el("li", item) for item in items))


def folded(summary: str, *content: object, opened: bool = False) -> Markup:
    """Content behind a line that opens it."""
    return el("details", el("summary", summary), *content, open=opened)


def sentence(text: str) -> str:
    """A reason with a capital letter."""
    return text[:1].upper() + text[1:]


def title_of(name: str) -> str:
    """A session's name without the folders above it."""
    return re.split(r"[/\\\\]", name.rstrip("/\\"))[-1] or name


def provenance_block(provenance: Mapping[str, Any]) -> Markup:
    """Everything needed to repeat a run: options and versions in the open, the inputs' hashes folded away."""
    if not provenance:
        return card("", el("p", "The run recorded no provenance.", class_="muted"))
    parts: list[object] = []
    hashes: Mapping[str, Any] = {}
    rows: list[tuple[object, object]] = []
    for key, value in provenance.items():
        if key == "inputs_sha256" and isinstance(value, Mapping):
            hashes = value
        elif isinstance(value, Mapping):
            rows.append((_words(key), join((_setting(k, v) for k, v in value.items()), "<br>")))
        else:
            rows.append((_words(key), el("code", str(value))))
    if rows:
        parts.append(table(("", ""), rows))
    if hashes:
        listed = table(("input", "SHA-256"), ((el("code", k), el("code", str(v))) for k, v in hashes.items()))
        parts.append(folded(f"{len(hashes)} input files with their SHA-256", listed))
    return card("", *parts)


def footer(*content: object) -> Markup:
    return el("footer", *content)


def _setting(key: str, value: object) -> Markup:
    return el("code", f"{key} = {'not given' if value is None else value}")


def _words(key: str) -> str:
    return key.replace("_", " ")


def _tile(item: Tile) -> Markup:
    than_class = "than" if item.met is None else "than met" if item.met else "than miss"
    # A degree sign belongs to its number; other units stand apart, and smaller.
    unit_class = "degree" if item.unit == "°" else "unit"
    return el(
        "div",
        el("div", item.what, class_="what"),
        el("div", item.value, el("span", item.unit, class_=unit_class) if item.unit else "", class_="value"),
        el("div", item.than, class_=than_class) if item.than else "",
        class_="tile",
    )


def _sign(path: str) -> Markup:
    ring = el("circle", cx=17, cy=17, r=15, class_="line")
    return el(
        "svg", ring, el("path", d=path, class_="line", style="stroke-width:3"), viewbox="0 0 34 34", aria_hidden="true"
    )


_SIGNS: dict[Tone, Markup] = {
    "good": _sign("M10 17.5l5 5.5 9.5 -11"),
    "doubtful": _sign("M17 9v10M17 24.2v.3"),
    "rejected": _sign("M11.5 11.5l11 11M22.5 11.5l-11 11"),
    "unknown": _sign("M12.8 13.5c0 -6 8.6 -6 8.6 -.6c0 3.6 -4.4 3.6 -4.4 7M17 24.2v.3"),
}


def _asset(name: str) -> Markup:
    """A style sheet or script of this package, as it is."""
    return Markup(resources.files("lidarpose.report").joinpath("assets", name).read_text(encoding="utf-8"))
