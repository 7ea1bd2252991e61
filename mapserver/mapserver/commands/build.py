"""`mapserver build`: recordings become a draft in the store."""

from pathlib import Path
from typing import Annotated

import typer

from fleetmap.errors import UsageError
from mapserver.commands.config_option import ConfigFile, config_path


def build(
    context: typer.Context,
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING...", help="Folder or .mcap file to survey.")],
    site: Annotated[str, typer.Option(help="Name of the site.")],
    store: Annotated[Path, typer.Option(help="Folder of the map store; made if it is not there.")],
    frames: Annotated[str, typer.Option(metavar="A:B:C", help="Slice of the frames that take part.")] = "::",
    calibration: Annotated[Path | None, typer.Option(metavar="FILE", help="Kalibr camchain to use.")] = None,
    zones: Annotated[
        Path | None, typer.Option(metavar="FILE", help="TOML file with areas that never see each other.")
    ] = None,
    vocabulary: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Words of `train-vocabulary` for the site's first map.")
    ] = None,
    report: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the JSON report here.")] = None,
    trajectory: Annotated[Path | None, typer.Option(metavar="FILE.tum", help="Write all frames' poses here.")] = None,
    picture: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Draw the map from above here.")] = None,
    frame_from_ground_truth: Annotated[
        bool, typer.Option("--frame-from-ground-truth", help="Place the finished map in the ground truth's frame.")
    ] = False,
    use: Annotated[
        str | None, typer.Option(metavar="SENSORS", help="Use only the sensors of this set, of those it has.")
    ] = None,
    replay: Annotated[
        list[Path] | None,
        typer.Option(metavar="RECORDING", help="Earlier recording of the current version to look for in the draft."),
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Threads that survey; as many as there are cores if left out.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Survey on this dask cluster; `local` makes one of processes here."),
    ] = None,
    config: ConfigFile = None,
) -> None:
    """Survey the recordings, join them to the site's current version, and store the map as a draft."""
    for option, path in (("--report", report), ("--trajectory", trajectory), ("--picture", picture)):
        if path is not None and (path.is_dir() or not path.parent.is_dir()):
            raise UsageError(f"{option} {path}: name a file in a folder that exists")
    if picture is not None and picture.suffix.lower() != ".png":
        raise UsageError(f"--picture {picture} does not end in .png; name it so, other types are not drawn")
    from fleetmap.mapformat import check_name

    check_name(site, "site")
    from mapserver.build.build import BuildRequest, run_build
    from mapserver.build.sensor_subset import named_sensor_set, sensor_set_of
    from mapserver.config import read_config, survey_settings

    sensors = None if use is None else named_sensor_set(use)
    order = BuildRequest(
        tuple(recordings),
        site,
        store,
        frames,
        calibration,
        zones,
        vocabulary,
        report,
        trajectory,
        picture,
        frame_from_ground_truth,
        sensors,
        tuple(replay or ()),
        threads=threads,
        scheduler=scheduler,
    )
    read_config(config_path(context))
    settings = survey_settings(config_path(context), sensors or sensor_set_of(recordings[0], calibration))
    typer.echo(run_build(order, settings))
