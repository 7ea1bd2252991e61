"""`locclient run`: the robot's daemon, until it is told to stop."""

from pathlib import Path
from typing import Annotated

import typer

from locclient.commands.options import Insecure, with_insecure


def run(
    context: typer.Context,
    config: Annotated[Path, typer.Option(help="TOML file with the robot, its sensors, map and outputs.")],
    insecure: Insecure = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Log successes too.")] = False,
) -> None:
    """Localize a robot from its live sensors; ends with status 0 on SIGTERM or SIGINT, or with its recording."""
    import logging
    import signal

    from fleetmap.log_lines import log_to_stderr

    log_to_stderr(logging.INFO if verbose else logging.WARNING, "%(levelname)s %(name)s: %(message)s")
    settings = with_insecure(context.obj.read_config(config)[0], insecure=insecure)
    from locclient.daemon.daemon import check_run, daemon_parts

    check_run(settings)
    from locclient.daemon.runtime import Runtime
    from locclient.daemon.service_manager import ServiceManager

    with daemon_parts(settings) as parts:
        runtime = Runtime(parts, ServiceManager())
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: runtime.stop())
        typer.echo(f"ready: {parts.profile.robot} at {parts.profile.site}, source {settings.source.kind}")
        runtime.run()
