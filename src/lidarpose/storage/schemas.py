"""Schemas of documents as pydantic models; the first violation becomes an InputError that names the key."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from lidarpose.errors import InputError
from lidarpose.storage.documents import shown


class Schema(BaseModel):
    """Base of the file schemas: unknown keys, NaN and infinity are errors; numbers are numbers, not text."""

    # Validators are built at first use: a command needs few of them.
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, strict=True, defer_build=True)


S = TypeVar("S", bound=BaseModel)


def parse(path: Path, schema: type[S], document: Any) -> S:
    """Check a document against its schema; the first violation becomes an InputError naming the key."""
    try:
        return schema.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in first["loc"]) or "the document"
        kind, limits = first["type"], first.get("ctx", {})
        if kind in ("too_short", "too_long"):
            least_or_most = f"least {limits['min_length']}" if kind == "too_short" else f"most {limits['max_length']}"
            count = limits["actual_length"]
            raise InputError(path, f"has {count}", field=field, expected=f"at {least_or_most}") from None
        found = "" if kind in ("missing", "extra_forbidden") else f", found {shown(first['input'])}"
        message = {"missing": "is missing", "extra_forbidden": "is not a known key"}.get(kind, first["msg"])
        raise InputError(path, f"{message}{found}", field=field) from None
