"""Rates, gaps, order of stamps, and whether camera and IMU ran at the same time."""

from collections.abc import Sequence

import numpy as np

from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import DataIssue, Stamps
from mapserver.doctor.findings import Finding, Limits, Verdict, judge, not_judged

# Ends of issues of recordings that have all of their data
_NOT_LOST = (
    "stamps uncertain",
    "Bayer pattern",
    "depth of another system",
    "not used",
    "not chosen",
    "not read",
    "not registered",
    "not sound",
    "stamps of zero",
    "stamps repeated",
    "stamps far apart",
    "bits in 16",
    "not optical",
)
SPARSE_S = 0.35  # frames further apart than this are keyframes, not a video
RECORD_IMU = "record an IMU"
_ALL_FRAMES = "record every frame of the camera"
_SLOWEST_CAMERA_HZ, _SLOWEST_IMU_HZ = 5.0, 90.0


def median_period_s(stamps_ns: Stamps) -> float:
    """Median step between stamps (N,); inf for fewer than two."""
    return float(np.median(np.diff(stamps_ns))) * 1e-9 if len(stamps_ns) > 1 else float("inf")


def camera_rate(frame_stamps_ns: Stamps) -> Finding:
    """Frames per second, by the median step."""
    period_s = median_period_s(frame_stamps_ns)
    if period_s > SPARSE_S:
        return not_judged("camera rate", f"frames are {period_s:.2f} s apart, this is no video", _ALL_FRAMES)
    return _rate("camera rate", 1 / period_s, _SLOWEST_CAMERA_HZ, "record with a higher frame rate")


def imu_rate(imu_stamps_ns: Stamps) -> Finding:
    """Inertial samples per second, by the median step."""
    if len(imu_stamps_ns) < 2:
        return not_judged("imu rate", "there is no IMU", RECORD_IMU)
    rate_hz = 1 / median_period_s(imu_stamps_ns)
    return _rate("imu rate", rate_hz, _SLOWEST_IMU_HZ, "set the IMU to 200 Hz, slow ones miss vibration and turns")


def imu_noise(calibration: RigCalibration) -> list[Finding]:
    """That nothing says how noisy the IMU is, where that is so."""
    if calibration.imu is None or "imu" not in calibration.assumed:
        return []
    noise = calibration.imu
    words = (
        f"nothing tells it; {noise.gyro_noise_radps_rthz:g} rad/s/sqrt(Hz) and {noise.accel_noise_mps2_rthz:g} m/s^2/sqrt(Hz) are taken, "
        "twice those of an ADIS16448"
    )
    return [not_judged("imu noise", words, "give imu0 with its noise densities in a --calibration FILE")]


def camera_gaps(frame_stamps_ns: Stamps) -> Finding:
    """The longest time without a frame."""
    period_s = median_period_s(frame_stamps_ns)
    if period_s > SPARSE_S:
        return not_judged("camera gaps", f"frames are {period_s:.2f} s apart, this is no video", _ALL_FRAMES)
    return _gaps("camera gaps", frame_stamps_ns, max(3.5 * period_s, 0.3), 2.0, "frames")


def imu_gaps(imu_stamps_ns: Stamps) -> Finding:
    """The longest time without an inertial sample."""
    if len(imu_stamps_ns) < 2:
        return not_judged("imu gaps", "there is no IMU", RECORD_IMU)
    return _gaps("imu gaps", imu_stamps_ns, max(3.5 * median_period_s(imu_stamps_ns), 0.02), 0.2, "inertial samples")


def stamp_order(issues: Sequence[DataIssue]) -> Finding:
    """Whether stamps that do not increase were left out when the recording was opened."""
    found = [issue for issue in issues if "stamps not increasing" in issue.what]
    limit = "none may be out of order"
    if not found:
        return Finding("stamp order", Verdict.OK, 0.0, limit, "all stamps increase")
    words = "; ".join(f"{issue.what}, {issue.detail}" for issue in found)
    sentence = f"{words}; look for a clock that is set while recording, or for a driver that sends late"
    return Finding("stamp order", Verdict.FAIL, float(len(found)), limit, sentence)


def other_issues(issues: Sequence[DataIssue]) -> list[Finding]:
    """One warning for everything else that could not be read, or is not what it should be."""
    odd = [Finding(i.what, Verdict.WARN, None, "", i.detail) for i in issues if i.what.endswith(_NOT_LOST)]
    lost = [i for i in issues if "stamps not increasing" not in i.what and not i.what.endswith(_NOT_LOST)]
    words = [f"{issue.what}: {issue.detail}; copy the recording again if it has more" for issue in lost]
    return [*odd, *(Finding("lost data", Verdict.WARN, None, "nothing lost", sentence) for sentence in words)]


def camera_imu_overlap(frame_stamps_ns: Stamps, imu_stamps_ns: Stamps, imu_minus_cam_s: float) -> Finding:
    """The share of frames during which the IMU ran."""
    if len(imu_stamps_ns) == 0:
        return not_judged("camera-imu overlap", "there is no IMU", RECORD_IMU)
    moments_ns = frame_stamps_ns + round(imu_minus_cam_s * 1e9)
    step_ns = round(median_period_s(imu_stamps_ns) * 1e9) if len(imu_stamps_ns) > 1 else 0
    inside = (moments_ns >= imu_stamps_ns[0] - step_ns) & (moments_ns <= imu_stamps_ns[-1] + step_ns)
    outside_share = 1 - float(inside.mean())
    start_s = float(imu_stamps_ns[0] - moments_ns[0]) * 1e-9
    bad = f"{outside_share:.0%} of the frames have no IMU at their time, which starts {start_s:+.3f} s after them"
    limits, good = Limits(0.01, 0.5, "of the frames without IMU"), "the IMU ran while the camera did"
    return judge("camera-imu overlap", outside_share, limits, good, f"{bad}; stamp both sensors by one clock")


def _rate(name: str, rate_hz: float, slowest_hz: float, advice: str) -> Finding:
    is_good = rate_hz >= slowest_hz
    sentence = f"{rate_hz:.1f} Hz" if is_good else f"{rate_hz:.1f} Hz is slow; {advice}"
    return Finding(name, Verdict.OK if is_good else Verdict.WARN, rate_hz, f"warn below {slowest_hz:g} Hz", sentence)


def _gaps(name: str, stamps_ns: Stamps, warn_s: float, fail_s: float, what: str) -> Finding:
    steps_s = np.diff(stamps_ns) * 1e-9
    longest = int(np.argmax(steps_s))
    count = int((steps_s > warn_s).sum())
    at_s = float(stamps_ns[longest] - stamps_ns[0]) * 1e-9
    limits = Limits(round(warn_s, 4), max(fail_s, round(warn_s, 4)), "s")
    bad = f"{count} gaps without {what}, the longest {steps_s[longest]:.3f} s, {at_s:.1f} s after the start"
    good, advice = f"the longest step is {steps_s[longest]:.3f} s", "look at the recorder's disk and the driver's queue"
    return judge(name, float(steps_s[longest]), limits, good, f"{bad}; {advice}")
