"""Interfaces that change on purpose only: the HTTP API's description, the help of every command, the log of acts, what the core refuses.

`SNAPSHOTS=write python -m pytest tests/contracts/test_snapshots.py` writes them anew; the diff belongs into the same commit.
"""

import json
import os
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import typer.core

from fleetmap.hooks import plugins
from mapserver.api.app import create_app
from mapserver.cli import app
from mapserver.fleet.fleet import Fleet
from mapserver.operators.operators import Operators
from mapserver.operators.roles import Scope
from mapserver.store import NOBODY, MapStore
from mapserver.trust import init_here
from mapserver.trust.enrolment import RobotRegister
from support.core_arguments import CALLS, refusals
from support.fleet.contracts_documents import REPOSITORY, click_command
from support.fleet.quick_passwords import use_quick_passwords
from support.fleet.served_api import served_api
from support.room_site import run
from support.storage.map_samples import save_sample_draft

SNAPSHOTS = Path(__file__).parent / "snapshots"


# Acts by both doors: the address below /v1 and the body of a request, the words of a command.
ACTS: tuple[tuple[str, dict[str, object] | None], ...] = (
    ("sites/lab/versions/2/publish", {"force": True}),
    ("sites/lab/rollback", {"to": 1}),
    ("sites/lab/versions/2/promote", {}),
    ("rollback --site lab", None),
    ("promote 2 --site lab", None),
    ("sites/lab/versions/1/canary", {"share": 0.2}),
    ("sites/lab/rollback", {}),
    ("promote 1 --canary 5% --site lab", None),
    ("rollback --site lab", None),
    ("publish --site lab --force", None),
    ("operators", {"name": "ada", "role": "admin"}),
    ("operators add bob --role operator", None),
    ("operators role bob viewer", None),
    ("operators password bob", None),
    ("operators token ci --scope read --scope metrics --days 3", None),
    ("operators disable bob", None),
    ("robots enrol r1 r2 --site lab --out {store}", None),
    ("robots revoke r1 r2 --site lab", None),
)
SIGNED_IN: tuple[tuple[str, dict[str, object]], ...] = (
    ("operators", {"name": "eve", "role": "viewer"}),
    ("operators/eve/role", {"role": "operator"}),
    ("operators/eve/password", {}),
    ("tokens", {"name": "eve", "scopes": ["read"], "days": 1}),
    ("operators/eve/disable", {}),
    ("sites/lab/enrolled", {"robot": "r3"}),
    ("sites/lab/enrolled/r3/revoke", {}),
)


def is_as_kept(name: str, text: str) -> bool:
    if os.environ.get("SNAPSHOTS") == "write":
        (SNAPSHOTS / name).write_text(text, encoding="utf-8")
    return (SNAPSHOTS / name).read_text(encoding="utf-8") == text


def test_openapi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mapserver.api.app.plugins", lambda _: {})  # without plug-ins
    with MapStore.open(tmp_path, create=True) as store:
        document = create_app(store, Fleet(store)).openapi()
    assert is_as_kept("openapi.json", json.dumps(document, indent=1, sort_keys=True) + "\n")


def test_help() -> None:
    """Arguments and options with their types, defaults and texts, independent of the terminal."""
    scripts = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))["project"]["scripts"]
    assert is_as_kept("help.txt", "\n".join(line for script in sorted(scripts) for line in _help(script)) + "\n")


def test_log_of_acts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the log says of each act, and who did it: by a command, on an open server, and signed in."""
    use_quick_passwords(monkeypatch)
    with served_api(tmp_path) as server:
        init_here(server.store)
        RobotRegister(server.store).authorities.init(["127.0.0.1"], None, None)
        save_sample_draft(server.store, seed=3)
        told = []
        for words, body in ACTS:
            if body is None:
                asked = [word.format(store=tmp_path) for word in words.split()]
                run(app, *asked, "--store", tmp_path, "--actor", "carl", "--reason", "why")
            else:
                told.append(server.client.post(f"/v1/{words}", json=body | {"actor": "dan", "reason": "because"}))
        token = Operators(server.store).make_token("ada", [*Scope], 1, NOBODY)
        server.client.headers["Authorization"] = f"Bearer {token}"
        told += [server.client.post(f"/v1/{words}", json=body | {"reason": "so"}) for words, body in SIGNED_IN]
        assert {answer.status_code for answer in told} == {200}, [answer.text for answer in told]
        shown = (
            f"{line.site} {line.version} {line.kind}: {line.detail}; {line.actor}, {line.operator}: {line.reason}\n"
            for line in server.store.log()[::-1]
        )
        assert is_as_kept("acts.txt", re.sub(r"[0-9a-f]{12,}", "...", "".join(shown)))


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
