"""The commands of operations: their parameters, the store and who acts become the call of one."""

from inspect import Parameter, Signature, signature
from typing import Any

from typer import Context, echo

from fleetmap.cli_options import Command, Commands, Group, settings_of
from mapserver.api.operations import OPERATIONS, Caller, Operation
from mapserver.commands.options import ActorOptions, StoreFolder, open_store


def with_operations(commands: Commands) -> Commands:
    """Return the commands of operations and these, each in its group."""
    found, alone = dict(commands), dict[str, Command | Group]()
    for operation in OPERATIONS.values():
        first, _, second = operation.command.partition(" ")
        if isinstance(group := found.get(first), Group):
            found[first] = Group(group.help, {**group.commands, second: _command(operation)})
        elif first:
            alone[first] = _command(operation)
    return alone | found


def _command(operation: Operation) -> Command:
    """The command of an operation: its own parameters, the store, and who acts."""

    def run(*, context: Context, store: StoreFolder, by: ActorOptions, **own: Any) -> None:
        with open_store(store) as maps:
            done = operation.run(Caller(maps, by.named(), settings_of(context)), **own)
        echo(done.words)

    (*general, _) = signature(run).parameters.values()
    own = [item.replace(kind=Parameter.KEYWORD_ONLY) for item in operation.parameters.values()]
    run.__doc__ = operation.run.__doc__
    run.__signature__ = Signature([*own, *general])  # type: ignore[attr-defined]
    return run
