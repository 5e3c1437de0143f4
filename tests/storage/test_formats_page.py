"""docs/formats.md names a test for each format and limit: they exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")


def all_tests() -> set[str]:
    """Names of all test functions of the project."""
    found = set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found |= {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    return found


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`(test_\w+)`", PAGE))))
def test_a_named_test_exists(name: str) -> None:
    assert name in all_tests()


@pytest.mark.parametrize("name", sorted(set(re.findall(r"tests/[\w/]+\.py", PAGE))))
def test_a_named_file_exists(name: str) -> None:
    assert (ROOT / name).is_file()


def test_every_format_of_the_table_names_its_test() -> None:
    tables = [line for line in PAGE.splitlines() if line.startswith("| ") and "test_" in line]
    assert len(tables) > 15
    for suffix in (".ply", ".pcd", ".las", ".laz", ".e57", ".npy", ".xyz"):
        assert any(f"`{suffix}`" in line for line in tables), suffix
