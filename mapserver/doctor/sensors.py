"""Checks of stamps and samples alone: rates, gaps, order, overlap of camera and IMU, gravity, and a rolling shutter."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.samples import PAUSE_NS, DataIssue, ImuSamples, Stamps
from mapserver.doctor.findings import Finding, Limits, Verdict, judge, not_judged

GRAVITY = "gravity magnitude"
SPARSE_S = 0.35  # frames further apart than this are keyframes, not a video
NO_IMU = ("there is no IMU", "record an IMU")
FASTER_IMU = "set the IMU to 200 Hz, slow ones miss vibration and turns"
_SLOWEST_CAMERA_HZ, _SLOWEST_IMU_HZ = 5.0, 90.0
_DISORDER = "stamps not increasing"
# Ends of issues about recordings with complete data
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
    "said twice",
    "order of their views",
)


def median_period_s(stamps_ns: Stamps) -> float:
    """Return the median step between stamps (N,); inf for fewer than two."""
    return float(np.median(np.diff(stamps_ns))) * 1e-9 if len(stamps_ns) > 1 else float("inf")


def camera_checks(stamps_ns: Stamps) -> tuple[Finding, Finding]:
    """Judge frames per second by the median step, and the longest time without a frame."""
    period_s = median_period_s(stamps_ns)
    if period_s > SPARSE_S:
        lacking = f"frames are {period_s:.2f} s apart, too far for a video", "record every frame of the camera"
        return not_judged("camera rate", *lacking), not_judged("camera gaps", *lacking)
    return (
        _rate("camera rate", 1 / period_s, _SLOWEST_CAMERA_HZ, "record with a higher frame rate"),
        _gaps("camera gaps", stamps_ns, max(3.5 * period_s, 0.3), 2.0, "frames"),
    )


def imu_checks(stamps_ns: Stamps) -> tuple[Finding, Finding]:
    """Judge inertial samples per second by the median step, and the longest time without one."""
    if len(stamps_ns) < 2:
        return not_judged("imu rate", *NO_IMU), not_judged("imu gaps", *NO_IMU)
    period_s = median_period_s(stamps_ns)
    return (
        _rate("imu rate", 1 / period_s, _SLOWEST_IMU_HZ, FASTER_IMU),
        _gaps("imu gaps", stamps_ns, max(3.5 * period_s, 0.02), 0.2, "inertial samples"),
    )


def _rate(name: str, rate_hz: float, slowest_hz: float, advice: str) -> Finding:
    is_good = rate_hz >= slowest_hz
    sentence = f"{rate_hz:.1f} Hz" if is_good else f"{rate_hz:.1f} Hz is slow; {advice}"
    return Finding(name, Verdict.OK if is_good else Verdict.WARN, rate_hz, f"warn below {slowest_hz:g} Hz", sentence)


def _gaps(name: str, stamps_ns: Stamps, warn_s: float, fail_s: float, what: str) -> Finding:
    steps_ns = np.diff(stamps_ns)
    steps_s = steps_ns * 1e-9
    longest = int(np.argmax(steps_s))
    count = int((steps_s > warn_s).sum())
    at_s = float(stamps_ns[longest] - stamps_ns[0]) * 1e-9
    limits = Limits(round(warn_s, 4), max(fail_s, round(warn_s, 4)), "s")
    advice = "check the recorder's disk and the driver's queue"
    if steps_ns[longest] > PAUSE_NS:  # too long for a full queue
        advice = (
            "the recorder was paused or its clock was set: the motion meanwhile is unknown; pause only at standstill, or "
            "split the recording at the pause"
        )
    bad = f"{count} gaps without {what}, the longest {steps_s[longest]:.3f} s, {at_s:.1f} s after the start; {advice}"
    return judge(name, float(steps_s[longest]), limits, f"the longest step is {steps_s[longest]:.3f} s", bad)


def imu_noise(calibration: RigCalibration) -> list[Finding]:
    """Report assumed IMU noise."""
    if calibration.imu is None or "imu" not in calibration.assumed:
        return []
    noise = calibration.imu
    words = (
        f"unknown; assumed: {noise.gyro_noise_radps_rthz:g} rad/s/sqrt(Hz) and {noise.accel_noise_mps2_rthz:g} m/s^2/sqrt(Hz), "
        "twice those of an ADIS16448"
    )
    return [not_judged("imu noise", words, "give imu0 with its noise densities in a --calibration FILE")]


def stamp_order(issues: Sequence[DataIssue]) -> Finding:
    """Report stamps that do not increase and were dropped when the recording was opened."""
    found = [f"{issue.what}, {issue.detail}" for issue in issues if _DISORDER in issue.what]
    bad = "; ".join([*found, "check for a clock that is set while recording, or for a driver that sends late"])
    limits = Limits(0, 0, words="none may be out of order")
    return judge("stamp order", float(len(found)), limits, "all stamps increase", bad)


def other_issues(issues: Sequence[DataIssue]) -> list[Finding]:
    """Return a warning for each unreadable or unexpected item."""
    odd, lost = list[Finding](), list[Finding]()
    for issue in issues:
        if issue.what.endswith(_NOT_LOST):
            odd.append(Finding(issue.what, Verdict.WARN, None, "", issue.detail))
        elif _DISORDER not in issue.what:
            words = f"{issue.what}: {issue.detail}; copy the recording again if it has more"
            lost.append(Finding("lost data", Verdict.WARN, None, "nothing lost", words))
    return odd + lost


def camera_imu_overlap(frame_stamps_ns: Stamps, imu_stamps_ns: Stamps, imu_minus_cam_s: float) -> Finding:
    """Judge the share of the frames within the time of the IMU."""
    if len(imu_stamps_ns) == 0:
        return not_judged("camera-imu overlap", *NO_IMU)
    moments_ns = frame_stamps_ns + round(imu_minus_cam_s * 1e9)
    step_ns = round(median_period_s(imu_stamps_ns) * 1e9) if len(imu_stamps_ns) > 1 else 0
    inside = (moments_ns >= imu_stamps_ns[0] - step_ns) & (moments_ns <= imu_stamps_ns[-1] + step_ns)
    outside_share = 1 - float(inside.mean())
    start_s = float(imu_stamps_ns[0] - moments_ns[0]) * 1e-9
    bad = f"{outside_share:.0%} of the frames have no IMU at their time, which starts {start_s:+.3f} s after them"
    limits, good = Limits(0.01, 0.5, "of the frames without IMU"), "the IMU covers all frames"
    return judge("camera-imu overlap", outside_share, limits, good, f"{bad}; stamp both sensors by one clock")


_GRAVITY_MPS2, _CALM_WINDOW_S = 9.81, 0.5
# Wrong magnitudes of a calm accelerometer, within a tenth: their cause
_ODD_GRAVITIES = {
    0.0: "gravity has been taken out of it: record the raw accelerometer, not the linear acceleration",
    1.0: "it is in g: multiply it by 9.80665",
    981.0: "it is in cm/s^2: divide it by 100",
    9810.0: "it is in mm/s^2: divide it by 1000",
    1000.0: "it is in thousandths of g: multiply it by 0.00980665",
}


def gravity_magnitude(imu: ImuSamples) -> Finding:
    """Judge the magnitude of the specific force in the calmest tenth of half-second windows."""
    if len(imu) < 100:
        return not_judged(GRAVITY, f"{len(imu)} inertial samples are too few", NO_IMU[1])
    width = max(10, round(_CALM_WINDOW_S / median_period_s(imu.stamps_ns)))
    count = len(imu) // width
    accel = imu.accel_mps2[: count * width].reshape(count, width, 3)
    unrest = accel.std(axis=1).sum(axis=1)
    calm = np.argsort(unrest, kind="stable")[: max(1, count // 10)]
    magnitude = float(np.median(np.linalg.norm(accel[calm].mean(axis=1), axis=1)))
    known = (words for value, words in _ODD_GRAVITIES.items() if abs(magnitude - value) < max(0.1 * value, 0.3))
    advice = next(known, "check the accelerometer's unit, scale and calibration")
    good, limits = f"{magnitude:.2f} m/s^2 when calm", Limits(0.25, 0.8, words="warn 0.25, fail 0.8 m/s^2 from 9.81")
    bad = f"{good} instead of {_GRAVITY_MPS2}; {advice}"
    return replace(judge(GRAVITY, abs(magnitude - _GRAVITY_MPS2), limits, good, bad), value=magnitude)


def rolling_shutter(camera: CameraCalibration, imu: ImuSamples) -> list[Finding]:
    """Judge the skew of images by a rolling shutter during rotation; empty for a global shutter."""
    readout_s = camera.line_delay_s * camera.height_px
    if not readout_s:
        return []
    told = f"the rows of an image are read within {readout_s * 1e3:.1f} ms by the calibration's line_delay, which is not corrected"
    if not len(imu):
        return [not_judged("rolling shutter", told, "record an IMU, or use a camera with a global shutter")]
    rate_radps = float(np.percentile(np.linalg.norm(imu.gyro_radps, axis=1), 95))
    skew_px = rate_radps * readout_s * float(camera.focal_px[0])
    words = f"{told}: at the turns of this recording (95 %: {rate_radps:.2f} rad/s) a row is shifted by {skew_px:.1f} px against the first"
    bad = f"{words}; turn more slowly, or use a camera with a global shutter"
    return [judge("rolling shutter", skew_px, Limits(1.0, np.inf, words="warn above 1 px"), words, bad)]
