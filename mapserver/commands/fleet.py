"""`mapserver fleet`: fleet health as a page, as files for other programs, and as a route for the next survey."""

import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

from typer import Argument, Context, Exit, Option, echo

from fleetmap.cli_options import Group, settings_of
from fleetmap.errors import UsageError
from fleetmap.log_lines import printable
from mapserver.commands.options import ActorOptions, Json, SiteName, StoreFolder, open_store, print_result, write_output

if TYPE_CHECKING:
    from mapserver.fleet.resurvey_list import ResurveyList


def report(
    context: Context,
    out: Annotated[Path, Argument(metavar="OUT.html", help="File to write; replaced if it exists.")],
    site: SiteName,
    store: StoreFolder,
    hours: Annotated[int, Option(min=1, max=9600, help="Hours to look back.")] = 24,
) -> None:
    """Write a one-page report for the shift leader: failures per robot-day, worst robots, versions, causes, tiles to resurvey."""
    from mapserver.dashboard.shift_page import html_page

    with open_store(store, read_only=True) as maps:
        page = html_page(maps, site, hours, time.time_ns(), settings_of(context))
    write_output(out, page.encode())
    echo(str(out))


def export(
    out: Annotated[Path, Argument(metavar="OUT", help="File to write; replaced if it exists.")],
    store: StoreFolder,
    site: Annotated[str | None, Option(help="Name of the site; default: all sites.")] = None,
    hours: Annotated[int | None, Option(min=1, help="Only the last N hours; default: everything.")] = None,
    format_: Annotated[
        Literal["jsonl", "mcap", "verdicts"] | None,
        Option("--format", help="jsonl, verdicts (jsonl with them) or mcap; default: by the file's name."),
    ] = None,
) -> None:
    """Write failures as JSON lines, or as MCAP with log, positions and pictures for Foxglove."""
    from fleetmap.hooks import plugin
    from mapserver.fleet.exports import write_json_lines
    from mapserver.store import FailureFilter

    chosen = format_ or {".jsonl": "jsonl", ".mcap": "mcap"}.get(out.suffix)
    if chosen is None:
        raise UsageError(f"{out}: name it .jsonl or .mcap, or name --format")
    since_ns = None if hours is None else time.time_ns() - hours * 3_600_000_000_000
    with open_store(store, read_only=True) as maps:
        if site is not None:
            maps.current(site)  # raises for an unknown site
        is_plain = chosen == "jsonl"
        write = write_json_lines if is_plain else plugin("mapserver.failure_exports", chosen, f"--format {chosen}")
        count = write(maps, FailureFilter(site=site, since_ns=since_ns), out)
    echo(f"{count} failures")


def resurvey(
    context: Context,
    site: SiteName,
    store: StoreFolder,
    route: Annotated[
        Path | None, Option(metavar="FILE", help="Write the route: .csv, or GeoJSON for any other name.")
    ] = None,
    json: Json = False,
) -> None:
    """List the tiles to resurvey with reasons, requested tiles first; --route writes a route through them."""
    from fleetmap.encoding import to_json
    from mapserver.fleet.resurvey_list import resurvey_list
    from mapserver.fleet_statistics.resurvey_decision import route_csv, route_geojson

    settings = settings_of(context).resurvey
    with open_store(store, read_only=True) as maps:
        found = resurvey_list(maps, site, settings, time.time_ns())
    if route is not None:
        geojson = to_json(route_geojson(found.site, found.version or 0, found.route), indent=1) + b"\n"
        write_output(route, route_csv(found.route).encode() if route.suffix == ".csv" else geojson)
    print_result(found, _words(found), json=json)


def _words(found: "ResurveyList") -> Iterator[str]:
    yield from (f"{concern.name}: {'; '.join(concern.reasons)}" for concern in found.tiles)
    for asked in found.requests:
        corners = f"{len(asked.corners_map_m)} corners"
        yield f"request {asked.id} of {asked.actor or 'unnamed'}: {corners}, {asked.reason or '-'}"
    yield from (
        f"{course.place}: surveyed; failures there: {course.effect}" for course in found.courses if course.effect
    )
    yield f"{len(found.tiles)} tiles to survey again, {len(found.route)} waypoints"


def replay(
    failure: Annotated[int, Argument(metavar="FAILURE", help="Number of the failure, as its page shows it.")],
    store: StoreFolder,
    version: Annotated[
        int | None, Option(metavar="N", help="Version of the map to try; default: the robot's then.")
    ] = None,
    json: Json = False,
) -> None:
    """Replay a failure with the present localizer, in the robot's map or in another version."""
    from mapserver.fleet.bounded_process import ProcessLimits, client_command, run_bounded, without_network

    with open_store(store, read_only=True) as maps, TemporaryDirectory() as folder:
        path = Path(folder) / f"failure-{failure}.mcap"
        path.write_bytes(maps.fleet.replay(failure))
        site = maps.fleet.failure(failure).failure.site
        report = Path(folder) / "report.json"
        options = ["--store", store, "--site", site, "--report", report]
        options += [] if version is None else ["--version", version]
        command = client_command("replay", path, *options)  # the file is from a robot
        done = run_bounded(command, ProcessLimits(), f"the replay of failure {failure}")
        output = report.read_text("utf-8") if json and report.exists() else done.stdout
    if not without_network():
        echo("it ran with the network: this system has no `unshare --net` for this account", err=True)
    for text, is_error in ((done.stderr, True), (output, False)):
        for line in text.splitlines():
            echo(line if json and not is_error else printable(line), err=is_error)
    if done.returncode:
        raise Exit(done.returncode)


def remove(
    failure: Annotated[int, Argument(metavar="FAILURE", help="Number of the failure, as its page shows it.")],
    store: StoreFolder,
    by: ActorOptions,
) -> None:
    """Remove a failure with its pictures and its recording, such as one whose report cannot be read. The counts keep it."""
    with open_store(store) as maps:
        row = maps.fleet.failure(failure).failure
        maps.fleet.remove_failure(failure)
        maps.audit("failure removed", f"{failure} of {row.robot}", actor=by.named(), site=row.site)
    echo(f"failure {failure} of {row.robot} is removed")


FLEET = Group(
    "Fleet health: a page, files, tiles to survey again, failures replayed or removed.",
    {"report": report, "export": export, "resurvey": resurvey, "replay": replay, "remove": remove},
)
