"""TOML, YAML and JSON documents: read within bounds, checked against a schema, with errors that name file and key."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from lidarpose.errors import InputError

MAX_DOCUMENT_BYTES = 16 * 2**20


class Schema(BaseModel):
    """Base of the file schemas: unknown keys, NaN and infinity are errors; numbers are numbers, not text."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, strict=True)


S = TypeVar("S", bound=BaseModel)


def read_text(path: Path, what: str) -> str:
    """The text of a small UTF-8 file. Raises InputError if it is missing, too large, or not text."""
    try:
        if path.is_dir() or not path.exists():
            raise InputError(path, "is missing" if not path.exists() else "is a folder", expected=what)
        if path.stat().st_size > MAX_DOCUMENT_BYTES:
            raise InputError(path, f"is larger than {MAX_DOCUMENT_BYTES // 2**20} MB", expected=what)
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(path, f"byte {error.start} is not UTF-8 text", expected=what) from error
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror or error}", expected=what) from error


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML document."""
    try:
        return tomllib.loads(read_text(path, "a TOML file"))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(path, f"is not valid TOML: {error}") from error


def read_yaml(path: Path) -> Any:
    """A YAML 1.2 document: 1e-3 is a number, 010 is ten, equal keys are an error, and nothing is executed."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    text = read_text(path, "a YAML file")
    if text.startswith("%YAML:"):
        # OpenCV writes "%YAML:1.0", which no YAML parser takes for a directive.
        text = text.partition("\n")[2]
    try:
        return YAML(typ="safe", pure=True).load(text)
    except (YAMLError, ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        first = next(iter(str(error).strip().splitlines()), "unreadable")
        mark = getattr(error, "problem_mark", None)
        field = f"line {mark.line + 1}" if mark is not None else None
        raise InputError(path, f"is not valid YAML: {first}", field=field) from error


def read_json(path: Path) -> Any:
    """A JSON document without NaN or infinity, which JSON does not have, and without equal keys."""

    def refuse_constant(name: str) -> NoReturn:
        raise ValueError(f"{name} is not JSON")

    def refuse_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        if len(set(keys)) != len(keys):
            twin = next(key for key in keys if keys.count(key) > 1)
            raise ValueError(f"the key {twin!r} stands twice")
        return dict(pairs)

    text = read_text(path, "a JSON file")
    try:
        return json.loads(text, parse_constant=refuse_constant, object_pairs_hook=refuse_twins)
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"is not valid JSON: {error}") from error


def check_format(path: Path, document: Any, expected: str) -> dict[str, Any]:
    """The document as a mapping, if its `format` says what is expected. Raises InputError otherwise."""
    if not isinstance(document, dict):
        raise InputError(path, "holds no keys", expected=f'format = "{expected}"')
    found = document.get("format")
    if found != expected:
        problem = "is missing" if found is None else f"is {found!r}"
        name, _, version = expected.partition("@")
        newer = isinstance(found, str) and found.startswith(name + "@")
        remedy = f"This version of lidarpose reads {name} version {version} only." if newer else None
        raise InputError(path, problem, field="format", expected=f'"{expected}"', remedy=remedy)
    return document


def parse(path: Path, schema: type[S], document: Any) -> S:
    """Check a document against its schema; the first violation becomes an InputError naming the key."""
    try:
        return schema.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in first["loc"]) or "the document"
        found = "" if first["type"] in ("missing", "extra_forbidden") else f", found {_shown(first['input'])}"
        message = {"missing": "is missing", "extra_forbidden": "is not a known key"}.get(first["type"], first["msg"])
        raise InputError(path, f"{message}{found}", field=field) from None


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
