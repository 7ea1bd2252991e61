"""Exit of the commands `mapserver`, `locclient` and `fleetsim`: errors become messages and statuses."""

import re
import shlex
import sys
from collections.abc import Callable
from importlib import metadata
from itertools import pairwise

from fleetmap.errors import FleetmapError, UsageError

# `mapserver COMMAND ...` of the commands that take --store, where it is not named
_IN_STORE = re.compile(
    r"`(mapserver (?!(?:doctor|calibrate|convert|evaluate|prepare|config)\b)\w(?:(?!--store)[^`])*)`"
)
INTERRUPTED = 130  # the status that shells use for Ctrl-C


def run_cli(app: Callable[[], object]) -> None:
    """Runs a command line; a FleetmapError becomes its message on stderr and its exit status, Ctrl-C becomes 130.

    A library that is not installed becomes the name of the extra that brings it.
    """
    try:
        app()
    except FleetmapError as error:
        print(f"error: {with_store(str(error), sys.argv)}", file=sys.stderr)
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


def with_store(text: str, arguments: list[str]) -> str:
    """A text whose commands of mapserver name the store that this command line names, so that they run as they are printed."""
    given = [after for word, after in pairwise(arguments) if word == "--store"]
    given += [word.partition("=")[2] for word in arguments if word.startswith("--store=")]
    if not given:
        return text
    return _IN_STORE.sub(lambda found: f"`{found[1]} --store {shlex.quote(given[-1])}`", text)


def require_extra(extra: str, program: str) -> None:
    """UsageError where libraries of an extra are not installed, with what to install; a source tree that is not installed passes."""
    try:
        project = metadata.distribution("fleetmap")
    except metadata.PackageNotFoundError:
        return
    marked = [line for line in project.requires or () if re.search(rf"extra == ['\"]{extra}['\"]", line)]
    names = [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in marked]
    missing = [name for name in names if not _is_installed(name)]
    if missing:
        raise UsageError(
            f"{program} needs the extra `{extra}`, of which {', '.join(missing)} are not installed; install it with "
            f"pip install './fleetmap-{project.version}-py3-none-any.whl[{extra}]', or '.[{extra}]' in fleetmap's source folder"
        )


def _is_installed(name: str) -> bool:
    try:
        metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return False
    return True
