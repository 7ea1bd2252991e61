"""Options that several commands share."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from locclient.config import LocclientConfig

Insecure = Annotated[
    bool, typer.Option("--insecure", help="Allow other machines without TLS, for maps and for ROS topics.")
]
IdentityFolder = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Folder that `locclient enrol` fills; default: in the user's folder of state."),
]


def with_insecure(config: "LocclientConfig", *, insecure: bool) -> "LocclientConfig":
    """The configuration, [run] insecure as on the command line where that says so."""
    import msgspec

    if not insecure:
        return config
    return msgspec.structs.replace(config, run=msgspec.structs.replace(config.run, insecure=True))
