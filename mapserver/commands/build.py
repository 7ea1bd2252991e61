"""`mapserver build`: recordings become a draft in the store."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import ConfigFile, expand_options
from fleetmap.errors import UsageError
from mapserver.commands.options import SurveyOptions, check_output

if TYPE_CHECKING:
    from mapserver.drafting.trajectory import OtherTrajectory


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


@dataclass(frozen=True, kw_only=True)
class GivenTrajectoryOptions:
    """Another system's poses to begin with, and what is known of them."""

    trajectory: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Poses of another SLAM system to begin with.")
    ] = None
    trajectory_frame: Annotated[
        str | None, typer.Option(metavar="NAME", help="Poses of the `camera` (default) or of the `body`.")
    ] = None
    trajectory_scale: Annotated[
        float | None, typer.Option(metavar="METRES", help="Metres in their unit of length.")
    ] = None

    def given(self) -> "OtherTrajectory | None":
        """The trajectory that is named, None without one; UsageError for options that say something of none."""
        from mapserver.drafting.trajectory import OtherTrajectory

        if self.trajectory is None:
            said = [name for name, value in vars(self).items() if value is not None]
            if said:
                raise UsageError(f"--{said[0].replace('_', '-')} says something of --trajectory FILE, which is missing")
            return None
        return OtherTrajectory(self.trajectory, self.trajectory_frame or "camera", self.trajectory_scale)


@expand_options
def build(
    context: typer.Context,
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING...", help="Folder or file to survey.")],
    options: BuildCommandOptions,
    trajectory: GivenTrajectoryOptions,
    config: ConfigFile = None,
) -> None:
    """Survey the recordings, join them to the site's current version, and store the map as a draft."""
    check_output("--trajectory-out", options.trajectory_out)
    check_output("--picture", options.picture, ".png")
    options.check()
    from mapserver import build_map
    from mapserver.drafting.sensor_subset import named_sensor_set

    built = build_map(
        recordings,
        options.store,
        options.site,
        options.build_options(
            context,
            use=None if options.use is None else named_sensor_set(options.use),
            replay=tuple(options.replay or ()),
            trajectory=trajectory.given(),
            trajectory_out=options.trajectory_out,
            picture=options.picture,
            frame_from_ground_truth=options.frame_from_ground_truth,
        ),
    )
    typer.echo(built.sentence)
