"""`mapserver build` and `nightly`: a draft from recordings, and the site's next version from new ones."""

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import ConfigFile, expand_options, settings_of
from fleetmap.errors import BusyError, FleetmapError, UsageError, disk_errors
from mapserver.commands.options import SurveyOptions, check_output

if TYPE_CHECKING:
    from mapserver.drafting.survey_recordings import StartPoses


@dataclass(frozen=True, kw_only=True)
class BuildCommandOptions(SurveyOptions):
    """Options of `build` beside those of `nightly`."""

    trajectory_out: Annotated[
        Path | None, typer.Option(metavar="FILE.tum", help="Write the poses of all frames to this file.")
    ] = None
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw the map from above into this file.")
    ] = None
    frame_from_ground_truth: Annotated[
        bool, typer.Option("--frame-from-ground-truth", help="Align the finished map with the ground truth.")
    ] = False
    use: Annotated[str | None, typer.Option(metavar="SENSORS", help="Use only these sensors of the recording.")] = None
    replay: Annotated[
        list[Path] | None,
        typer.Option(metavar="RECORDING", help="Earlier recording of the current version to localize in the draft."),
    ] = None


@expand_options
def build(
    context: typer.Context,
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING...", help="Folder or file to survey.")],
    options: BuildCommandOptions,
    trajectory: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Poses of another SLAM system as the start.")
    ] = None,
    trajectory_frame: Annotated[
        str | None, typer.Option(metavar="NAME", help="Poses of the `camera` (default) or of the `body`.")
    ] = None,
    trajectory_scale: Annotated[
        float | None, typer.Option(metavar="METRES", help="Metres in their unit of length.")
    ] = None,
    config: ConfigFile = None,
) -> None:
    """Survey the recordings, join them to the site's current version, and store the map as a draft."""
    check_output("--trajectory-out", options.trajectory_out)
    check_output("--picture", options.picture, ".png")
    for path in options.replay or ():  # it is read behind the survey, which may take hours
        if not path.exists():
            raise UsageError(f"--replay {path} does not exist; name a recording of the current version")
    options.check()
    from fleetmap.recordings.sensor_subset import named_sensor_set
    from mapserver import build_map

    built = build_map(
        recordings,
        options.store,
        options.site,
        options.build_options(
            context,
            use=None if options.use is None else named_sensor_set(options.use),
            replay=tuple(options.replay or ()),
            trajectory=_other_trajectory(trajectory, trajectory_frame, trajectory_scale),
            trajectory_out=options.trajectory_out,
            picture=options.picture,
            frame_from_ground_truth=options.frame_from_ground_truth,
        ),
    )
    typer.echo(built.sentence)


def _other_trajectory(file: Path | None, frame: str | None, scale: float | None) -> "StartPoses | None":
    from fleetmap.hooks import plugin

    if file is not None:
        opened: StartPoses = plugin("mapserver.poses", "trajectory", "--trajectory")(file, frame or "camera", scale)
        return opened
    for option, value in (("--trajectory-frame", frame), ("--trajectory-scale", scale)):
        if value is not None:
            raise UsageError(f"{option} describes --trajectory FILE, which is missing; add it")
    return None


@dataclass(frozen=True, kw_only=True)
class NightlyOptions(SurveyOptions):
    """Options of `nightly` beside those of `build`."""

    inbox: Annotated[Path, typer.Option(metavar="DIR", help="Folder that recordings are copied into.")]
    settle_s: Annotated[
        float, typer.Option("--settle-s", min=0, help="A recording unchanged for this many seconds is complete.")
    ] = 300.0


@expand_options
def nightly(context: typer.Context, options: NightlyOptions, config: ConfigFile = None) -> None:
    """Check, build, judge and publish the recordings in the inbox; one run at a time for each site.

    Status 0 also for an empty inbox, 4 if the gate refuses, 5 if another run is at work.
    """
    options.check()
    from fleetmap.console import plain_console
    from fleetmap.recordings import FrameSelection
    from mapserver.nightly.night import NightRequest, run_night

    FrameSelection.parse(options.frames)
    settings, build = settings_of(context), options.build_options(context, report=None)
    retention = settings.ingest.retention()
    request = NightRequest(
        options.site, options.inbox, options.store, time.time_ns(), options.settle_s, build, retention
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
    typer.echo(sentence)


def _write_report(options: NightlyOptions) -> None:
    from fleetmap.encoding import to_json
    from mapserver.nightly.night import last_report

    report = options.report
    content = None if report is None else last_report(options.store, options.site)
    if report is None or content is None:
        return
    with disk_errors(f"{report} cannot be written", "the store's jobs hold the same report"):
        report.write_bytes(to_json(content, indent=2) + b"\n")
