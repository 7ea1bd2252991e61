"""`locclient check`: calibration, sensors, clock, cache, connection, each with its next step."""

from pathlib import Path
from typing import Annotated

import typer

from locclient.commands.options import Insecure, with_insecure


def check(
    context: typer.Context,
    config: Annotated[Path, typer.Option(help="The TOML file of `locclient run`.")],
    seconds: Annotated[float, typer.Option(min=0.0, help="Seconds to listen to the sensors; 0: not at all.")] = 3.0,
    insecure: Insecure = False,
) -> None:
    """Check a robot before it drives; status 3 if something must be repaired first."""
    settings = with_insecure(context.obj.read_config(config)[0], insecure=insecure)
    from locclient.daemon.preflight import FAIL, run_preflight

    failed = False
    for finding in run_preflight(settings, seconds):
        typer.echo(f"{finding.level:<5} {finding.what}: {finding.text}")
        failed |= finding.level == FAIL
    if failed:
        raise typer.Exit(3)
