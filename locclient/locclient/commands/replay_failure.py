"""`locclient replay-failure`: the present localizer over the recording of a failure."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from fleetmap.cli_options import expand_options
from locclient.commands.replay import MapOptions


@expand_options
def replay_failure(
    failure: Annotated[
        Path, typer.Argument(metavar="FAILURE.mcap", help="Recording of a failure, as its page offers.")
    ],
    map_options: MapOptions,
    manifest: Annotated[
        str | None, typer.Option(metavar="SHA256", help="Manifest of another version; default: the robot's then.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """Ask whether the present localizer would have failed too, in the robot's map or in another version."""
    from fleetmap.encoding import to_json
    from locclient.delivery.failure_file import read_failure_file
    from locclient.maps.connection import connected
    from locclient.replay.failure_replay import compare_failure, phases

    summary, record = read_failure_file(failure)
    address = replace(map_options, site=map_options.site or summary.site).address()
    with connected(address, map_options.cache, map_options.cache_bytes) as connection:
        found = compare_failure((summary, record), connection.source, manifest)
    if json:
        shown = {"answer": found.answer, "version": found.version, "has_same_statuses": found.has_same_statuses}
        told = {"then": summary.moments, "now": found.now}
        typer.echo(to_json(shown | told).decode())
        return
    typer.echo(
        f"{summary.robot}, version {summary.version}, fleetmap {summary.client}; seconds since the failure began"
    )
    typer.echo(f"then: {', '.join(phases(summary.moments, summary.began_ns))}")
    typer.echo(f"now:  {', '.join(phases(found.now, summary.began_ns))}")
    typer.echo(found.answer)
