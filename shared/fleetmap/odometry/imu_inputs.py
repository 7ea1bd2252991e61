"""What the modes of the odometry need of an IMU."""

from dataclasses import dataclass, replace

from fleetmap.odometry.accelerometer_check import AccelerometerCheck
from fleetmap.odometry.filter.sliding_window import OdometryRig
from fleetmap.odometry.gyro_clock import GyroClock
from fleetmap.odometry.odometry_checks import DivergenceMonitor
from fleetmap.odometry.sensor_buffer import SensorBuffer
from fleetmap.sensors.calibration import ImuNoise


@dataclass(frozen=True, slots=True)
class ImuInputs:
    """What the use of an IMU needs: its samples, its noise as it is and as it is weighed, and the monitors of its faults.

    accelerometer: None for one camera, whose metres come from it.
    """

    samples: SensorBuffer
    noise: ImuNoise
    weighing_noise: ImuNoise
    monitor: DivergenceMonitor
    clock: GyroClock
    accelerometer: AccelerometerCheck | None = None

    @property
    def has_fault(self) -> bool:
        """Whether a check has found one."""
        return self.clock.off_s is not None or bool(self.accelerometer and self.accelerometer.fault)


def imu_inputs(
    rig: OdometryRig,
    noise: ImuNoise,
    samples: SensorBuffer,
    clock: GyroClock,
    accelerometer: AccelerometerCheck | None = None,
) -> ImuInputs:
    """The inputs of an IMU whose noise is weighed as wider than its data sheet says."""
    settings = rig.settings.filter
    weighing = replace(
        noise,
        gyro_noise_radps_rthz=noise.gyro_noise_radps_rthz * settings.gyro_noise_scale,
        accel_noise_mps2_rthz=noise.accel_noise_mps2_rthz * settings.accel_noise_scale,
    )
    return ImuInputs(samples, noise, weighing, DivergenceMonitor(settings.time_offset_sigma_s), clock, accelerometer)
