"""`locclient run`: the robot's daemon, until it is told to stop."""

from pathlib import Path
from typing import Annotated

import typer


def run(
    config: Annotated[Path, typer.Option(help="TOML file: who the robot is, its sensors, its map, its outputs.")],
    verbose: Annotated[bool, typer.Option("--verbose", help="Log what goes well too.")] = False,
) -> None:
    """Localise a robot from its live sensors all day; ends with status 0 on SIGTERM or SIGINT, or with its recording."""
    import logging
    import signal

    from locclient.config import read_config

    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING, format="%(levelname)s %(name)s: %(message)s"
    )
    settings = read_config(config)
    from locclient.daemon.daemon import check_run, daemon_parts

    check_run(settings)
    from locclient.daemon.runtime import Runtime
    from locclient.daemon.systemd_notify import ServiceManager

    with daemon_parts(settings) as parts:
        runtime = Runtime(parts, ServiceManager())
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: runtime.stop())
        typer.echo(f"ready: {parts.robot_name} at {parts.site}, source {settings.source.kind}")
        runtime.run()
