"""Benchmarks and studies run seldom: what they import must be there all the same, and every entry of the acceptance file is a program."""

import ast
import shlex
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

from acceptance import compared
from conftest import TESTS

PROGRAMS = sorted(path for folder in ("benchmarks", "studies", "golden") for path in (TESTS / folder).rglob("*.py"))
OURS = ("fleetmap", "mapserver", "locclient", "fleetsim", "benchmarks", "studies", "golden", "support")


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.relative_to(TESTS).as_posix())
def test_a_program_imports_what_exists(path: Path) -> None:
    missing = []
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and not node.level and (node.module or "").split(".")[0] in OURS:
            try:
                module = import_module(node.module)
            except ModuleNotFoundError as error:
                if not (error.name or "").endswith(".plugins"):  # the road alone, without them
                    raise
                pytest.skip(str(error))
            for alias in node.names:
                if not hasattr(module, alias.name):
                    try:
                        import_module(f"{node.module}.{alias.name}")
                    except ModuleNotFoundError:
                        missing.append(f"{node.module}.{alias.name}")
    assert missing == []


@pytest.mark.parametrize("file", ["acceptance.toml", "record.toml"])
def test_every_entry_names_a_program(file: str) -> None:
    listed = tomllib.loads((TESTS / file).read_text("utf-8")).values()
    entries = [entry for entry in listed if isinstance(entry, dict)]
    modules = {shlex.split(entry["command"])[0] for entry in entries}
    assert {name for name in modules if TESTS / f"{name.replace('.', '/')}.py" not in PROGRAMS} == set()
    assert all("--out {out}" in entry["command"] for entry in entries)


def test_a_limit_whose_path_names_no_figure_does_not_hold() -> None:
    """Seen: such a path ended a record of an hour with an exception in its last second."""
    entry = {"at_most": {"*/b_*": 1, "a/c": 1}}
    values = {"a": {"b_1": 0, "b_2": 2}, "d": [{"b_": 1}]}
    assert list(compared(entry, values)) == [
        ("a/b_1", 0, "at_most 1", True),
        ("a/b_2", 2, "at_most 1", False),
        ("a/c", None, "at_most 1", False),
    ]
