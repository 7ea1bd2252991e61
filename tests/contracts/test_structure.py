"""No module of the project imports itself by way of others."""

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from support.fleet.contracts_documents import REPOSITORY

PACKAGES = {
    "fleetmap": REPOSITORY / "shared" / "fleetmap",
    "fleetsim": REPOSITORY / "shared" / "fleetsim",
    "mapserver": REPOSITORY / "mapserver",
    "locclient": REPOSITORY / "locclient",
}


@cache
def _modules() -> dict[str, Path]:
    found = {}
    for package, folder in PACKAGES.items():
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            found[".".join((package, *(part for part in parts if part != "__init__")))] = path
    return found


def _imports(module: str, path: Path) -> set[str]:
    """The project's modules that this one imports when it is imported; not inside functions, not for types alone."""
    found: set[str] = set()
    pending: list[ast.stmt] = list(ast.parse(path.read_text("utf-8")).body)
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.dump(node.test):
            pending += [*node.body, *node.orelse]
        elif isinstance(node, ast.Try):
            pending += [*node.body, *node.orelse, *(s for handler in node.handlers for s in handler.body)]
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {
                name if (name := f"{node.module}.{alias.name}") in _modules() else node.module for alias in node.names
            }
    return {name for name in found if name in _modules() and name != module}


def test_nothing_imports_itself_by_way_of_others() -> None:
    try:
        TopologicalSorter({module: _imports(module, path) for module, path in _modules().items()}).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))
