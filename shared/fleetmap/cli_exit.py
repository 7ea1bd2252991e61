"""Exit of the commands `mapserver`, `locclient` and `fleetsim`: errors become messages and statuses."""

import sys
from collections.abc import Callable

from fleetmap.errors import FleetmapError

INTERRUPTED = 130  # the status that shells use for Ctrl-C


def run_cli(app: Callable[[], object]) -> None:
    """Runs a command line; a FleetmapError becomes its message on stderr and its exit status, Ctrl-C becomes 130.

    A library that is not installed becomes the name of the extra that brings it.
    """
    try:
        app()
    except FleetmapError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_status)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in {"fleetmap", "fleetsim", "mapserver", "locclient"}:
            raise
        print(
            f"error: {error.name} is not installed; pip install '.[server]' in fleetmap's source folder brings it",
            file=sys.stderr,
        )
        sys.exit(FleetmapError.exit_status)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
