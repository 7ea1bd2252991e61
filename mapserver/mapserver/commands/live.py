"""`mapserver live`: a survey is mapped while it drives, seen by everybody who looks, and stored as a draft at its end."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import ConfigFile, config_path, expand_options
from fleetmap.errors import UsageError
from mapserver.commands.options import SurveyOptions

if TYPE_CHECKING:
    from fleetmap.bus import Bus
    from fleetmap.live_survey import LiveSurveyState
    from mapserver import BuildOptions
    from mapserver.live import Drive
    from mapserver.survey.settings import SurveySettings


@dataclass(frozen=True, kw_only=True)
class LiveCommandOptions(SurveyOptions):
    """Options of `live` beside those of `nightly`."""

    speed: Annotated[float, typer.Option(help="Speed of the recording; 1 is its own, 0 as fast as it goes.")] = 1.0
    sensors: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Drive with the [source] and [topics] of this file instead.")
    ] = None
    record: Annotated[Path | None, typer.Option(metavar="FILE.mcap", help="Where --sensors are recorded to.")] = None
    server: Annotated[
        str | None,
        typer.Option(metavar="ENDPOINT", help="zenoh endpoint of the server whose dashboard shows the survey."),
    ] = None


@expand_options
def live(
    context: typer.Context,
    options: LiveCommandOptions,
    recording: Annotated[
        Path | None, typer.Argument(metavar="[RECORDING]", help="Folder or .mcap file to play.")
    ] = None,
    config: ConfigFile = None,
) -> None:
    """Map a survey while it drives; Ctrl-C ends the drive, and what was seen becomes a draft."""
    options.check()
    if (recording is None) == (options.sensors is None) or (options.sensors is None) != (options.record is None):
        raise UsageError(
            "name a RECORDING to play, or --sensors FILE to drive with and --record FILE.mcap to keep it in"
        )
    from rich.console import Console

    from mapserver import BuildOptions
    from mapserver.live import LiveRequest, run_live

    asked = vars(options) | {"config": config_path(context)}
    site, store, speed, server, sensors, record = (
        asked.pop(name) for name in ("site", "store", "speed", "server", "sensors", "record")
    )
    build, is_stopped = BuildOptions(**asked), _stopping()
    with _drive(recording, sensors, record, build, speed) as (drive, settings), _bus(server, store) as bus:
        request = LiveRequest(site, store, settings, build)
        result = run_live(request, drive, _teller(bus), is_stopped, Console(stderr=True))
    typer.echo(result.figures.words())
    typer.echo(result.built.sentence)


@contextmanager
def _drive(
    recording: Path | None, sensors: Path | None, record: Path | None, build: "BuildOptions", speed: float
) -> "Iterator[tuple[Drive, SurveySettings]]":
    """The survey's source, and the settings that suit its sensors."""
    from fleetmap.sensors.samples import SensorSet
    from mapserver.config import survey_settings
    from mapserver.live import RecordedDrive, SensorDrive

    if recording is not None:
        with build.reading.open(recording) as (opened, indices):
            settings = survey_settings(build.config, opened.sensor_set)
            yield RecordedDrive(recording, opened, indices, build.frames, speed), settings
        return
    assert sensors is not None
    assert record is not None
    drive = SensorDrive.open(sensors, record)
    kind = SensorSet.STEREO if drive.calibration.imu is None else SensorSet.STEREO_INERTIAL
    yield drive, survey_settings(build.config, SensorSet.RGBD if drive.has_depth else kind)


def _stopping() -> Callable[[], bool]:
    """Whether Ctrl-C or SIGTERM has ended the drive; a second one ends the build too."""
    import signal

    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.default_int_handler)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    return lambda: stopped


def _bus(server: str | None, store: Path) -> "AbstractContextManager[Bus | None]":
    from fleetmap.bus import ZenohBus, check_endpoint, has_tls

    if server is None:
        return nullcontext(None)
    if not has_tls(check_endpoint(server)):
        return ZenohBus.connect(server)
    from mapserver.store import MapStore
    from mapserver.trust.enrolment import RobotRegister

    with MapStore.open(store) as maps:
        tls = RobotRegister(maps).survey_tls()
    return ZenohBus.connect(server, tls=tls)


def _teller(bus: "Bus | None") -> "Callable[[LiveSurveyState], None]":
    from fleetmap.errors import LinkError
    from fleetmap.live_survey import live_key
    from fleetmap.messages import encode_message

    def tell(state: "LiveSurveyState") -> None:
        if bus is not None:
            with suppress(LinkError):  # a survey goes on without those who look at it
                bus.publish(live_key(state.site), encode_message(state), may_drop=True)

    return tell
