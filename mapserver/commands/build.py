"""`mapserver build`: a draft in the store from recordings."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Context, Option, echo

from fleetmap.errors import UsageError
from mapserver.commands.options import SurveyOptions, check_output

if TYPE_CHECKING:
    from mapserver.drafting.survey_recordings import StartPoses


@dataclass(frozen=True, kw_only=True)
class BuildCommandOptions(SurveyOptions):
    """Options of `build` beside those of `nightly`."""

    trajectory_out: Annotated[
        Path | None, Option(metavar="FILE.tum", help="Write the poses of all frames to this file.")
    ] = None
    picture: Annotated[Path | None, Option(metavar="FILE.png", help="Draw the map from above into this file.")] = None
    frame_from_ground_truth: Annotated[
        bool, Option("--frame-from-ground-truth", help="Align the finished map with the ground truth.")
    ] = False
    use: Annotated[str | None, Option(metavar="SENSORS", help="Use only these sensors of the recording.")] = None
    replay: Annotated[
        list[Path] | None,
        Option(metavar="RECORDING", help="Earlier recording of the current version to localize in the draft."),
    ] = None


def build(
    context: Context,
    recordings: Annotated[list[Path], Argument(metavar="RECORDING...", help="Folder or file to survey.")],
    options: BuildCommandOptions,
    trajectory: Annotated[
        Path | None, Option(metavar="FILE", help="Poses of another SLAM system as the start.")
    ] = None,
    trajectory_frame: Annotated[
        str | None, Option(metavar="NAME", help="Poses of the `camera` (default) or of the `body`.")
    ] = None,
    trajectory_scale: Annotated[float | None, Option(metavar="METRES", help="Metres in their unit of length.")] = None,
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
    echo(built.sentence)


def _other_trajectory(file: Path | None, frame: str | None, scale: float | None) -> "StartPoses | None":
    from fleetmap.hooks import plugin

    if file is not None:
        opened: StartPoses = plugin("mapserver.poses", "trajectory", "--trajectory")(file, frame or "camera", scale)
        return opened
    for option, value in (("--trajectory-frame", frame), ("--trajectory-scale", scale)):
        if value is not None:
            raise UsageError(f"{option} describes --trajectory FILE, which is missing; add it")
    return None
