"""TOML, YAML and JSON documents, read within bounds, with errors that name file and key."""

from __future__ import annotations

import json
import re
import reprlib
import tomllib
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

from lidarpose.errors import InputError

MAX_DOCUMENT_BYTES = 8 * 2**20
"""Of JSON, which may list the files of a session; its parser takes 50 times as much memory at worst."""
MAX_YAML_BYTES = 2**16
"""Camera files have a few kB. The parser needs up to 2 s for 64 kB of the worst that can be written in YAML."""
MAX_TOML_BYTES = 2**16
MAX_XML_BYTES = 2**18
_MAX_DOTS = 256


def read_text(path: Path, what: str, limit: int = MAX_DOCUMENT_BYTES) -> str:
    """The text of a small UTF-8 file. Raises InputError if it is missing, larger than `limit` bytes, or not text."""
    try:
        if not path.is_file():
            problem = "is a folder" if path.is_dir() else "is not a regular file" if path.exists() else "is missing"
            raise InputError(path, problem, expected=what)
        if path.stat().st_size > limit:
            raise InputError(path, f"is larger than {limit // 2**10} kB", expected=what)
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(path, f"byte {error.start} is not UTF-8 text", expected=what) from error
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror or error}", expected=what) from error


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML document."""
    text = read_text(path, "a TOML file", MAX_TOML_BYTES)
    # The parser remembers every beginning of a dotted key, which is the square of its length.
    if max(part.count(".") for part in re.split(r"[=\n\[\],{}]", text)) > _MAX_DOTS:
        raise InputError(path, f"has a key of more than {_MAX_DOTS} parts", expected="a TOML file")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"is not valid TOML: {error}") from error


def read_yaml(path: Path) -> Any:
    """A YAML 1.2 document: 1e-3 is a number, 010 is ten, equal keys are an error, and nothing is executed."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    text = read_text(path, "a camera's YAML file", MAX_YAML_BYTES)
    if text.startswith("%YAML:"):
        # OpenCV writes "%YAML:1.0", which no YAML parser takes for a directive.
        text = text.partition("\n")[2]
    yaml = YAML(typ="safe", pure=True)
    yaml.Constructor, yaml.Composer = _yaml_constructor(), _yaml_composer()
    try:
        return yaml.load(text)
    except (YAMLError, ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        first = next(iter(str(error).strip().splitlines()), "unreadable")
        mark = getattr(error, "problem_mark", None)
        field = f"line {mark.line + 1}" if mark is not None else None
        raise InputError(path, f"is not valid YAML: {first}", field=field) from error


@cache
def _yaml_constructor() -> Any:
    """ruamel's safe constructor, to which OpenCV's matrices are mappings; every other tag is an error."""
    from ruamel.yaml.constructor import SafeConstructor

    # Made by `type`: ruamel states no types to inherit from.
    Constructor: Any = type("Constructor", (SafeConstructor,), {})
    Constructor.add_constructor("tag:yaml.org,2002:opencv-matrix", SafeConstructor.construct_yaml_map)
    return Constructor


@cache
def _yaml_composer() -> Any:
    """ruamel's composer without aliases: a few lines of them stand for more than any memory holds."""
    from ruamel.yaml.composer import Composer
    from ruamel.yaml.events import AliasEvent

    def compose_node(self: Any, parent: Any, index: Any) -> Any:
        if self.parser.check_event(AliasEvent):
            raise ValueError("it has an alias, which files of cameras do not need")
        return Composer.compose_node(self, parent, index)

    return type("Plain", (Composer,), {"compose_node": compose_node})


def read_opencv_xml(path: Path) -> dict[str, Any]:
    """OpenCV's FileStorage as XML: matrices as mappings with rows, cols and data, else numbers or text.

    Document types and entities, which can expand without bounds or name other files, are refused.
    """
    from xml.etree import ElementTree

    text = read_text(path, "an OpenCV XML file", MAX_XML_BYTES)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(path, "has a document type", expected="plain XML without <!DOCTYPE and <!ENTITY")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(path, f"is not valid XML: {error}") from error
    if root.tag != "opencv_storage":
        raise InputError(path, f"starts with <{root.tag[:40]}>", expected="<opencv_storage>")
    return {child.tag: _opencv_value(child) for child in root}


def _opencv_value(element: Any) -> Any:
    data = element.find("data")
    if data is not None:
        sizes = {key: _plain_value(element.findtext(key) or "") for key in ("rows", "cols")}
        return {**sizes, "data": [_plain_value(word) for word in (data.text or "").split()]}
    words = (element.text or "").split()
    return _plain_value(words[0]) if len(words) == 1 else [_plain_value(word) for word in words]


def _plain_value(word: str) -> int | float | str:
    word = word.strip()
    for kind in (int, float):
        try:
            return kind(word)
        except ValueError:
            continue
    return word.strip('"')


def read_json(path: Path, what: str = "a JSON file") -> Any:
    """A JSON document without NaN or infinity, which JSON does not have, and without equal keys."""

    def refuse_constant(name: str) -> NoReturn:
        raise ValueError(f"{name} is not JSON")

    def refuse_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        if len(set(keys)) != len(keys):
            twin = next(key for key in keys if keys.count(key) > 1)
            raise ValueError(f"the key {twin!r} stands twice")
        return dict(pairs)

    text = read_text(path, what)
    if not text.strip():
        raise InputError(path, "is empty", expected=what)
    try:
        return json.loads(text, parse_constant=refuse_constant, object_pairs_hook=refuse_twins)
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"is not valid JSON: {error}", expected=what) from error


def check_format(path: Path, document: Any, expected: str) -> dict[str, Any]:
    """The document as a mapping, if its `format` says what is expected. Raises InputError otherwise."""
    if not isinstance(document, dict):
        raise InputError(path, "holds no keys", expected=f'format = "{expected}"')
    found = document.get("format")
    if found != expected:
        problem = "is missing" if found is None else f"is {shown(found)}"
        name, _, version = expected.partition("@")
        newer = isinstance(found, str) and found.startswith(name + "@")
        remedy = f"This version of lidarpose reads {name} version {version} only." if newer else None
        raise InputError(path, problem, field="format", expected=f'"{expected}"', remedy=remedy)
    return document


def shown(value: Any) -> str:
    """A value as messages show it: not longer than a line, whatever it holds."""
    text = reprlib.repr(value) if not isinstance(value, str) else repr(value[:100])
    return text if len(text) <= 60 else text[:57] + "..."
