"""What the commands `mapserver`, `locclient` and `fleetsim` share: how they end."""

import sys
from collections.abc import Callable

from fleetmap.errors import FleetmapError

INTERRUPTED = 130  # as a shell says it of Ctrl-C


def run(app: Callable[[], object]) -> None:
    """Runs a command line; a FleetmapError becomes its message on stderr and its exit status, Ctrl-C becomes 130."""
    try:
        app()
    except FleetmapError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_status)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
