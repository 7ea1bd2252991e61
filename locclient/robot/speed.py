"""Speed of a robot, by its wheels or else by its odometry: whether it drives or stands. Pure."""

from collections.abc import Sequence
from math import dist, hypot

from fleetmap.geometry import Array
from fleetmap.odometry import OdometryEstimate, OdometryStatus
from fleetmap.sensors.samples import WheelSample

_WHEEL_NS = 500_000_000  # age from which wheel odometry says nothing of the present
_SPAN_NS = 500_000_000  # over which a camera's motion is measured: a millimetre of noise is 2 mm/s


class SpeedGauge:
    """Follows one robot frame by frame."""

    def __init__(self) -> None:
        self._wheel: WheelSample | None = None
        self._from: tuple[int, Array] | None = None
        self._camera_mps: float | None = None

    def handle(self, wheel: Sequence[WheelSample], odometry: OdometryEstimate, odom_from_base: Array) -> float | None:
        """Metres a second at a frame; None where neither wheels nor odometry know it.

        wheel: since the frame before. odom_from_base (4, 4): in an odometry frame that is never redefined. Without an IMU the odometry
        estimates no velocity, and the distance moved within half a second gives it.
        """
        self._wheel = wheel[-1] if wheel else self._wheel
        self._measure(odometry, odom_from_base)
        if self._wheel is not None and abs(odometry.stamp_ns - self._wheel.stamp_ns) <= _WHEEL_NS:
            return hypot(*self._wheel.velocity_base_mps[:2])
        if not odometry.scale_known:
            return None
        return hypot(*odometry.velocity_odom_mps) if odometry.inertial else self._camera_mps

    def _measure(self, odometry: OdometryEstimate, odom_from_base: Array) -> None:
        """Distance over time between frames at least _SPAN_NS apart; unknown while the odometry does not hold."""
        if odometry.status is OdometryStatus.DEGRADED:
            self._from = self._camera_mps = None
            return
        place = (odometry.stamp_ns, odom_from_base[:3, 3])
        if self._from is None:
            self._from = place
        elif place[0] - self._from[0] >= _SPAN_NS:
            self._camera_mps = dist(place[1], self._from[1]) / ((place[0] - self._from[0]) * 1e-9)
            self._from = place
