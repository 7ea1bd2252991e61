"""`mapserver nightly`: build the site's next version from new recordings."""

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Context, Option, echo

from fleetmap.cli_options import settings_of
from fleetmap.errors import BusyError, FleetmapError, disk_errors
from mapserver.commands.options import SurveyOptions


@dataclass(frozen=True, kw_only=True)
class NightlyOptions(SurveyOptions):
    """Options of `nightly` beside those of `build`."""

    inbox: Annotated[Path, Option(metavar="DIR", help="Folder that recordings are copied into.")]
    settle_s: Annotated[
        float, Option("--settle-s", min=0, help="A recording unchanged for this many seconds is complete.")
    ] = 300.0


def nightly(context: Context, options: NightlyOptions) -> None:
    """Check, build, judge and publish the recordings in the inbox; one run at a time for each site.

    Status 0 also for an empty inbox, 4 if the gate refuses, 5 if another run is at work.
    """
    options.check()
    from fleetmap.console import plain_console
    from fleetmap.recordings import FrameSelection
    from mapserver.plugins.nightly_builds.night import NightRequest, run_night

    FrameSelection.parse(options.frames)
    settings, build = settings_of(context), options.build_options(context, report=None)
    retention, trial = settings.ingest.retention(), settings.canary.share if settings.canary.builds else None
    request = NightRequest(
        options.site, options.inbox, options.store, time.time_ns(), options.settle_s, build, retention, trial
    )
    try:
        sentence = run_night(request, settings.gate, plain_console(stderr=True))
    except BusyError:
        raise
    except FleetmapError:
        with suppress(FleetmapError):  # the first error is the one to report
            _write_report(options)
        raise
    _write_report(options)
    echo(sentence)


def _write_report(options: NightlyOptions) -> None:
    from fleetmap.encoding import to_json
    from mapserver.plugins.nightly_builds.night import last_report

    if options.report is None or (content := last_report(options.store, options.site)) is None:
        return
    with disk_errors(f"{options.report} cannot be written", "the store's jobs hold the same report"):
        options.report.write_bytes(to_json(content, indent=2) + b"\n")
