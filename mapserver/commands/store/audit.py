"""`mapserver audit`: who did what, and whether the log is as it was written."""

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated

import typer

from mapserver.commands.options import Json, StoreFolder, open_store, print_json
from mapserver.commands.store.verify import EXIT_STATUS_FAULTS

if TYPE_CHECKING:
    from mapserver.store import AuditLine


def audit(
    store: StoreFolder,
    verify: Annotated[bool, typer.Option("--verify", help="Check the chain of lines; status 3 for a fault.")] = False,
    last: Annotated[int, typer.Option(min=1, help="Number of lines to print.")] = 50,
    json: Json = False,
) -> None:
    """Print the log of a store: releases, sign-ins, operators, refusals; the last lines, oldest first."""
    from mapserver.store import chain_faults

    with open_store(store, read_only=True) as maps:
        if not verify:
            _print(maps.audit_lines(last), json=json)
            return
        lines = maps.audit_lines()
    faults = chain_faults(lines)
    if json:
        print_json({"lines": len(lines), "faults": faults})
    else:
        for fault in faults:
            typer.echo(f"fault: {fault}")
        typer.echo(f"{len(lines)} lines, {f'{len(faults)} faults' if faults else 'clean'}")
    if faults:
        raise typer.Exit(EXIT_STATUS_FAULTS)


def _print(lines: "list[AuditLine]", *, json: bool) -> None:
    if json:
        print_json(lines)
        return
    for line in lines:
        typer.echo(_words(line))


def _words(line: "AuditLine") -> str:
    """A line on one line: what came from elsewhere is quoted."""
    when = datetime.fromtimestamp(line.stamp_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S")
    proved = " (signed in)" if line.operator else ""
    parts = [f"{line.id} {when} {line.kind}", line.site and f"site {line.site}", repr(line.detail)]
    parts += [line.actor and f"by {line.actor!r}{proved}", line.address and f"from {line.address!r}"]
    parts += [line.reason and f"because {line.reason!r}"]
    return ", ".join(part for part in parts if part)
