"""Checks before a survey: a recording that could only make a wrong map is refused, a clock offset is corrected."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from fleetmap.errors import RecordingError
from fleetmap.recordings import Recording, format_calibration
from fleetmap.sensors.calibration import RigCalibration
from mapserver.doctor import Finding, Verdict, run_checks
from mapserver.quality.figures import RigEvidence
from mapserver.survey.executor import SERIAL, Executor

# Wrong units, axes or cameras: a survey would not fail on them but be wrong. Gaps, blur and damage it can cope with.
DECISIVE = {"camera-imu overlap", "gravity magnitude", "left and right", "epipolar error", "stereo against motion"}
DECISIVE |= {"gyro scale", "gyro axes"}
# What nothing but the calibration tells a map, and the checks that judge it.
SUBJECTS = {"pair geometry": ("left and right", "epipolar error", "stereo against motion")}
SAMPLED_FRAMES, TURN_FRAMES = 20, 120
_CORRECTED_FROM_S = 0.004  # two of the odometry's own sigmas: below, it finds the rest itself


@dataclass(frozen=True)
class CheckedRecording:
    """A recording fit to be surveyed, its clocks corrected where that was needed.

    findings: all that the doctor said. calibration: what they say of the calibration that the recording came with.
    """

    recording: Recording
    findings: list[Finding]
    calibration: RigEvidence
    correction_s: float = 0.0

    def remarks(self) -> list[str]:
        """The findings that are not good and those that could not be judged, in words, and what was done about them."""
        words = [f"{f.name}: {f.sentence}" for f in self.findings if f.verdict is not Verdict.OK]
        if self.correction_s:
            words.append(
                f"corrected: the time between camera and IMU by {self.correction_s * 1e3:+.1f} ms, as measured"
            )
        return words


def fingerprint(calibration: RigCalibration) -> str:
    """A short name of the calibration: equal for equal files."""
    return hashlib.sha256(format_calibration(calibration).encode()).hexdigest()[:12]


def rig_evidence(rig: str, findings: Sequence[Finding]) -> RigEvidence:
    """A subject is judged where all of its checks are good, doubted where one warns, and else lacks what they lack."""
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
    found = rig_evidence(fingerprint(recording.calibration), checks.findings)
    offset_s = checks.measured_offset_s
    if offset_s is None or abs(offset_s) < _CORRECTED_FROM_S:
        return CheckedRecording(recording, checks.findings, found)
    return CheckedRecording(with_clock(recording, offset_s), checks.findings, found, offset_s)


def with_clock(recording: Recording, correction_s: float) -> Recording:
    """The recording with so much added to the time between IMU and cameras."""
    if correction_s == 0.0:
        return recording
    cameras = tuple(
        replace(camera, imu_minus_cam_s=camera.imu_minus_cam_s + correction_s)
        for camera in recording.calibration.cameras
    )
    return replace(recording, calibration=replace(recording.calibration, cameras=cameras))
