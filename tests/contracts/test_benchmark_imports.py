"""Benchmarks run seldom: what they import from the packages must be there all the same."""

import ast
import shlex
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
PACKAGES = ("fleetmap", "mapserver", "locclient", "fleetsim")


@pytest.mark.parametrize(
    "path", sorted(BENCHMARKS.rglob("*.py")), ids=lambda path: path.relative_to(BENCHMARKS).as_posix()
)
def test_a_benchmark_imports_what_exists(path: Path) -> None:
    froms = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
    missing = []
    for node in froms:
        if node.level or node.module is None or node.module.split(".")[0] not in PACKAGES:
            continue
        module = import_module(node.module)
        for alias in node.names:
            if not hasattr(module, alias.name):
                try:
                    import_module(f"{node.module}.{alias.name}")
                except ModuleNotFoundError:
                    missing.append(f"{node.module}.{alias.name}")
    assert missing == []


def test_every_entry_of_the_acceptance_file_names_a_program() -> None:
    tests = BENCHMARKS.parent
    entries = tomllib.loads((tests / "acceptance.toml").read_text("utf-8"))
    programs = [tests.parent / shlex.split(entry["command"])[0] for entry in entries.values()]
    assert [str(path) for path in programs if not path.is_file()] == []
    assert all("--out {out}" in entry["command"] for entry in entries.values())
