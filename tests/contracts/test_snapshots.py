"""Interfaces that change on purpose only: the HTTP API's description, the help of every command, what the compiled core refuses.

`SNAPSHOTS=write python -m pytest tests/contracts/test_snapshots.py` writes them anew; the diff belongs into the same commit.
"""

import json
import os
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import typer.core

from fleetmap.hooks import plugins
from mapserver.api.app import create_app
from mapserver.api.metrics import Metrics
from mapserver.fleet.fleet import Fleet
from mapserver.store import MapStore
from support.core_arguments import CALLS, refusals
from support.fleet.contracts_documents import REPOSITORY, click_command

SNAPSHOTS = Path(__file__).parent / "snapshots"


def is_as_kept(name: str, text: str) -> bool:
    if os.environ.get("SNAPSHOTS") == "write":
        (SNAPSHOTS / name).write_text(text, encoding="utf-8")
    return (SNAPSHOTS / name).read_text(encoding="utf-8") == text


def test_openapi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mapserver.api.app.plugins", lambda _: {})  # without plug-ins
    with MapStore.open(tmp_path, create=True) as store:
        fleet = Fleet(store)
        document = create_app(store, fleet, Metrics(store, fleet), None).openapi()
    assert is_as_kept("openapi.json", json.dumps(document, indent=1, sort_keys=True) + "\n")


def test_help() -> None:
    """Arguments and options with their types, defaults and texts, independent of the terminal."""
    scripts = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))["project"]["scripts"]
    assert is_as_kept("help.txt", "\n".join(line for script in sorted(scripts) for line in _help(script)) + "\n")


def test_refusals_of_the_core() -> None:
    """An array that is too short, a number below or above what can be, or none, in each argument beside right ones."""
    refused = {name: refusals(name) for name in sorted(CALLS)}
    assert is_as_kept("refusals.txt", "".join(f"{name}: {words}\n" for name, words in refused.items() if words))


def _help(path: str) -> Iterator[str]:
    command = click_command(path)
    yield f"{path}: {' '.join((command.help or '').split())}"
    if isinstance(command, click.Group | typer.core.TyperGroup):
        for name in sorted(command.commands.keys() - plugins("mapserver.commands").keys()):  # without plug-ins
            yield from _help(f"{path} {name}")
        return
    for parameter in command.params:
        names = "/".join((*parameter.opts, *parameter.secondary_opts))
        required = ", required" if parameter.required else ""
        text = " ".join((getattr(parameter, "help", None) or "").split())
        yield f"  {names} [default {parameter.default}{required}] {text}"
