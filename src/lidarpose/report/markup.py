"""HTML and SVG as text that is escaped by construction: only what is `Markup` goes in as it is.

Names come from the user's files and are not to be trusted; whatever is no `Markup` is escaped where it is put in.
"""

from __future__ import annotations

import html
import json
from collections.abc import Iterable

# None leaves an attribute out; True writes it without a value.
AttributeValue = str | float | int | bool | None

_VOID = frozenset({"br", "hr", "img", "input", "link", "meta"})


class Markup(str):
    """Text that is already HTML."""

    __slots__ = ()


def escape(content: object) -> Markup:
    """Content as HTML: `Markup` as it is, anything else as escaped text."""
    return content if isinstance(content, Markup) else Markup(html.escape(str(content)))


def join(parts: Iterable[object], separator: str = "") -> Markup:
    """Parts one after the other, each escaped unless it is `Markup`."""
    return Markup(separator.join(escape(part) for part in parts))


def el(tag: str, *children: object, **attributes: AttributeValue) -> Markup:
    """An element. Attribute names: a trailing underscore is dropped (`class_`), others become hyphens."""
    text = "".join(_attribute(name, value) for name, value in attributes.items())
    if tag in _VOID:
        return Markup(f"<{tag}{text}>")
    return Markup(f"<{tag}{text}>{join(children)}</{tag}>")


def json_script(identity: str, value: object) -> Markup:
    """Data for a script, in a form that no content can break out of. NaN and infinity are refused."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    safe = text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    return Markup(f'<script type="application/json" id="{html.escape(identity)}">{safe}</script>')


def _attribute(name: str, value: AttributeValue) -> str:
    if value is None or value is False:
        return ""
    key = name.rstrip("_").replace("_", "-")
    key = {"viewbox": "viewBox", "preserveaspectratio": "preserveAspectRatio"}.get(key, key)
    if value is True:
        return f" {key}"
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return f' {key}="{html.escape(text)}"'
