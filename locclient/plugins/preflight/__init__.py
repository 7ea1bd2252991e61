"""The command `locclient check`."""

from pathlib import Path
from typing import Annotated

from typer import Context, Exit, Option, echo

from locclient.replay_command import Insecure


def check(
    context: Context,
    config: Annotated[Path, Option(help="The TOML file of `locclient run`.")],
    seconds: Annotated[float, Option(min=0.0, help="Seconds to listen to the sensors; 0: not at all.")] = 3.0,
    insecure: Insecure = False,
) -> None:
    """Check a robot before it drives; status 3 if something must be repaired first."""
    from locclient.config import with_insecure
    from locclient.plugins.preflight.checks import FAIL, run_preflight

    settings = with_insecure(context.obj(config)[0], insecure=insecure)

    failed = False
    for finding in run_preflight(settings, seconds):
        echo(f"{finding.level:<5} {finding.what}: {finding.text}")
        failed |= finding.level == FAIL
    if failed:
        raise Exit(3)
