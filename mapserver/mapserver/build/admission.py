"""Checks before a survey: a recording that could only make a wrong map is refused, a clock offset is corrected."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from fleetmap.errors import RecordingError
from fleetmap.recordings import Recording
from mapserver.doctor import Finding, Verdict, run_checks
from mapserver.survey.executor import SERIAL, Executor

# Wrong units, axes or cameras: a survey would not fail on them but be wrong. Gaps, blur and damage it can cope with.
DECISIVE = {"camera-imu overlap", "gravity magnitude", "left and right", "epipolar error", "stereo against motion"}
DECISIVE |= {"gyro scale", "gyro axes"}
SAMPLED_FRAMES, TURN_FRAMES = 20, 120
_CORRECTED_FROM_S = 0.004  # two of the odometry's own sigmas: below, it finds the rest itself


@dataclass(frozen=True)
class CheckedRecording:
    """A recording fit to be surveyed, its clocks corrected where that was needed; findings: all that the doctor said."""

    recording: Recording
    findings: list[Finding]
    correction_s: float = 0.0

    def remarks(self) -> list[str]:
        """The findings that are not good, in words, and what was done about them."""
        words = [f"{f.name}: {f.sentence}" for f in self.findings if f.verdict in (Verdict.WARN, Verdict.FAIL)]
        if self.correction_s:
            words.append(
                f"corrected: the time between camera and IMU by {self.correction_s * 1e3:+.1f} ms, as measured"
            )
        return words


def checked(
    recording: Recording, on_frame: Callable[[], None] = lambda: None, executor: Executor = SERIAL
) -> CheckedRecording:
    """The recording with what was found in it. RecordingError where a check that decides failed."""
    checks = run_checks(recording, on_frame, sampled=SAMPLED_FRAMES, turn_frames=TURN_FRAMES, executor=executor)
    for finding in checks.findings:
        if finding.verdict is Verdict.FAIL and finding.name in DECISIVE:
            raise RecordingError(
                f"{recording.path}: {finding.name}: {finding.sentence}; a map of it would be wrong. "
                "`mapserver doctor` shows every check"
            )
    offset_s = checks.measured_offset_s
    if offset_s is None or abs(offset_s) < _CORRECTED_FROM_S:
        return CheckedRecording(recording, checks.findings)
    return CheckedRecording(with_clock(recording, offset_s), checks.findings, offset_s)


def with_clock(recording: Recording, correction_s: float) -> Recording:
    """The recording with so much added to the time between IMU and cameras."""
    if correction_s == 0.0:
        return recording
    cameras = tuple(
        replace(camera, imu_minus_cam_s=camera.imu_minus_cam_s + correction_s)
        for camera in recording.calibration.cameras
    )
    return replace(recording, calibration=replace(recording.calibration, cameras=cameras))
