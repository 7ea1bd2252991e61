"""Checks before a survey: a recording that could only make a wrong map is refused, a clock offset is corrected."""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.recordings import Recording, format_calibration
from fleetmap.sensors.calibration import RigCalibration
from mapserver.calibration import CalibrationParameter as P
from mapserver.calibration.recordings import Follow, stretches
from mapserver.doctor import Finding, Verdict, accelerometer_images, images, run_checks
from mapserver.doctor.calibration import SURE_SIGMAS, corrected, in_words, measure_calibration
from mapserver.doctor.findings import grouped
from mapserver.doctor.gyro_images import SAME_OFFSET_S
from mapserver.doctor.metres import METRES, WHEELS
from mapserver.doctor.rig import further_findings
from mapserver.doctor.run_checks import CheckResults, run_cheap_checks
from mapserver.quality.figures import RigEvidence
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyTools

# Wrong units, axes or cameras: a survey would not fail but give a wrong map. Gaps, blur and damage are tolerated.
DECISIVE = {"camera-imu overlap", "gravity magnitude", "left and right", "epipolar error", "depth", "repeated images"}
DECISIVE |= {"gyro scale", "gyro axes", accelerometer_images.NAME, METRES, images.FIXED_PATTERN, images.LENS, *P}
PAIR = "pair geometry"
# Properties of a map that depend on the calibration only, and the checks that judge them.
SUBJECTS = {
    "metric scale": ("baseline", "focal length"),
    "images against IMU": ("gyro axes",),  # a mirrored video, and another run's IMU
    PAIR: ("left and right", "epipolar error", "focal ratio", "pair pitch", "pair yaw", "pair roll"),
}
_CORRECTED_FROM_S = 0.004  # two of the odometry's own sigmas: below, odometry estimates it itself


@dataclass(frozen=True)
class CheckedRecording:
    """A recording fit to be surveyed.

    rig: its calibration, corrected if needed. findings: all findings of the doctor. calibration: those on the calibration that
    came with the recording. corrections: by parameter, in its unit. held: reasons for corrections that were not made.
    """

    rig: RigCalibration
    findings: list[Finding]
    calibration: RigEvidence
    corrections: dict[str, float]
    held: Mapping[str, str] = field(default_factory=dict)

    @property
    def lacks_pair(self) -> bool:
        """True if the angle between the two cameras of a pair could not be judged."""
        return PAIR in self.calibration.not_judged and P.PAIR_YAW not in self.corrections

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
        held = (f"not corrected: {name}: {reason}" for name, reason in self.held.items())
        return [*words, *held, *([said] if done else [])]


def drops_wheels(findings: Sequence[Finding]) -> bool:
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
    refuse = partial(_refuse, recording)
    checks = run_checks(recording, on_frame, executor, follow, refuse)
    refuse(checks.findings)
    used = replace(recording, wheel=()) if drops_wheels(checks.findings) else recording
    given = fingerprint(recording.calibration)
    gyro_s = checks.gyro.offset_s if checks.gyro is not None and checks.gyro.is_sure else None
    held = _unconfirmed(checks, gyro_s)
    rig, corrections = corrected(recording.calibration, checks.calibration, held)
    again: list[Finding] = []
    if corrections:
        follow = follow or stretches(SurveySettings(), SurveyTools(executor=executor))
        measured = measure_calibration(replace(used, calibration=rig), follow)
        again = [f for f in measured.findings if f.verdict in (Verdict.WARN, Verdict.FAIL)]
    elif P.TIME_OFFSET.value not in held and gyro_s is not None and abs(gyro_s) >= _CORRECTED_FROM_S:
        corrections = {P.TIME_OFFSET.value: round(gyro_s, 7)}
        moved = tuple(replace(camera, imu_minus_cam_s=camera.imu_minus_cam_s + gyro_s) for camera in rig.cameras)
        rig = replace(rig, cameras=moved)
    settled = [f for f in checks.findings if f.name not in corrections or f.verdict is not Verdict.WARN]
    found = rig_evidence(given, [*settled, *(replace(f, sentence=f"after its correction {f.sentence}") for f in again)])
    return CheckedRecording(rig, checks.findings, found, corrections, held)


def _unconfirmed(checks: CheckResults, gyro_s: float | None) -> dict[str, str]:
    """Return the reasons not to correct parameters that move the metres: something else must say the same. gyro_s: offset by the gyro.

    An offset is measured by the adjustment and by the gyro; where only the gyro knows it, in two stretches. Baseline and focal length
    must not leave the metres of wheels or accelerometer.
    """
    estimate, wrong, held = checks.calibration.estimate, checks.calibration.wrong(), dict[str, str]()
    clock = None if estimate is None else estimate.get(P.TIME_OFFSET)
    gyro = checks.gyro
    is_repeated = gyro is not None and (abs(gyro.offsets_s - gyro.offset_s) <= SAME_OFFSET_S).sum() > 1
    is_known = clock is not None and SURE_SIGMAS * clock.sigma < SAME_OFFSET_S
    if clock is not None and is_known and abs(clock.estimate - (gyro_s or 0.0)) > SAME_OFFSET_S:
        turns = "nothing sure" if gyro_s is None else f"{1e3 * gyro_s:+.1f} ms"
        held[P.TIME_OFFSET] = f"{1e3 * clock.estimate:+.1f} ms by the adjustment, {turns} by the gyro's turns"
    elif not is_known and gyro_s is not None and not (abs(gyro_s) < _CORRECTED_FROM_S or is_repeated):
        held[P.TIME_OFFSET] = f"{1e3 * gyro_s:+.1f} ms in one stretch of the drive only; drive more turns"
    moved = [p for p in (P.BASELINE, P.FOCAL) if p in wrong]
    scale = float(np.prod([1 + estimate.get(p).estimate for p in moved])) if estimate is not None else 1.0
    for name, (metres, sigma) in checks.metres.items():
        sigma_all = float(np.hypot(sigma / metres, P.WHEEL_SCALE.prior_sigma))
        if abs(np.log(metres / scale)) > max(SURE_SIGMAS * sigma_all, abs(np.log(metres))):
            held |= dict.fromkeys(moved, f"a metre of the images is {metres:.3f} m by {name}, not {scale:.3f} m")
    return {str(parameter): reason for parameter, reason in held.items()}


def with_further_views(result: CheckedRecording, recording: Recording) -> CheckedRecording:
    """Add the findings of a rig's cameras but the first. RecordingError if a decisive check of one failed, or a mounting is wrong."""
    beside = further_findings(recording)
    _refuse(recording, beside)
    return replace(result, findings=[*result.findings, *beside])


def refuse_hopeless(recording: Recording) -> None:
    """Raise RecordingError for what `checked` would refuse, as far as a check within a second shows it, before a useless drive."""
    _refuse(recording, run_cheap_checks(recording))


def _refuse(recording: Recording, findings: Sequence[Finding]) -> None:
    for finding in findings:
        check, beside, _ = finding.name.partition(" of cam")
        is_mounting = not beside and " against cam" in finding.name
        if finding.verdict is Verdict.FAIL and (check in DECISIVE or is_mounting):
            raise RecordingError(
                f"{recording.path}: {finding.name}: {finding.sentence}; a map of it would be wrong. "
                "`mapserver doctor` shows every check"
            )
