"""`mapserver evaluate`: an estimated trajectory against the truth."""

from pathlib import Path
from typing import Annotated

import typer

from mapserver.commands.config_option import ConfigFile


def evaluate(
    estimate: Annotated[Path, typer.Argument(metavar="ESTIMATE.tum", help="Estimated trajectory, TUM text.")],
    ground_truth: Annotated[Path, typer.Option(metavar="FILE", help="True trajectory of the same body, TUM text.")],
    covariances: Annotated[
        Path | None, typer.Option(metavar="FILE.csv", help="The estimate's own covariances: judges them too (NEES).")
    ] = None,
    from_first: Annotated[
        bool, typer.Option("--from-first", help="Place the first stamp on the truth: for odometry, which has no map.")
    ] = False,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Frames that should have an estimate, the base of evaluated_share.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
    config: ConfigFile = None,
) -> None:
    """Print the errors of a trajectory: aligned rigidly, aligned with scale, as it is, from stamp to stamp, and its drift."""
    import msgspec
    from rich.console import Console
    from rich.table import Table

    from fleetmap.recordings.covariances import read_covariances
    from fleetmap.recordings.tum import read_tum
    from mapserver.evaluation.summary_table import summary

    found = summary(
        read_tum(estimate), read_tum(ground_truth), frames=frames, from_first=from_first,
        covariances=None if covariances is None else read_covariances(covariances),
    )  # fmt: skip
    if json:
        typer.echo(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
        return
    table = Table("error", "value", title=f"{estimate.name} against {ground_truth.name}")
    for key, value in found.items():
        table.add_row(key, f"{value:.5g}" if isinstance(value, float) else str(value))
    Console().print(table)
