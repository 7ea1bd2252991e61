"""`mapserver nightly`: new recordings become the site's next version, or the reason is told why not."""

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from fleetmap.errors import BusyError, FleetmapError, StoreError, UsageError
from mapserver.commands.config_option import ConfigFile, config_path


def nightly(
    context: typer.Context,
    site: Annotated[str, typer.Option(help="Name of the site.")],
    inbox: Annotated[Path, typer.Option(metavar="DIR", help="Folder that recordings are copied into.")],
    store: Annotated[Path, typer.Option(help="Folder of the map store; made if it is not there.")],
    settle_s: Annotated[
        float,
        typer.Option("--settle-s", min=0, help="Seconds without a change after which a recording counts as whole."),
    ] = 300.0,
    frames: Annotated[str, typer.Option(metavar="A:B:C", help="Slice of the frames that take part.")] = "::",
    calibration: Annotated[Path | None, typer.Option(metavar="FILE", help="Kalibr camchain to use.")] = None,
    zones: Annotated[
        Path | None, typer.Option(metavar="FILE", help="TOML file with areas that never see each other.")
    ] = None,
    report: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the JSON report here.")] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Threads that survey; as many as there are cores if left out.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Survey on this dask cluster; `local` makes one of processes here."),
    ] = None,
    config: ConfigFile = None,
) -> None:
    """Check, build, judge and publish what came into the inbox; one run at a time for each site.

    Ends with 0 also where nothing came in, 4 where the gate refuses, 5 where another run is at work.
    """
    if report is not None and (report.is_dir() or not report.parent.is_dir()):
        raise UsageError(f"--report {report}: name a file in a folder that exists")
    from fleetmap.mapformat import check_name

    check_name(site, "site")
    import time

    from rich.console import Console

    from fleetmap.recordings import FrameSelection
    from mapserver.config import read_config
    from mapserver.nightly import NightRequest, run_night

    FrameSelection.parse(frames)
    settings = read_config(config_path(context))
    order = NightRequest(site, inbox, store, time.time_ns(), settle_s, frames, calibration, zones, threads, scheduler)
    try:
        sentence = run_night(order, settings.survey, settings.gate, Console(stderr=True))
    except BusyError:
        raise
    except FleetmapError:
        with suppress(FleetmapError):  # what went wrong first is what is told
            _write(report, store, site)
        raise
    _write(report, store, site)
    typer.echo(sentence)


def _write(report: Path | None, store: Path, site: str) -> None:
    import msgspec

    from mapserver.nightly import last_report

    said = None if report is None else last_report(store, site)
    if report is None or said is None:
        return
    try:
        report.write_bytes(msgspec.json.format(msgspec.json.encode(said), indent=2) + b"\n")
    except OSError as error:
        raise StoreError(f"{report} cannot be written ({error.strerror}); the store's jobs say the same") from error
