"""Checks before a survey: a recording that could only make a wrong map is refused, a clock offset is corrected."""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from fleetmap.errors import RecordingError
from fleetmap.recordings import Recording, format_calibration
from fleetmap.sensors.calibration import RigCalibration
from mapserver.calibration import CalibrationParameter
from mapserver.calibration.recordings import Follow
from mapserver.doctor import Finding, Verdict, accelerometer_images, images, run_checks
from mapserver.doctor.calibration import TOLERANCES, corrected, in_words, measure_calibration
from mapserver.doctor.findings import grouped
from mapserver.doctor.metres import METRES, WHEELS
from mapserver.doctor.rig import further_findings
from mapserver.doctor.run_checks import run_cheap_checks
from mapserver.quality.figures import RigEvidence
from mapserver.survey.executor import SERIAL, Executor

# Wrong units, axes or cameras: a survey would not fail but give a wrong map. Gaps, blur and damage are tolerated.
DECISIVE = {"camera-imu overlap", "gravity magnitude", "left and right", "epipolar error", "depth"}
DECISIVE |= {
    "gyro scale",
    "gyro axes",
    accelerometer_images.NAME,
    METRES,
    "repeated images",
    images.FIXED_PATTERN,
    images.LENS,
    *(parameter.value for parameter in TOLERANCES),
}
# Properties of a map that depend on the calibration only, and the checks that judge them.
SUBJECTS = {
    "metric scale": ("baseline", "focal length"),
    "images against IMU": ("gyro axes",),  # a mirrored video, and another run's IMU
    "pair geometry": ("left and right", "epipolar error", "focal ratio", "pair pitch", "pair yaw", "pair roll"),
}
SAMPLED_FRAMES, TURN_FRAMES = 20, 120
_CORRECTED_FROM_S = 0.004  # two of the odometry's own sigmas: below, odometry estimates it itself


@dataclass(frozen=True)
class CheckedRecording:
    """A recording fit to be surveyed.

    rig: its calibration, corrected if needed. findings: all findings of the doctor. calibration: those on the calibration that
    came with the recording. corrections: by parameter, in its unit.
    """

    rig: RigCalibration
    findings: list[Finding]
    calibration: RigEvidence
    corrections: dict[str, float]

    @property
    def leaves_wheels_out(self) -> bool:
        """True if all other sensors contradict the wheels."""
        return leaves_wheels_out(self.findings)

    def statements(self) -> list[str]:
        """Each finding that is not good or not judged, as text, with the correction made."""
        return self._with_corrections(f"{f.name}: {f.sentence}" for f in self.findings if f.verdict is not Verdict.OK)

    def remarks(self) -> list[str]:
        """The statements, with one remark for all checks that lack the same data; measured ones keep their value."""
        bad = [finding for finding in self.findings if finding.verdict is not Verdict.OK]
        return self._with_corrections(
            f"not judged: {', '.join(f.name for f in same)}: {same[0].missing}"
            if len(same) > 1
            else f"{same[0].name}: {sentence}"
            for same, sentence in grouped(bad)
        )

    def _with_corrections(self, words: Iterable[str]) -> list[str]:
        done = ", ".join(f"{name} by {in_words(name, value)}" for name, value in self.corrections.items())
        said = f"corrected: {done}, as measured; robots that use this calibration file keep its error"
        return [*words, said] if done else list(words)


def leaves_wheels_out(findings: Sequence[Finding]) -> bool:
    """True if all other sensors contradict the wheels."""
    return any(f.name == WHEELS and f.verdict is Verdict.FAIL for f in findings)


def fingerprint(calibration: RigCalibration) -> str:
    """Return a short hash of the calibration: equal for equal files."""
    return hashlib.sha256(format_calibration(calibration).encode()).hexdigest()[:12]


def rig_evidence(rig: str, findings: Sequence[Finding]) -> RigEvidence:
    """Return evidence per subject: judged if all of its checks are good, doubted if one warns, else with their missing data."""
    judged, lacking, doubted = [], {}, {}
    for subject, names in SUBJECTS.items():
        found = [finding for finding in findings if finding.name in names]
        bad = [f.sentence for f in found if f.verdict in (Verdict.WARN, Verdict.FAIL)]
        missing = dict.fromkeys(f.missing for f in found if f.verdict is Verdict.NOT_JUDGED)
        if bad:
            doubted[subject] = "; ".join(bad)
        elif missing:
            lacking[subject] = "; ".join(missing)
        elif found:
            judged.append(subject)
    return RigEvidence(rig, judged, lacking, doubted)


def checked(
    recording: Recording,
    on_frame: Callable[[], None] = lambda: None,
    executor: Executor = SERIAL,
    follow: Follow | None = None,
) -> CheckedRecording:
    """Return the findings of the recording, and the calibration for its survey. RecordingError if a decisive check failed.

    A certainly wrong parameter is corrected, and the recording measured again: if that finds another error, the
    evidence conflicts and an operator must check it.
    """
    limits = {"sampled": SAMPLED_FRAMES, "turn_frames": TURN_FRAMES}
    refuse = partial(_refuse, recording)
    checks = run_checks(recording, on_frame, **limits, executor=executor, follow=follow, before_calibration=refuse)
    refuse(checks.findings)
    used = replace(recording, wheel=()) if leaves_wheels_out(checks.findings) else recording
    given = fingerprint(recording.calibration)
    rig, corrections = corrected(recording.calibration, checks.calibration)
    again: list[Finding] = []
    if corrections:
        measured = measure_calibration(replace(used, calibration=rig), on_frame, executor, follow)
        again = [f for f in measured.findings if f.verdict in (Verdict.WARN, Verdict.FAIL)]
    elif checks.measured_offset_s is not None and abs(checks.measured_offset_s) >= _CORRECTED_FROM_S:
        corrections = {CalibrationParameter.TIME_OFFSET.value: round(checks.measured_offset_s, 7)}
        rig = _with_clock(rig, checks.measured_offset_s)
    settled = [f for f in checks.findings if f.name not in corrections or f.verdict is not Verdict.WARN]
    found = rig_evidence(given, [*settled, *(replace(f, sentence=f"after its correction {f.sentence}") for f in again)])
    return CheckedRecording(rig, checks.findings, found, corrections)


def with_further_views(result: CheckedRecording, recording: Recording) -> CheckedRecording:
    """Add the findings of a rig's views but the first. RecordingError if a decisive check of one failed, or a mounting is wrong."""
    beside = further_findings(recording)
    _refuse(recording, beside)
    return replace(result, findings=[*result.findings, *beside])


def refuse_hopeless(recording: Recording) -> None:
    """Raise RecordingError for what `checked` would refuse, as far as a check within a second shows it, before a useless drive."""
    _refuse(recording, run_cheap_checks(recording, SAMPLED_FRAMES))


def _refuse(recording: Recording, findings: Sequence[Finding]) -> None:
    for finding in findings:
        check, beside, _ = finding.name.partition(" of cam")
        is_mounting = not beside and " against cam" in finding.name
        if finding.verdict is Verdict.FAIL and (check in DECISIVE or is_mounting):
            raise RecordingError(
                f"{recording.path}: {finding.name}: {finding.sentence}; a map of it would be wrong. "
                "`mapserver doctor` shows every check"
            )


def _with_clock(rig: RigCalibration, correction_s: float) -> RigCalibration:
    """Return the calibration with this added to the time between IMU and cameras."""
    moved = tuple(replace(camera, imu_minus_cam_s=camera.imu_minus_cam_s + correction_s) for camera in rig.cameras)
    return replace(rig, cameras=moved)
