"""The options --actor and --reason: who does something to a store, and why. Both go into its log."""

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mapserver.store import Actor

ActorName = Annotated[str | None, typer.Option(metavar="NAME", help="Who acts; the user's name if left out.")]
Reason = Annotated[str, typer.Option(metavar="TEXT", help="Why; kept in the log.")]


def acting(name: str | None, reason: str) -> "Actor":
    """Who acts, and why."""
    import getpass
    import os

    from mapserver.store import Actor

    if not name:
        try:
            name = getpass.getuser()
        except (KeyError, OSError):  # a user without an entry, as in containers
            name = f"uid {os.getuid()}"
    return Actor(name, reason)
