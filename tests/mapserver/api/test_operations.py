"""An operation that one file adds is a route, a command, an act of a page and a line of the log."""

import re
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from fleetmap.cli_options import make_app
from mapserver.api.operations import OPERATIONS, Caller
from mapserver.api.operations.operation import Done, operation
from mapserver.api.operations.sites import Site
from mapserver.api.parameters import ApiSettings
from mapserver.cli import COMMANDS, _read_config, mapserver
from mapserver.commands.operation_commands import with_operations
from mapserver.dashboard.install import install_dashboard
from mapserver.operators.roles import Scope
from mapserver.store import NOBODY
from support.fleet.served_api import check_problem, served_api

Loud = Annotated[int, typer.Option(min=1, max=3, help="How loud.")]


@pytest.fixture
def greeting() -> Iterator[None]:
    """The operation, as a file of its own would add it."""

    @operation("/v1/sites/{site}/greet", "greet", needs=Scope.ROBOTS, page="map")
    def greet(caller: Caller, site: Site, loud: Loud = 1) -> Done:
        """Greet the robots of a site."""
        caller.store.audit("greeted", f"{loud} times", actor=caller.actor, site=site)
        return Done(f"site {site} is greeted")

    yield
    del OPERATIONS["greet"]


def test_an_operation_has_all_doors(greeting: None, tmp_path: Path) -> None:
    with served_api(tmp_path) as server:
        client, operators = server.client, server.client.app.state.served.operators
        install_dashboard(client.app, server.store, server.fleet, ApiSettings())
        described = client.get("/openapi.json").json()["paths"]["/v1/sites/{site}/greet"]["post"]
        assert (described["operationId"], described["description"]) == ("greet", "Greet the robots of a site.")
        page = client.get("/dashboard/map?site=lab").text
        (button,) = (found for found in re.findall(r'<button[^>]*data-act="([^"]+)"[^>]*>Greet<', page))
        address = unescape(button)
        assert client.post(address, json={"actor": "dan", "loud": 2}).json() == {"status": "ok"}
        check_problem(client.post(address, json={"actor": "dan", "loud": 4}), 422, "loud")
        app = make_app(with_operations(COMMANDS), mapserver, _read_config)
        told = CliRunner().invoke(
            app, ["greet", "--site", "lab", "--store", str(tmp_path), "--actor", "carl", "--loud", "3"]
        )
        assert (told.exit_code, told.output) == (0, "site lab is greeted\n")
        operators.add("olga", "operator", None, NOBODY)
        client.headers["Authorization"] = f"Bearer {operators.make_token('olga', [*Scope], 1, NOBODY)}"
        check_problem(client.post(address, json={}), 403, "the right to 'robots'")
        lines = [(line.actor, line.detail) for line in server.store.log()[::-1] if line.kind == "greeted"]
        assert lines == [("dan", "2 times"), ("carl", "3 times")]
