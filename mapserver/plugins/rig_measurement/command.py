"""`mapserver calibrate`: a rig's calibration measured from its recordings."""

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Context, Option, echo

from fleetmap.cli_options import TopicNames, config_path
from fleetmap.errors import RecordingError, UsageError, disk_errors
from mapserver.commands.options import Calibration, check_output, print_result, table, topics_of

if TYPE_CHECKING:
    from fleetmap.recordings import Recording, Topics
    from fleetmap.sensors.calibration import RigCalibration
    from mapserver.calibration import CalibrationEstimate, ParameterEstimate
    from mapserver.survey.survey_inputs import SurveyTools


def calibrate(
    context: Context,
    recordings: Annotated[list[Path], Argument(metavar="RECORDING...", help="Folders or files of one rig.")],
    out: Annotated[
        Path | None, Option(metavar="FILE.yaml", help="Write the corrected calibration here, as a Kalibr camchain.")
    ] = None,
    calibration: Calibration = None,
    topic: TopicNames = None,
    guess: Annotated[
        str | None,
        Option(
            metavar="WxH:M", help="Without a calibration: raw image size and metres between the cameras, 752x480:0.11."
        ),
    ] = None,
) -> None:
    """Measure the calibration of cameras, IMU and wheels from recordings with turns, and write it.

    Parameters that the recordings cannot show keep their values. With --guess no calibration is needed: lenses and the
    pair's angles are estimated from focal length = image width, by the images alone.
    """
    check_output("--out", out)
    from fleetmap.recordings import OpenOptions, open_recording

    topics = topics_of(context, topic)
    if guess is not None:
        _from_guess(recordings, out, guess, config_path(context), topics)
        return
    from mapserver.calibration import estimate_calibration, stretches
    from mapserver.config import survey_settings

    with ExitStack() as opened:
        how = OpenOptions(calibration, topics)
        recorded = [opened.enter_context(open_recording(path, how)) for path in recordings]
        sources = [_sound(recording.view(0)) for recording in recorded]
        settings = survey_settings(config_path(context), sources[0].sensor_set)
        estimate = estimate_calibration(sources, stretches(settings, opened.enter_context(_shown())))
        rig = recorded[0].calibration
    title = f"{estimate.keyframes} keyframes, {estimate.observations} observations; corrections to the calibration"
    verdicts = ("measured" if p.is_judged else f"not judged: {p.reason}" for p in estimate.parameters)
    rows = ((p.name.value, *_in_words(p), said) for p, said in zip(estimate.parameters, verdicts, strict=True))
    print_result(estimate, [table(("parameter", "correction", "sigma", "verdict"), rows, title)])
    if out is None:
        return
    if not any(p.is_judged for p in estimate.parameters):
        raise RecordingError(
            f"--out {out}: nothing could be judged, so nothing is written; the table names the missing motion"
        )
    text = corrected_file(estimate, rig, [source.name for source in sources])
    _write(out, text, f"check it with `mapserver doctor RECORDING --calibration {out}`")


def _sound(recording: "Recording") -> "Recording":
    """Return the recording without damaged images in the tracked stretch, with its issues printed."""
    from mapserver.calibration.recordings import busiest_frames

    sound, _ = recording.readable(busiest_frames(recording.frame_stamps_ns, recording.imu))
    for issue in sound.issues:
        echo(f"issue: {sound.name}: {issue.what}: {issue.detail}", err=True)
    return sound


@contextmanager
def _shown() -> "Iterator[SurveyTools]":
    """Tools of a survey with displayed progress."""
    from fleetmap.console import plain_console
    from mapserver.drafting.progress import ProgressView
    from mapserver.survey.survey_inputs import SurveyTools

    with ProgressView(plain_console(stderr=True)) as view:
        yield SurveyTools(view)


def _write(out: Path, text: str, advice: str) -> None:
    with disk_errors(f"--out {out} cannot be written", "check folder and space", UsageError):
        out.write_text(text, encoding="utf-8")
    echo(f"{out}: written; {advice}")


def _from_guess(recordings: list[Path], out: Path | None, guess: str, config: Path | None, topics: "Topics") -> None:
    from fleetmap.recordings import OpenOptions, format_calibration, open_recording
    from mapserver.config import survey_settings
    from mapserver.plugins.rig_measurement import from_guess

    known = re.fullmatch(r"([1-9]\d{1,4})x([1-9]\d{1,4}):(\d*\.?\d+)", guess)
    baseline_m = float(known[3]) if known else 0.0
    if known is None or not 0.001 < baseline_m < 10.0 or len(recordings) != 1:
        raise UsageError(
            f"--guess {guess} for {len(recordings)} recordings: give the size of the raw images and the metres between the cameras, such "
            "as --guess 752x480:0.11, and one recording"
        )
    with TemporaryDirectory() as folder, _shown() as tools:
        first = Path(folder) / "guess.yaml"
        first.write_text(
            format_calibration(from_guess.first_rig(int(known[1]), int(known[2]), baseline_m)), encoding="utf-8"
        )
        with open_recording(recordings[0], OpenOptions(first, topics)) as recording:
            found = from_guess.calibration_from_guess(
                _sound(recording.view(0)), survey_settings(config, recording.sensor_set), tools
            )
            name = recording.name
    echo("\n".join(from_guess.guessed_in_words(found)))
    if out is not None:
        advice = f"add the pose of the IMU, then calibrate again with --calibration {out}"
        _write(out, from_guess.guessed_file(found, name), advice)


def _in_words(parameter: "ParameterEstimate") -> tuple[str, str]:
    """A correction and its sigma, in per cent, degrees, milliseconds, millimetres or pixels."""
    from mapserver.calibration.parameters import SHOWN

    scale, unit, _ = SHOWN[parameter.name.unit]
    return f"{parameter.estimate * scale:+.3f} {unit}", f"{parameter.sigma * scale:.3f} {unit}"


def corrected_file(estimate: "CalibrationEstimate", rig: "RigCalibration", names: list[str]) -> str:
    """Return the text of a camchain: the corrected rig, with comments on measured and unchanged values."""
    from fleetmap.recordings import format_calibration

    lines = [f"# Measured by `mapserver calibrate` from {', '.join(names)}."]
    for p in estimate.parameters:
        value, sigma = _in_words(p)
        what = f"corrected by {value}, sigma {sigma}" if p.is_judged else f"NOT JUDGED, old value kept: {p.reason}"
        lines.append(f"# {p.name.value}: {what}")
    if len(rig.views) > 1:
        lines.append(
            f"# Cameras from cam{rig.views[1][0]} on are as they were: check their mounting with `mapserver doctor`."
        )
    lines.append("# The wheels' scale and the IMU's noise are for information: this file keeps the noise that it had.")
    return "\n".join(lines) + "\n" + format_calibration(estimate.corrected(rig))
