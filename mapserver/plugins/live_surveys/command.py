"""`mapserver live`: map a survey during the drive, show it to viewers, and store it as a draft at its end."""

import signal
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Context, Option, echo

from fleetmap.cli_options import config_path
from fleetmap.errors import LinkError, UsageError
from mapserver.commands.options import SurveyOptions, open_store

if TYPE_CHECKING:
    from fleetmap.bus.zenoh_bus import Bus
    from mapserver.plugins.live_surveys.drives import Drive
    from mapserver.plugins.live_surveys.message import LiveSurveyState
_LOOPBACK = "127.0.0.1"


@dataclass(frozen=True, kw_only=True)
class LiveCommandOptions(SurveyOptions):
    """Options of `live` beside those of `nightly`."""

    use: Annotated[str | None, Option(metavar="SENSORS", help="Use only these sensors of the recording.")] = None
    speed: Annotated[float, Option(help="Speed of the recording; 1 is its own, 0 as fast as it goes.")] = 1.0
    sensors: Annotated[
        Path | None, Option(metavar="FILE", help="Drive with the sources and topics of this file instead.")
    ] = None
    record: Annotated[Path | None, Option(metavar="FILE.mcap", help="Recording of --sensors to write.")] = None
    server: Annotated[
        str | None, Option(metavar="ENDPOINT", help="zenoh endpoint of the server whose dashboard shows the survey.")
    ] = None
    foxglove: Annotated[
        str | None, Option(metavar="[HOST:]PORT", help="Show the survey in Foxglove there, without sign-in.")
    ] = None
    insecure: Annotated[bool, Option("--insecure", help="Let other machines connect to --foxglove.")] = False


def live(
    context: Context,
    options: LiveCommandOptions,
    recording: Annotated[Path | None, Argument(metavar="[RECORDING]", help="Folder or file to play.")] = None,
) -> None:
    """Map a survey during the drive; Ctrl-C ends the drive and stores a draft."""
    options.check()
    sensors = (options.sensors or config_path(context)) if recording is None else options.sensors
    if (recording is None) == (sensors is None) or (recording is None) != (options.record is not None):
        raise UsageError(
            "name a RECORDING to play, or --record FILE.mcap to keep what the [source] of --sensors FILE (or --config FILE) sends"
        )
    of_recordings = [name for name in ("use", "calibration", "topic") if getattr(options, name) is not None]
    if recording is None and of_recordings:
        raise UsageError(
            f"--{of_recordings[0]} applies to a RECORDING only; for sensors set [source] and [topics] in {sensors}"
        )
    from fleetmap.console import plain_console
    from fleetmap.plugins.viewer_channels import require_foxglove
    from fleetmap.recordings.sensor_subset import named_sensor_set
    from fleetmap.sources.source import open_source
    from mapserver.drafting.draft import BuildRequest
    from mapserver.plugins.live_surveys.drives import RecordedDrive, SensorDrive
    from mapserver.plugins.live_surveys.live_survey import run_live

    use = None if options.use is None else named_sensor_set(options.use)
    build, stopped = options.build_options(context, use=use), _stopping()
    tells, see = list[Callable[["LiveSurveyState"], None]](), None
    with ExitStack() as opened:
        if options.foxglove is not None:
            at = viewer_address(options.foxglove, insecure=options.insecure)
            require_foxglove("--foxglove")
            from mapserver.plugins.live_surveys.viewer_server import FoxgloveServer, LiveViewer

            foxglove = opened.enter_context(FoxgloveServer(*at, options.site))
            echo(f"foxglove: {foxglove.url}")
        paths = tuple(path for path in (recording, options.record) if path is not None)
        request = BuildRequest(paths, options.site, options.store, build)
        if recording is not None:
            read, indices = build.opened(recording)
            drive: Drive = RecordedDrive(request, opened.enter_context(read), indices, options.speed)
        else:
            given = context.obj(sensors)[0]
            drive = SensorDrive(request, open_source(given.source, given.topics), given.topics)
        if options.foxglove is not None:
            viewer = LiveViewer(foxglove, drive)
            tells, see = [viewer.tell], viewer.see
        if options.server is not None:
            tells.append(partial(_publish, opened.enter_context(_bus(options.server, options.store))))
        figures, built = run_live(drive, tells, stopped.is_set, plain_console(stderr=True), see)
    echo(figures.words())
    echo(built.sentence)


def _stopping() -> threading.Event:
    """Return what Ctrl-C or SIGTERM sets to end the drive; a second signal ends the build too."""
    stopped = threading.Event()

    def stop(*_: object) -> None:
        stopped.set()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.default_int_handler)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    return stopped


def _bus(server: str, store: Path) -> "Bus":
    from fleetmap.bus.endpoints import check_endpoint, has_tls
    from fleetmap.bus.zenoh_bus import Bus

    if not has_tls(check_endpoint(server)):
        return Bus(server).open()
    from mapserver.trust.enrolment import RobotRegister

    with open_store(store) as maps:
        tls = RobotRegister(maps).survey_tls()
    return Bus(server, tls=tls).open()


def _publish(bus: "Bus", state: "LiveSurveyState") -> None:
    from fleetmap.messages import encode_message
    from mapserver.plugins.live_surveys.message import live_key

    with suppress(LinkError):  # a survey continues without viewers
        bus.publish(live_key(state.site), encode_message(state), may_drop=True)


def viewer_address(text: str, *, insecure: bool) -> tuple[str, int]:
    """Parse the value of `--foxglove`, PORT on loopback or HOST:PORT; port 0 picks a free one.

    Raises UsageError for an invalid address, and for one that other machines can reach unless allowed: viewers do not sign in.
    """
    from fleetmap.bus.endpoints import is_loopback

    host, _, port = text.rpartition(":")
    host = host.strip("[]") or _LOOPBACK
    if not (port.isascii() and port.isdecimal()) or int(port) > 65535:
        raise UsageError(f"--foxglove {text!r}: write it like 8765 or {_LOOPBACK}:8765")
    if not (insecure or is_loopback(f"tcp/{host}:{port}")):
        raise UsageError(
            f"--foxglove {text}: viewers do not sign in, and other machines could see everything; leave {host} out and come "
            "through ssh -L, or pass --insecure on a network that only you can reach"
        )
    return host, int(port)
