"""`mapserver evaluate`: an estimated trajectory against the truth."""

from pathlib import Path
from typing import Annotated

import typer

from mapserver.commands.config_option import ConfigFile


def evaluate(
    estimate: Annotated[Path, typer.Argument(metavar="ESTIMATE.tum", help="Estimated trajectory, TUM text.")],
    ground_truth: Annotated[Path, typer.Option(metavar="FILE", help="True trajectory of the same body, TUM text.")],
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
    config: ConfigFile = None,
) -> None:
    """Print the errors of a trajectory: aligned rigidly, aligned with scale, as it is, and from stamp to stamp."""
    import msgspec
    from rich.console import Console
    from rich.table import Table

    from fleetmap.recordings.tum import read_tum
    from mapserver.evaluation_summary import summary

    found = summary(read_tum(estimate), read_tum(ground_truth))
    if json:
        typer.echo(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
        return
    table = Table("error", "value", title=f"{estimate.name} against {ground_truth.name}")
    for key, value in found.items():
        table.add_row(key, f"{value:.5g}" if isinstance(value, float) else str(value))
    Console().print(table)
