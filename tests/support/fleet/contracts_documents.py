"""The project's documents, cut into sections and tables for the tests that compare them with the code."""

import importlib.util
import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import click
import typer

REPOSITORY = Path(__file__).resolve().parents[3]
_HEADING = re.compile(r"^#{1,6} .*$", re.MULTILINE)


def generate_docs() -> Any:
    """The module docs/generate.py, which is in no package."""
    spec = importlib.util.spec_from_file_location("generate_docs", REPOSITORY / "docs/generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def text(path: str) -> str:
    """A document, by its path in the repository."""
    return (REPOSITORY / path).read_text("utf-8")


def section(path: str, words: str) -> str:
    """Text under the only heading that contains `words`, up to the next heading; empty if absent."""
    document = text(path)
    headings = list(_HEADING.finditer(document))
    found = [n for n, heading in enumerate(headings) if words in heading[0]]
    assert len(found) <= 1, f"{path} has {len(found)} headings with {words}"
    if not found:
        return ""
    number = found[0]
    end = headings[number + 1].start() if number + 1 < len(headings) else len(document)
    return document[headings[number].end() : end]


def rows(part: str) -> list[list[str]]:
    """The cells of all rows of the tables in `part` whose first cell begins with a word in backticks."""
    lines = (line for line in part.splitlines() if line.startswith("| `"))
    return [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines]


def code_words(cell: str) -> list[str]:
    """The words in backticks."""
    return re.findall(r"`([^`]+)`", cell)


@cache
def click_command(path: str) -> click.Command:
    """A command by its words, such as "mapserver build", as its script has it."""
    script, *words = path.split()
    module = tomllib.loads(text("pyproject.toml"))["project"]["scripts"][script].partition(":")[0]
    found = typer.main.get_command(importlib.import_module(module).app)
    for word in words:
        found = found.get_command(None, word)  # type: ignore[attr-defined]
    return found
