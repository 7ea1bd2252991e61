"""`mapserver doctor` and `convert`: checks of a recording, and a recording of any format as one MCAP file."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Exit, Option, echo

from fleetmap.cli_options import TopicNames
from fleetmap.errors import UsageError

if TYPE_CHECKING:
    from fleetmap.recordings import Recording
    from mapserver.doctor import Finding

EXIT_STATUS_BAD_RECORDING = 3
_STDOUT = Path("-")


def doctor(
    recording: Annotated[Path, Argument(metavar="RECORDING", help="Folder or file to check.")],
    json_file: Annotated[
        Path | None, Option("--json", metavar="FILE", help="Write the findings here as JSON too; - prints JSON alone.")
    ] = None,
    calibration: Annotated[
        Path | None, Option("--calibration", metavar="FILE", help="Kalibr camchain to check against.")
    ] = None,
    topic: TopicNames = None,
) -> None:
    """Check RECORDING: rates, gaps, clocks, gravity, stereo and gyro against the images.

    Status 3 if a check fails.
    """
    if json_file is not None and not json_file.parent.is_dir():
        raise UsageError(f"--json {json_file}: the folder {json_file.parent} does not exist; create it first")
    from rich.progress import Progress

    from fleetmap.console import plain_console
    from fleetmap.recordings import OpenOptions, named_topics, open_recording
    from mapserver.doctor import Verdict
    from mapserver.doctor.findings import worst
    from mapserver.doctor.rig import check_rig, frames_of_rig

    with open_recording(recording, OpenOptions(calibration, named_topics(topic))) as source:
        with Progress(console=plain_console(stderr=True), transient=True) as progress:
            task = progress.add_task("frames, and steps of the adjustment", total=frames_of_rig(source))
            findings = check_rig(source, lambda: progress.advance(task))
        if json_file != _STDOUT:
            _print(source, findings)
        if json_file == _STDOUT:
            echo(_as_json(source, findings), nl=False)
        elif json_file is not None:
            json_file.write_text(_as_json(source, findings), encoding="utf-8")
    if worst(findings) is Verdict.FAIL:
        raise Exit(EXIT_STATUS_BAD_RECORDING)


def _print(source: "Recording", findings: "list[Finding]") -> None:
    """Print a summary line, then the findings, the worst first; those with the same missing sensor in one row."""
    from rich.table import Table
    from rich.text import Text

    from fleetmap.console import plain_console
    from mapserver.doctor import Verdict
    from mapserver.doctor.findings import grouped, summary
    from mapserver.drafting.admission import DECISIVE

    console = plain_console()
    duration_s = float(source.frame_stamps_ns[-1] - source.frame_stamps_ns[0]) * 1e-9
    console.print(f"{source.name}: {source.format}, {source.sensor_set}, {len(source)} frames, {duration_s:.1f} s")
    console.print(summary(findings, DECISIVE))
    colours = {Verdict.OK: "green", Verdict.WARN: "yellow", Verdict.FAIL: "bold red", Verdict.NOT_JUDGED: "dim"}
    table = Table()
    for column in ("check", "verdict", "finding"):
        table.add_column(column, overflow="fold")
    for same, sentence in sorted(grouped(findings), key=lambda group: -list(Verdict).index(group[0][0].verdict)):
        verdict = same[0].verdict
        words = sentence.removeprefix(f"{Verdict.NOT_JUDGED}: ")
        table.add_row(", ".join(finding.name for finding in same), Text(verdict, colours[verdict]), words)
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


def convert(
    recording: Annotated[Path, Argument(metavar="RECORDING", help="Folder or file to read.")],
    out: Annotated[Path, Argument(metavar="OUT.mcap", help="MCAP file to write.")],
    calibration: Annotated[
        Path | None, Option("--calibration", metavar="FILE", help="Kalibr camchain to use and to store.")
    ] = None,
    topic: TopicNames = None,
    force: Annotated[bool, Option("--force", help="Replace OUT.mcap if it exists.")] = False,
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
