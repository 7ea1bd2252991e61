"""`locclient replay`: localization of a recording in a published map."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fleetmap.cli_options import expand_options
from fleetmap.errors import UsageError

if TYPE_CHECKING:
    from locclient.config import LocclientConfig, ReplaySection


@dataclass(frozen=True, kw_only=True)
class ReplayArguments:
    """Options on the command line, which go before those of the file's [replay]."""

    server: Annotated[str | None, typer.Option(help="zenoh endpoint of the map server, tcp/HOST:PORT.")] = None
    store: Annotated[Path | None, typer.Option(help="A store's folder, instead of a server.")] = None
    site: Annotated[str | None, typer.Option(help="Name of the site.")] = None
    robot: Annotated[str | None, typer.Option(help="Name under which the robot reports.")] = None
    frames: Annotated[str | None, typer.Option(help="Which frames, as a Python slice A:B:C.")] = None
    calibration: Annotated[Path | None, typer.Option(help="Calibration file that goes before the recording's own.")] = (
        None
    )
    prior: Annotated[str | None, typer.Option(help="Where the robot starts: X,Y,YAW,SIGMA_M (metres, radians).")] = None
    reverse: Annotated[
        bool | None, typer.Option("--reverse", help="Play backwards, with new stamps and without IMU.")
    ] = None
    realtime: Annotated[
        bool | None, typer.Option("--realtime", help="As fast as it was recorded, not as fast as possible.")
    ] = None
    report: Annotated[Path | None, typer.Option(help="Write the report here, JSON.")] = None
    trajectory: Annotated[Path | None, typer.Option(help="Write the localised frames here, TUM format.")] = None
    picture: Annotated[Path | None, typer.Option(help="Write a top-down picture here, PNG.")] = None
    cache: Annotated[Path | None, typer.Option(help="Folder of the tile cache (default: the user's cache).")] = None


@expand_options
def replay(
    recording: Annotated[Path, typer.Argument(help="A folder (the parent of mav0 for EuRoC) or an .mcap file.")],
    arguments: ReplayArguments,
    config: Annotated[
        Path | None, typer.Option(help="TOML file with these options and the localizer's settings.")
    ] = None,
) -> None:
    """Fetches the site's map, localises every frame in it, and reports what the run was worth."""
    import msgspec

    from locclient.config import read_config

    loaded = read_config(config)
    given = {name: value for name, value in vars(arguments).items() if value is not None}
    options = msgspec.structs.replace(loaded.replay, **given)
    if options.site is None:
        raise UsageError("--site NAME is missing: which site's map?")
    if (options.server is None) == (options.store is None):
        raise UsageError("give either --server tcp/HOST:PORT or --store DIR")
    for name in ("report", "trajectory", "picture"):
        path = getattr(options, name)
        if path is not None and not Path(path).parent.is_dir():
            raise UsageError(f"--{name} {path}: the folder {Path(path).parent} does not exist; make it first")
    if options.picture is not None and Path(options.picture).suffix.lower() != ".png":
        raise UsageError(f"--picture {options.picture} must end in .png")
    _run(recording, options, loaded)


def _run(path: Path, options: "ReplaySection", config: "LocclientConfig") -> None:
    import json

    import msgspec
    from rich.console import Console
    from rich.progress import Progress

    from fleetmap.recordings import FrameSelection, OpenOptions, open_recording
    from fleetmap.recordings.tum import write_tum
    from locclient.maps.connection import connected
    from locclient.prior_option import parse_prior
    from locclient.replay.replay import ReplayOptions
    from locclient.replay.replay import replay as play
    from locclient.sensors.replay_source import ReplaySource

    prior = parse_prior(options.prior, "--prior")
    calibration = None if options.calibration is None else Path(options.calibration)
    selection = FrameSelection.parse(options.frames)
    console = Console(stderr=True)
    with (
        open_recording(path, OpenOptions(calibration_file=calibration, topics=config.topics)) as recording,
        connected(msgspec.structs.asdict(options)) as connection,
        Progress(console=console, disable=not console.is_terminal) as bar,
    ):
        for issue in recording.issues:
            console.print(f"note: {issue.what} {issue.detail}".rstrip())
        source = ReplaySource.of(recording, selection, reverse=options.reverse)
        task = bar.add_task("replay", total=len(source))
        run = ReplayOptions(config.localizer, prior, options.realtime, lambda _: bar.advance(task))
        result = play(source, connection, run)
    report = result.report
    if options.report is not None:
        Path(options.report).write_text(json.dumps(msgspec.to_builtins(report), indent=2) + "\n")
    if options.trajectory is not None:
        write_tum(Path(options.trajectory), result.trajectory)
    if options.picture is not None:
        result.save_picture(options.picture)
    _print_table(report)


def _print_table(report: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("measure", "value")
    for name, value in report.items():
        table.add_row(name, _shown(value))
    Console().print(table)


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return "  ".join(f"{k} {_shown(v)}" for k, v in value.items()) or "-"
    if value is None or value in ("", []):
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
