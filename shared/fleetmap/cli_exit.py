"""Exit of the commands `mapserver`, `locclient` and `fleetsim`: errors become messages and statuses."""

import re
import shlex
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

from fleetmap.errors import FleetmapError, UsageError

PRINTED = re.compile(r"`(mapserver [a-z][^`]*)`")
# Commands that need each option, by their first arguments
_NEEDS = {
    "--site": re.compile(
        r"mapserver (build|live|nightly|publish|promote|rollback|versions|inspect|diff|export|align|areas|grid|map"
        r"|fleet (report|resurvey)|robots (enrol|revoke|remove))\b"
    ),
    "--store": re.compile(r"mapserver (?!(doctor|calibrate|convert|evaluate|config|trust key)\b)"),
}
INTERRUPTED = 130  # the status that shells use for Ctrl-C


def run_cli(app: Callable[[], object]) -> None:
    """Run a command line; a FleetmapError becomes its message on stderr and its exit status, Ctrl-C becomes 130.

    A missing library is reported with the extra that installs it.
    """
    try:
        app()
    except FleetmapError as error:
        print(f"error: {runnable(str(error), sys.argv)}", file=sys.stderr)
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


def runnable(text: str, arguments: list[str]) -> str:
    """Add site and store, or the settings file, of this command line to the `mapserver` commands in a text: they run as printed.

    The settings file of a robot is none of theirs.
    """
    given = dict(pair for pair in pairwise(arguments) if pair[0].startswith("--"))
    given |= dict(word.split("=", 1) for word in arguments if word.startswith("--") and "=" in word)
    if "locclient" in Path(arguments[0]).parts[-2:]:  # the program, or `python -m locclient`
        given.pop("--config", None)

    def completed(printed: re.Match[str]) -> str:
        command = printed[1]
        missing = [option for option, needs in _NEEDS.items() if needs.match(command) and option not in command]
        for option in missing:
            if option in given:
                command += f" {option} {shlex.quote(given[option])}"
            elif "--config" in given and "--config" not in command:
                command = command.replace("mapserver", f"mapserver --config {shlex.quote(given['--config'])}", 1)
        return f"`{command}`"

    return PRINTED.sub(completed, text)


def require_extra(extra: str, program: str) -> None:
    """Raise UsageError if libraries of an extra are missing, with the install command; a source tree that is not installed passes."""
    from importlib import metadata  # takes a tenth of a second

    try:
        project = metadata.distribution("fleetmap")
    except metadata.PackageNotFoundError:
        return
    marked = [line for line in project.requires or () if re.search(rf"extra == ['\"]{extra}['\"]", line)]
    names = [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in marked]
    missing = [name for name in names if not any(metadata.distributions(name=name))]
    if missing:
        tag = re.search(r"^Tag: (\S+)$", project.read_text("WHEEL") or "", re.MULTILINE)
        wheel = f"./fleetmap-{project.version}-{tag[1] if tag else '*'}.whl"
        raise UsageError(
            f"{program} needs the extra `{extra}`, of which {', '.join(missing)} are not installed; install it with "
            f"pip install '{wheel}[{extra}]', or '.[{extra}]' in fleetmap's source folder"
        )
