"""`locclient replay`: localization of a recording in a published map."""

from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Context, Exit, Option, echo

from fleetmap.cli_options import TopicNames, settings_of
from fleetmap.errors import UsageError

if TYPE_CHECKING:
    from locclient.config import LocclientConfig
    from locclient.identity import MapAddress
    from locclient.replay.replay import RunExport
    from locclient.replay.run_result import ReplayResult

Insecure = Annotated[bool, Option("--insecure", help="Allow other machines without TLS, for maps and for ROS topics.")]
IdentityFolder = Annotated[
    Path | None, Option(metavar="DIR", help="Folder that `locclient enrol` fills; default: in the user's state folder.")
]
NOT_LOCALISED_STATUS = 6


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Options of the map and of the robot's name."""

    server: Annotated[str | None, Option(help="zenoh endpoint of the map server; default: the robot's identity.")] = (
        None
    )
    store: Annotated[Path | None, Option(help="Folder of a map store, instead of a server.")] = None
    site: Annotated[str | None, Option(help="Name of the site.")] = None
    robot: Annotated[
        str | None, Option(help="Name of the robot for the server; default: the identity's, or replay.")
    ] = None
    cache: Annotated[Path | None, Option(help="Folder of the tile cache; default: the user's cache.")] = None
    root: Annotated[
        Path | None, Option(help="trust/1.root.json of the server's store; needed for a server on another machine.")
    ] = None
    identity: IdentityFolder = None
    insecure: Insecure = False
    # Equals tile_cache.DEFAULT_MAX_BYTES, which is not imported, so that --help stays fast.
    cache_bytes: Annotated[int, Option(min=0, help="Largest size of the tile cache.")] = 2_000_000_000

    def address(self, version: int | None) -> "MapAddress":
        """Return the map's address; UsageError unless the options name one map, and for a version with a server."""
        from locclient.identity import MapAddress

        return MapAddress.of(self, version=version, sign="--", usual_robot="replay")


@dataclass(frozen=True, kw_only=True)
class PlaybackOptions:
    """Played frames of a recording, and playback options."""

    frames: Annotated[str, Option(metavar="A:B:C", help="Slice of the frames to play.")] = ":"
    calibration: Annotated[Path | None, Option(help="Calibration file to use instead of the recording's own.")] = None
    topic: TopicNames = None
    use: Annotated[str | None, Option(metavar="SENSORS", help="Use only these sensors of the recording.")] = None
    prior: Annotated[str | None, Option(help="Start of the robot: X,Y,YAW,SIGMA_M (metres, radians).")] = None
    reverse: Annotated[bool, Option("--reverse", help="Play backwards, with new stamps and without IMU.")] = False
    realtime: Annotated[
        bool, Option("--realtime", help="Play at the recorded speed; default: as fast as possible.")
    ] = False
    starts: Annotated[
        int, Option(min=0, metavar="N", help="Also start N times along the recording without any guess.")
    ] = 0


@dataclass(frozen=True, kw_only=True)
class ResultFiles:
    """Files to write."""

    report: Annotated[Path | None, Option(help="Write the report to this JSON file.")] = None
    trajectory: Annotated[Path | None, Option(help="Write the localized frames to this TUM file.")] = None
    picture: Annotated[Path | None, Option(help="Draw the run from above into this PNG file.")] = None
    protection_picture: Annotated[
        Path | None, Option(help="Draw errors and protection levels (Stanford diagram) into this PNG file.")
    ] = None
    mcap: Annotated[Path | None, Option(help="Write the run to this MCAP file, which Foxglove opens.")] = None

    def write(self, result: "ReplayResult", report: dict[str, object]) -> None:
        """Write all but the MCAP file, which is written frame by frame."""
        from fleetmap.encoding import to_json
        from fleetmap.recordings.tum import write_tum

        if self.report is not None:
            self.report.write_bytes(to_json(report, indent=2) + b"\n")
        if self.trajectory is not None:
            write_tum(self.trajectory, result.trajectory)
        if self.picture is not None:
            result.save_picture(self.picture)
        if self.protection_picture is not None:
            from locclient.replay.plots import draw_protection, save_picture

            save_picture(draw_protection(result.frames), self.protection_picture)

    def check(self) -> None:
        """Raise UsageError for files that cannot be written."""
        for name, path in vars(self).items():
            if path is not None and not path.parent.is_dir():
                raise UsageError(f"--{name} {path}: the folder {path.parent} does not exist; make it first")
        for name, suffix in (("picture", ".png"), ("protection_picture", ".png"), ("mcap", ".mcap")):
            path = getattr(self, name)
            if path is not None and path.suffix.lower() != suffix:
                raise UsageError(f"--{name} {path} must end in {suffix}")


def replay(
    context: Context,
    recording: Annotated[Path, Argument(help="Folder (the parent of mav0 for EuRoC) or file.")],
    map_options: MapOptions,
    playback: PlaybackOptions,
    files: ResultFiles,
    version: Annotated[
        int | None, Option(min=1, help="Version of the map in --store, drafts included; default: the current one.")
    ] = None,
) -> None:
    """Fetch the site's map, localize every frame of a recording in it, and report the result; status 6: never localized.

    A failure's recording starts with the robot's pose, in the robot's version unless --version names another, and the result is compared
    with the robot's. In a building it is played in the map where the robot was.
    """
    from fleetmap.recordings.failure_recording import is_failure_recording

    if is_failure_recording(recording):
        _replay_failure(recording, map_options, playback, files, version)
        return
    address = map_options.address(version)
    files.check()
    _run(recording, address, map_options, playback, files, settings_of(context))


def _replay_failure(
    path: Path, map_options: MapOptions, playback: PlaybackOptions, files: ResultFiles, version: int | None
) -> None:
    """Report if the present localizer would have failed too; the site is the failure's unless another is named."""
    from fleetmap.encoding import to_json
    from locclient.delivery.failure_file import read_failure_file
    from locclient.maps.map_client import connected
    from locclient.replay.failure_replay import compare_failure, phases

    for given in (playback, replace(files, report=None)):
        for name, value in vars(given).items():
            if value != getattr(type(given)(), name):
                raise UsageError(
                    f"--{name} is not for a failure's recording ({path}), which is played as a whole; leave it out"
                )
    files.check()
    summary, record = read_failure_file(path)
    used = record.used.floor if record.used else ""
    address = replace(map_options, site=map_options.site or used or summary.site).address(version)
    with connected(address, map_options.cache, map_options.cache_bytes) as maps:
        sha256 = None if version is None else maps.ready().wanted.manifest_sha256
        found = compare_failure((summary, record), maps, sha256)
    if files.report is not None:
        answer = {"answer": found.answer, "version": found.version, "is_same": found.first_difference_ns is None}
        told = {"apart_m": found.apart_m, "then": summary.moments, "now": found.now}
        files.report.write_bytes(to_json(answer | told, indent=2) + b"\n")
    echo(f"{summary.robot}, version {summary.version}, fleetmap {summary.client}; seconds since the failure began")
    echo(f"then: {', '.join(phases(summary.moments, summary.began_ns))}")
    echo(f"now:  {', '.join(phases(found.now, summary.began_ns))}")
    echo(found.answer)


def _run(
    path: Path,
    address: "MapAddress",
    map_options: MapOptions,
    playback: PlaybackOptions,
    files: ResultFiles,
    settings: "LocclientConfig",
) -> None:
    from rich.progress import Progress
    from rich.table import Table

    from fleetmap.console import plain_console
    from fleetmap.hooks import plugin
    from fleetmap.recordings import FrameSelection, OpenOptions, named_topics, open_recording
    from fleetmap.recordings.sensor_subset import named_sensor_set, reduced
    from fleetmap.sources.source import ReplaySource
    from locclient.config import image_priors_of
    from locclient.localization.priors.given import parse_prior
    from locclient.maps.map_client import connected
    from locclient.replay.replay import ReplayOptions, load_map, spread_starts, starts
    from locclient.replay.replay import replay as play

    opening = None if files.mcap is None else plugin("locclient.run_exports", "mcap", "--mcap")(files.mcap)
    prior = parse_prior(playback.prior, "--prior")
    selection = FrameSelection.parse(playback.frames)
    use = None if playback.use is None else named_sensor_set(playback.use)
    options = OpenOptions(playback.calibration, named_topics(playback.topic, settings.topics))
    console = plain_console(stderr=True)
    with ExitStack() as stack:
        recording = reduced(stack.enter_context(open_recording(path, options)), use)
        source = ReplaySource.of(recording, selection, reverse=playback.reverse)
        export: RunExport | None = None if opening is None else stack.enter_context(opening)
        maps = stack.enter_context(connected(address, map_options.cache, map_options.cache_bytes))
        with Progress(console=console, disable=not console.is_terminal) as bar:
            for issue in recording.issues:
                console.print(f"note: {issue.what}: {issue.detail}".rstrip(": "))
            task = bar.add_task("replay", total=len(source))
            how = settings.localizer, playback.realtime, lambda _: bar.advance(task), export
            result = play(source, maps, ReplayOptions(*how, partial(image_priors_of, settings), address.robot), prior)
        report, more = result.report, dict[str, object]()
        if playback.starts:
            numbers, loaded = spread_starts(source, playback.starts), load_map(maps)[0]
            more["starts"] = [
                [{"stamp_ns": e.stamp_ns, "status": e.status, "map_from_body": e.map_from_body} for e in found]
                for found in starts(source, numbers, loaded, settings.localizer)
            ]
    files.write(result, report | more)
    table = Table("measure", "value")
    for name, value in report.items():
        table.add_row(name, _shown(value))
    plain_console().print(table)
    if result.search.is_lost_run:
        echo(result.search.words, err=True)
        raise Exit(NOT_LOCALISED_STATUS)


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return "  ".join(f"{k} {_shown(v)}" for k, v in value.items()) or "-"
    if value is None or value in ("", []):
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
