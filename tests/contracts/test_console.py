"""What commands print is what was written: neither help texts nor strangers' names are read as markup."""

import io
from collections.abc import Iterator

import click
import pytest
from rich.table import Table
from rich.text import Text

from fleetmap.console import plain_console
from support.fleet.contracts_documents import click_command

STRANGE = "[red] :smile: A:B:C [/nothing]"


def commands(path: str) -> Iterator[tuple[str, click.Command]]:
    command = click_command(path)
    yield path, command
    for name in getattr(command, "commands", {}):
        yield from commands(f"{path} {name}")


@pytest.mark.parametrize("script", ["mapserver", "locclient", "fleetsim"])
def test_help_is_shown_as_it_is_written(script: str) -> None:
    """Typer reads help texts as rich markup: [source] would vanish, and A:B:C become a picture."""
    for path, command in commands(script):
        for words in (command.help, *(getattr(parameter, "help", None) for parameter in command.params)):
            assert Text.from_markup(words or "").plain == (words or ""), path


def test_names_are_shown_as_they_are() -> None:
    console = plain_console()
    console.file = io.StringIO()
    table = Table(STRANGE, title=STRANGE)
    table.add_row(STRANGE)
    console.print(STRANGE)
    console.print(table)
    assert console.file.getvalue().count(STRANGE) == 4
