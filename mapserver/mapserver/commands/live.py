"""`mapserver live`: a survey is mapped while it drives, seen by everybody who looks, and stored as a draft at its end."""

from collections.abc import Callable
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import ConfigFile, config_path, expand_options
from mapserver.commands.options import SurveyOptions

if TYPE_CHECKING:
    from fleetmap.bus import Bus
    from fleetmap.live_survey import LiveSurveyState


@dataclass(frozen=True, kw_only=True)
class LiveCommandOptions(SurveyOptions):
    """Options of `live` beside those of `nightly`."""

    speed: Annotated[float, typer.Option(help="Speed of the recording; 1 is its own, 0 as fast as it goes.")] = 1.0
    server: Annotated[
        str | None,
        typer.Option(metavar="ENDPOINT", help="zenoh endpoint of the server whose dashboard shows the survey."),
    ] = None


@expand_options
def live(
    context: typer.Context,
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="Folder or .mcap file to play.")],
    options: LiveCommandOptions,
    config: ConfigFile = None,
) -> None:
    """Map a survey while it drives; Ctrl-C ends the drive, and what was seen becomes a draft."""
    options.check()
    import signal

    from rich.console import Console

    from fleetmap.bus import ZenohBus
    from mapserver import BuildOptions
    from mapserver.build.build import BuildRequest
    from mapserver.library import settings_for
    from mapserver.live import LiveRequest, run_live

    asked = vars(options) | {"config": config_path(context)}
    site, store, speed, server = (asked.pop(name) for name in ("site", "store", "speed", "server"))
    build = BuildOptions(**asked)
    settings = settings_for(BuildRequest((recording,), site, store, build))
    request = LiveRequest(recording, site, store, settings, build, speed)
    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.default_int_handler)  # a second one ends the build too

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    with nullcontext(None) if server is None else ZenohBus.connect(server) as bus:
        result = run_live(request, _teller(bus), lambda: stopped, Console(stderr=True))
    typer.echo(result.figures.words())
    typer.echo(result.built.sentence)


def _teller(bus: "Bus | None") -> "Callable[[LiveSurveyState], None]":
    from fleetmap.errors import LinkError
    from fleetmap.live_survey import live_key
    from fleetmap.messages import encode_message

    def tell(state: "LiveSurveyState") -> None:
        if bus is not None:
            with suppress(LinkError):  # a survey goes on without those who look at it
                bus.publish(live_key(state.site), encode_message(state), may_drop=True)

    return tell
