"""The unit checks: certain on wrong units, silent on all real motion."""

import numpy as np
import pytest

from fleetmap.errors import RecordingError
from fleetmap.recordings import open_recording
from fleetmap.recordings.finalize import check_imu_units
from fleetmap.sensors.samples import ImuSamples
from support.recordings.realdata import real_data
from support.recordings.recording_samples import make_sample

SAMPLE = make_sample(1, imu_before_ns=6_000_000_000)
TURNING = ImuSamples(SAMPLE.imu_stamps_ns, SAMPLE.gyro_radps, SAMPLE.accel_mps2)


def scaled(imu: ImuSamples, gyro: float, accel: float = 1.0) -> ImuSamples:
    return ImuSamples(imu.stamps_ns, gyro * imu.gyro_radps, accel * imu.accel_mps2)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_degrees_are_found_also_with_noise(noise: float) -> None:
    rng = np.random.default_rng(3)
    accel = TURNING.accel_mps2 + noise * rng.standard_normal(TURNING.accel_mps2.shape)
    noisy = ImuSamples(TURNING.stamps_ns, TURNING.gyro_radps, accel)
    check_imu_units(noisy, "sample")
    with pytest.raises(RecordingError, match="degrees"):
        check_imu_units(scaled(noisy, 180 / np.pi), "sample")


@pytest.mark.parametrize(
    ("rates", "noise"), [((0.0, 0.0, 4.0), 0.0), ((0.02, 0.02, 0.02), 1.0)], ids=["spinning", "still"]
)
def test_what_tells_the_accelerometer_nothing_is_not_accused(rates: tuple[float, ...], noise: float) -> None:
    """4 rad/s about gravity, and standing with a bias."""
    rng = np.random.default_rng(4)
    stamps = np.arange(1000, dtype=np.int64) * 5_000_000
    gyro = np.array(rates) + 0.002 * noise * rng.standard_normal((1000, 3))
    accel = np.array([0.0, 0.0, 9.81]) + 0.02 * noise * rng.standard_normal((1000, 3))
    check_imu_units(ImuSamples(stamps, gyro, accel), "robot")


@pytest.mark.parametrize("name", ["euroc_mh01_start", "euroc_v101_keyframes", "tumvi_room1_fisheye_8"])
def test_real_recordings_pass_and_fail_when_their_units_are_spoilt(name: str) -> None:
    imu = open_recording(real_data(name)).imu
    for gyro, accel, says in ((180 / np.pi, 1.0, "degrees"), (1.0, 1 / 9.80665, "in g")):
        with pytest.raises(RecordingError, match=says):
            check_imu_units(scaled(imu, gyro, accel), name)
