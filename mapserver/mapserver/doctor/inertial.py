"""Check of the accelerometer: at rest it measures gravity."""

import numpy as np

from fleetmap.sensors.samples import ImuSamples
from mapserver.doctor.findings import Finding, Verdict, not_judged
from mapserver.doctor.timing import RECORD_IMU

GRAVITY_MPS2 = 9.81
_WINDOW_S = 0.5


def gravity_magnitude(imu: ImuSamples) -> Finding:
    """The magnitude of the specific force in the calmest tenth of half-second windows."""
    name = "gravity magnitude"
    if len(imu) < 100:
        return not_judged(name, f"{len(imu)} inertial samples are too few", RECORD_IMU)
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
        sentence += f" instead of {GRAVITY_MPS2}; check the accelerometer's unit, scale and calibration"
    return Finding(name, verdict, magnitude, "warn 0.25, fail 0.8 m/s^2 from 9.81", sentence)
