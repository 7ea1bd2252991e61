"""Checks by the IMU alone: the accelerometer at rest measures gravity, and how turns skew the images of a rolling shutter."""

import numpy as np

from fleetmap.sensors.calibration import CameraCalibration
from fleetmap.sensors.samples import ImuSamples
from mapserver.doctor.findings import Finding, Verdict, not_judged
from mapserver.doctor.timing import RECORD_IMU

NAME, ROLLING = "gravity magnitude", "rolling shutter"
GRAVITY_MPS2 = 9.81
# What a calm accelerometer shows instead, by a tenth: what that is
_ODD = {
    0.0: "gravity has been taken out of it: record the raw accelerometer, not the linear acceleration",
    1.0: "it is in g: multiply it by 9.80665",
    981.0: "it is in cm/s^2: divide it by 100",
    9810.0: "it is in mm/s^2: divide it by 1000",
    1000.0: "it is in thousandths of g: multiply it by 0.00980665",
}
_WINDOW_S = 0.5


def rolling_shutter(camera: CameraCalibration, imu: ImuSamples) -> list[Finding]:
    """By how much turns skew an image whose rows are read one after another; nothing for a global shutter."""
    readout_s = camera.line_delay_s * camera.height_px
    if not readout_s:
        return []
    told = f"the rows of an image are read within {readout_s * 1e3:.1f} ms by the calibration's line_delay, which is not corrected"
    if not len(imu):
        return [not_judged(ROLLING, told, "record an IMU, or use a camera with a global shutter")]
    rate_radps = float(np.percentile(np.linalg.norm(imu.gyro_radps, axis=1), 95))
    skew_px = rate_radps * readout_s * float(camera.intrinsics_px[0])
    words = f"{told}: at the turns of this recording (95 %: {rate_radps:.2f} rad/s) a row is {skew_px:.1f} px from where the first would be"
    verdict = Verdict.WARN if skew_px > 1.0 else Verdict.OK
    advice = "" if verdict is Verdict.OK else "; turn more slowly, or use a camera with a global shutter"
    return [Finding(ROLLING, verdict, skew_px, "warn above 1 px", words + advice)]


def gravity_magnitude(imu: ImuSamples) -> Finding:
    """The magnitude of the specific force in the calmest tenth of half-second windows."""
    if len(imu) < 100:
        return not_judged(NAME, f"{len(imu)} inertial samples are too few", RECORD_IMU)
    period_s = float(np.median(np.diff(imu.stamps_ns))) * 1e-9
    width = max(10, round(_WINDOW_S / period_s))
    count = len(imu) // width
    accel = imu.accel_mps2[: count * width].reshape(count, width, 3)
    unrest = accel.std(axis=1).sum(axis=1)
    calm = np.argsort(unrest, kind="stable")[: max(1, count // 10)]
    magnitude = float(np.median(np.linalg.norm(accel[calm].mean(axis=1), axis=1)))
    error = abs(magnitude - GRAVITY_MPS2)
    verdict = Verdict.OK if error < 0.25 else Verdict.WARN if error < 0.8 else Verdict.FAIL
    sentence = f"{magnitude:.2f} m/s^2 when calm"
    if verdict is not Verdict.OK:
        known = (words for value, words in _ODD.items() if abs(magnitude - value) < max(0.1 * value, 0.3))
        advice = next(known, "check the accelerometer's unit, scale and calibration")
        sentence += f" instead of {GRAVITY_MPS2}; {advice}"
    return Finding(NAME, verdict, magnitude, "warn 0.25, fail 0.8 m/s^2 from 9.81", sentence)
