"""`mapserver trust`: who may sign maps, and what is signed."""

from typing import Annotated

import typer

from fleetmap.cli_options import Group
from mapserver.commands.options import Json, StoreFolder
from mapserver.commands.print_json import print_json


def init(
    store: StoreFolder,
    here: Annotated[
        bool,
        typer.Option(
            "--here", help="Keep all keys on this machine, without passphrases; the lists are signed by themselves."
        ),
    ] = False,
) -> None:
    """Sign the maps of a store from now on; robots then run only what the signed lists admit."""
    from fleetmap.errors import UsageError
    from mapserver.store import MapStore
    from mapserver.trust import init_here

    if not here:
        raise UsageError("say where the keys are: --here keeps all of them on this machine")
    with MapStore.open(store) as maps:
        init_here(maps)
    typer.echo(f"signed; robots on other machines need {store / 'trust' / '1.root.json'}")


def status(store: StoreFolder, json: Json = False) -> None:
    """Show every role with its keys and the days that it lasts; status 1 where robots take no new maps, now or soon."""
    from rich.console import Console
    from rich.table import Table

    from mapserver.store import MapStore
    from mapserver.trust.status import trust_status

    with MapStore.open(store) as maps:
        found = trust_status(maps)
    if json:
        print_json(found)
    else:
        table = Table("role", "number", "keys", "needed", "days left", "")
        for role in found.roles:
            left = "" if role.days_left is None else f"{role.days_left:.1f}"
            table.add_row(role.role, str(role.number), str(role.keys), str(role.threshold), left, role.fault)
        console = Console()
        console.print(table)
        for words in found.risks:
            console.print(words, style="yellow", markup=False, highlight=False)
        for words in found.faults:
            console.print(words, style="red", markup=False, highlight=False)
    if found.faults:
        raise typer.Exit(1)


TRUST = Group("Who may sign maps, and what is signed.", {"init": init, "status": status})
