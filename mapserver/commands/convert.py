"""`mapserver convert`: a recording of any format as one MCAP file."""

from pathlib import Path
from typing import Annotated

import typer

from fleetmap.cli_options import TopicNames
from fleetmap.errors import UsageError


def convert(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="Folder or file to read.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.mcap", help="MCAP file to write.")],
    calibration: Annotated[
        Path | None, typer.Option("--calibration", metavar="FILE", help="Kalibr camchain to use and to store.")
    ] = None,
    topic: TopicNames = None,
    force: Annotated[bool, typer.Option("--force", help="Replace OUT.mcap if it exists.")] = False,
) -> None:
    """Write RECORDING as an MCAP file in the style of rosbag2, images as they were encoded."""
    if out.suffix != ".mcap":
        raise UsageError(f"{out} must end in .mcap")
    if out.exists() and not force:
        raise UsageError(f"{out} exists; choose another name or replace it with --force")
    if out.exists() and recording.exists() and out.samefile(recording):
        raise UsageError(f"{out} is the recording itself; choose another name")
    from rich.progress import Progress

    from fleetmap.console import plain_console
    from fleetmap.recordings import OpenOptions, named_topics, open_recording
    from fleetmap.recordings.mcap.writer import copy_to_mcap

    console = plain_console(stderr=True)
    with open_recording(recording, OpenOptions(calibration, named_topics(topic))) as source:
        for issue in source.issues:
            console.print(f"issue: {issue.what}: {issue.detail}", markup=False)
        with Progress(console=console) as progress:
            task = progress.add_task("frames", total=len(source))
            copy_to_mcap(source, out, lambda: progress.advance(task))
        console.print(
            f"{out}: {len(source)} frames, {len(source.imu)} inertial samples, {source.sensor_set}", markup=False
        )
