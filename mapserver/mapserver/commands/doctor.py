"""`mapserver doctor`: checks of a recording."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleetmap.cli_options import TopicNames
from fleetmap.errors import UsageError

if TYPE_CHECKING:
    from rich.console import Console

    from fleetmap.recordings import Recording
    from mapserver.doctor import Finding

EXIT_STATUS_BAD_RECORDING = 3


def doctor(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="Folder or file to check.")],
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the findings here as JSON too.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", metavar="FILE", help="Kalibr camchain to check against.")
    ] = None,
    topic: TopicNames = None,
) -> None:
    """Check RECORDING: rates, gaps, clocks, gravity, stereo and gyro against the images.

    Status 3 if a check fails.
    """
    if json_file is not None and not json_file.parent.is_dir():
        raise UsageError(f"--json {json_file}: the folder {json_file.parent} does not exist; create it first")
    from rich.console import Console
    from rich.progress import Progress

    from fleetmap.recordings import OpenOptions, named_topics, open_recording
    from mapserver.doctor import Verdict, run_checks
    from mapserver.doctor.calibration import followed_frames
    from mapserver.doctor.findings import worst
    from mapserver.doctor.run_checks import SAMPLED_FRAMES, TURN_FRAMES

    with open_recording(recording, OpenOptions(calibration, named_topics(topic))) as source:
        with Progress(console=Console(stderr=True), transient=True) as progress:
            wanted = min(SAMPLED_FRAMES, len(source)) + (min(TURN_FRAMES, len(source)) if len(source.imu) else 0)
            task = progress.add_task("frames, and steps of the adjustment", total=wanted + followed_frames(source))
            findings = run_checks(source, lambda: progress.advance(task)).findings
        _print(Console(), source, findings)
        if json_file is not None:
            json_file.write_text(_as_json(source, findings), encoding="utf-8")
    if worst(findings) is Verdict.FAIL:
        raise typer.Exit(EXIT_STATUS_BAD_RECORDING)


def _print(console: "Console", source: "Recording", findings: "list[Finding]") -> None:
    from rich.table import Table
    from rich.text import Text

    colours = {"ok": "green", "warn": "yellow", "fail": "bold red", "not judged": "dim"}
    duration_s = float(source.frame_stamps_ns[-1] - source.frame_stamps_ns[0]) * 1e-9
    table = Table(
        title=f"{source.name}: {source.format}, {source.sensor_set}, {len(source)} frames, {duration_s:.1f} s"
    )
    for column in ("check", "verdict", "finding"):
        table.add_column(column, overflow="fold")
    for finding in findings:
        verdict = Text(finding.verdict.value, colours[finding.verdict.value])
        table.add_row(Text(finding.name), verdict, Text(finding.sentence))
    console.print(table)


def _as_json(source: "Recording", findings: "list[Finding]") -> str:
    from fleetmap.encoding import to_json
    from mapserver.doctor.findings import worst

    report = {
        "recording": source.name,
        "format": source.format,
        "sensor_set": source.sensor_set.value,
        "frames": len(source),
        "imu_samples": len(source.imu),
        "duration_s": float(source.frame_stamps_ns[-1] - source.frame_stamps_ns[0]) * 1e-9,
        "verdict": worst(findings).value,
        "findings": findings,
    }
    return to_json(report, indent=2).decode() + "\n"
