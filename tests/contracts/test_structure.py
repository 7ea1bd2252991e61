"""No module imports itself by way of others, no function is longer than a screen, and features keep to their rooms."""

import ast
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from support.fleet.contracts_documents import REPOSITORY

PACKAGES = ("shared/fleetmap", "shared/fleetsim", "mapserver", "locclient")

_LONGEST_FUNCTION = 60  # lines


@cache
def _modules() -> dict[str, Path]:
    found = {}
    for path in (path for package in PACKAGES for path in sorted((REPOSITORY / package).rglob("*.py"))):
        parts = path.relative_to(REPOSITORY).with_suffix("").parts
        found[".".join(part for part in parts if part not in {"shared", "__init__"})] = path
    return found


@pytest.fixture(scope="module")
def statements() -> dict[str, list[ast.stmt]]:
    """What each module consists of."""
    return {module: ast.parse(path.read_text("utf-8")).body for module, path in _modules().items()}


def _imports(module: str, statements: list[ast.stmt]) -> set[str]:
    """The project's modules that this one imports when it is imported; not inside functions, not for types alone."""
    found: set[str] = set()
    pending = list(statements)
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.dump(node.test):
            pending += [*node.body, *node.orelse]
        elif isinstance(node, ast.Try):
            pending += [*node.body, *node.orelse, *(s for handler in node.handlers for s in handler.body)]
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [(f"{node.module}.{alias.name}", node.module) for alias in node.names]
            found |= {full if full in _modules() else module for full, module in names}
    return {name for name in found if name in _modules() and name != module}


def test_nothing_imports_itself_by_way_of_others(statements: dict[str, list[ast.stmt]]) -> None:
    try:
        TopologicalSorter({module: _imports(module, body) for module, body in statements.items()}).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_no_function_is_longer_than_a_screen(statements: dict[str, list[ast.stmt]]) -> None:
    functions = [
        (f"{module}.{node.name}", node.end_lineno - node.lineno + 1)
        for module, body in statements.items()
        for statement in body
        if statement.end_lineno - statement.lineno >= _LONGEST_FUNCTION  # a shorter one has none that is too long
        for node in ast.walk(statement)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    assert [function for function in functions if function[1] > _LONGEST_FUNCTION] == []


@pytest.mark.parametrize(
    ("word", "rooms", "files"),
    [("views", ("sensors", "api", "dashboard"), 25), ("floors?", ("floor_plan", "api", "dashboard"), 35)],
)
def test_a_feature_is_mentioned_in_few_files_outside_its_rooms(word: str, rooms: tuple[str, ...], files: int) -> None:
    """A number here only becomes smaller. Rounding down is no floor."""
    outside = [
        module
        for module, path in _modules().items()
        if not {*module.split(".")} & {*rooms} and re.search(rf"(?<!np\.|th\.)\b{word}\b", path.read_text("utf-8"))
    ]
    assert len(outside) <= files, outside
