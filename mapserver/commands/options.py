"""Options that several commands share."""

import getpass
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Context, Option, echo

from fleetmap.cli_options import TopicNames, config_path, settings_of
from fleetmap.errors import UsageError, disk_errors
from fleetmap.log_lines import printable

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

    from fleetmap.recordings import Topics
    from mapserver import BuildOptions
    from mapserver.store import Actor, MapStore


SiteName = Annotated[str, Option(help="Name of the site.")]
StoreFolder = Annotated[Path, Option(help="Folder of the map store.")]
NewStoreFolder = Annotated[Path, Option(help="Folder of the map store; created if it does not exist.")]
Json = Annotated[bool, Option("--json", help="Print JSON instead of text.")]
Calibration = Annotated[Path | None, Option(metavar="FILE", help="Kalibr camchain to use.")]


@dataclass(frozen=True, kw_only=True)
class SiteOptions:
    """A site in a store."""

    site: SiteName
    store: StoreFolder


@dataclass(frozen=True, kw_only=True)
class ActorOptions:
    """The person who changes a store, and the reason; both go into its log."""

    actor: Annotated[str | None, Option(metavar="NAME", help="Who acts; default: the user's name.")] = None
    reason: Annotated[str, Option(metavar="TEXT", help="Why; kept in the log.")] = ""

    def named(self) -> "Actor":
        """The actor for the store's log."""
        from mapserver.store import Actor

        name = self.actor
        if not name:
            try:
                name = getpass.getuser()
            except (KeyError, OSError):  # a user without an entry, as in containers
                name = f"uid {os.getuid()}"
        return Actor(name, self.reason)


@dataclass(frozen=True, kw_only=True)
class SurveyOptions(SiteOptions):
    """Options of `build` and `nightly`."""

    store: NewStoreFolder
    frames: Annotated[str, Option(metavar="A:B:C", help="Slice of the frames to use.")] = "::"
    calibration: Calibration = None
    topic: TopicNames = None
    zones: Annotated[Path | None, Option(metavar="FILE", help="TOML file of areas without sight of each other.")] = None
    report: Annotated[Path | None, Option(metavar="FILE", help="Write the JSON report to this file.")] = None
    threads: Annotated[int | None, Option(min=1, help="Number of threads; default: one per core.")] = None
    scheduler: Annotated[str | None, Option(metavar="ADDRESS", help="Run on this dask cluster (tls://...).")] = None

    def build_options(self, context: Context, **more: Any) -> "BuildOptions":
        """Return the options of a build, with additions."""
        from mapserver import BuildOptions

        names = ("frames", "calibration", "zones", "report", "threads", "scheduler")
        shared = {name: getattr(self, name) for name in names}
        topics = topics_of(context, self.topic)
        return BuildOptions(**shared | {"topics": topics, "config": config_path(context)} | more)

    def check(self) -> None:
        """Raise UsageError for a report that cannot be written and for an invalid name of the site."""
        from fleetmap.mapformat.names import check_name

        check_output("--report", self.report)
        check_name(self.site, "site")


def topics_of(context: Context, words: list[str] | None) -> "Topics":
    """Return the [topics] of the configuration file, overridden by those of --topic."""
    from fleetmap.recordings import named_topics

    topics: Topics = settings_of(context).topics
    return named_topics(words, topics)


def open_store(folder: Path, *, create: bool = False, read_only: bool = False) -> "MapStore":
    """Open the store in a folder. Its module is imported here, after the options are checked."""
    from mapserver.store import MapStore

    return MapStore.open(folder, create=create, read_only=read_only)


def version_named(maps: "MapStore", site: str, version: int | None) -> int:
    """Return the requested version, the current one for None; UsageError for a site without a current version."""
    if version is not None:
        return version
    current = maps.current(site)
    if current is None:
        raise UsageError(f"site {site} has no current version; name one with --version")
    return current.version


def check_output(option: str, path: Path | None, *suffixes: str) -> None:
    """Raise UsageError unless `path` can be a file, with one of these suffixes if given."""
    if path is not None and (path.is_dir() or not path.parent.is_dir()):
        raise UsageError(f"{option} {path}: name a file in a folder that exists")
    if path is not None and suffixes and path.suffix.lower() not in suffixes:
        raise UsageError(f"{option} {path} must end in {' or '.join(suffixes)}")


def write_output(path: Path, data: bytes) -> None:
    """Replace the output file of a command; StoreError if it cannot be written."""
    with disk_errors(f"{path} cannot be written", "choose another place"):
        path.write_bytes(data)


def print_result(value: object, parts: "Iterable[str | Table | Text]", *, json: bool = False) -> None:
    """Print the result of a command to stdout: a value as indented JSON, in which dataclasses are objects, or else its lines and tables."""
    from fleetmap.console import plain_console
    from fleetmap.encoding import to_json

    if json:
        echo(to_json(value, indent=2).decode())
        return
    for part in parts:
        if isinstance(part, str):
            echo("\n".join(map(printable, part.split("\n"))))  # strangers chose some of the words
        else:
            plain_console().print(part)


def table(columns: Sequence[str], rows: Iterable[Iterable[object]], title: str | None = None) -> "Table":
    """Return a table of rows to print; the cell of None is empty."""
    from rich.table import Table

    made = Table(*columns, title=title)
    for row in rows:
        made.add_row(*("" if cell is None else printable(str(cell)) for cell in row))
    return made


@contextmanager
def shown_progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a function that shows how many are done of how many."""
    from rich.progress import Progress

    from fleetmap.console import plain_console

    with Progress(console=plain_console(stderr=True), transient=True) as bars:
        bar = bars.add_task(what, total=None)
        yield lambda done, total: bars.update(bar, completed=done, total=total)
