"""`mapserver fleet`: the fleet's health as a page, as files for other programs, and as a route for the next survey."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapserver.commands.config_option import ConfigFile, config_path
from mapserver.commands.print_json import print_json

if TYPE_CHECKING:
    from mapserver.fleet.resurvey_list import ResurveyList

fleet_app = typer.Typer(
    no_args_is_help=True, add_completion=False, help="How the robots of a site do: a page, files, what to survey again."
)
SiteName = Annotated[str, typer.Option(help="Name of the site.")]
StoreFolder = Annotated[Path, typer.Option(help="Folder of the map store.")]


class ExportFormat(StrEnum):
    """What `fleet export` writes."""

    JSONL = "jsonl"
    MCAP = "mcap"


@fleet_app.command()
def report(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="OUT.html", help="File to write; replaced where it exists.")],
    site: SiteName,
    store: StoreFolder,
    hours: Annotated[int, typer.Option(min=1, max=9600, help="So many hours back.")] = 24,
    config: ConfigFile = None,
) -> None:
    """Write one page for the shift leader: failures per robot-day, the worst robots, versions, causes, what to survey again."""
    import time

    from fleetmap.errors import StoreError
    from mapserver.config import read_config
    from mapserver.fleet.shift_page import html_page
    from mapserver.fleet.shift_summary import summarise
    from mapserver.store import MapStore

    settings = read_config(config_path(context))
    with MapStore.open(store) as maps:
        page = html_page(summarise(maps, site, hours, time.time_ns(), settings.canary, settings.resurvey))
    try:
        out.write_text(page, "utf-8")
    except OSError as error:
        raise StoreError(f"{out} cannot be written ({error.strerror}); choose another place") from error
    typer.echo(str(out))


@fleet_app.command()
def export(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File to write; replaced where it exists.")],
    store: StoreFolder,
    site: Annotated[str | None, typer.Option(help="Name of the site; all without it.")] = None,
    hours: Annotated[int | None, typer.Option(min=1, help="So many hours back; everything without it.")] = None,
    kind: Annotated[
        ExportFormat | None, typer.Option("--format", help="jsonl or mcap; by the file's name without it.")
    ] = None,
) -> None:
    """Write failures as JSON lines, or as MCAP with log, places and pictures, which Foxglove opens."""
    import time

    from fleetmap.errors import UsageError
    from mapserver.fleet.exports import write_json_lines, write_mcap
    from mapserver.store import FailureFilter, MapStore

    chosen = kind or next((known for known in ExportFormat if out.suffix == f".{known}"), None)
    if chosen is None:
        raise UsageError(f"{out}: name it .jsonl or .mcap, or name --format")
    since_ns = None if hours is None else time.time_ns() - hours * 3_600_000_000_000
    with MapStore.open(store) as maps:
        if site is not None:
            maps.current(site)  # an unknown site is not an empty one
        write = write_mcap if chosen is ExportFormat.MCAP else write_json_lines
        count = write(maps, FailureFilter(site=site, since_ns=since_ns), out)
    typer.echo(f"{count} failures")


@fleet_app.command()
def resurvey(
    context: typer.Context,
    site: SiteName,
    store: StoreFolder,
    route: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the route: .csv, or GeoJSON for any other name.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of sentences.")] = False,
    config: ConfigFile = None,
) -> None:
    """List the tiles that should be surveyed again, the worst first, and why; with --route the way through them."""
    import time

    from mapserver.config import read_config
    from mapserver.fleet.resurvey_list import resurvey_list
    from mapserver.store import MapStore

    settings = read_config(config_path(context)).resurvey
    with MapStore.open(store) as maps:
        found = resurvey_list(maps, site, settings, time.time_ns())
    if route is not None:
        _write_route(found, route)
    if json:
        print_json(found)
        return
    for concern in found.tiles:
        typer.echo(f"tile {concern.tile}: {'; '.join(concern.reasons)}")
    typer.echo(f"{len(found.tiles)} tiles to survey again, {len(found.route)} waypoints")


def _write_route(found: "ResurveyList", path: Path) -> None:
    import json as json_text

    from fleetmap.errors import StoreError
    from mapserver.fleet_statistics.resurvey_test import route_csv, route_geojson

    if path.suffix == ".csv":
        text = route_csv(found.route)
    else:
        text = json_text.dumps(route_geojson(found.site, found.version or 0, found.route), indent=1) + "\n"
    try:
        path.write_text(text, "utf-8")
    except OSError as error:
        raise StoreError(f"{path} cannot be written ({error.strerror}); choose another place") from error
