"""`locclient check`: calibration, sensors, clock, cache, connection, each with its next step."""

from pathlib import Path
from typing import Annotated

import typer


def check(
    config: Annotated[Path, typer.Option(help="The TOML file of `locclient run`.")],
    seconds: Annotated[float, typer.Option(min=0.0, help="How long to listen to the sensors; 0 does not.")] = 3.0,
) -> None:
    """Look over a robot before it drives; status 3 where something must be mended first."""
    from locclient.config import read_config

    settings = read_config(config)
    from locclient.daemon.preflight import FAIL, run_preflight

    failed = False
    for finding in run_preflight(settings, seconds):
        typer.echo(f"{finding.level:<5} {finding.what}: {finding.text}")
        failed |= finding.level == FAIL
    if failed:
        raise typer.Exit(3)
