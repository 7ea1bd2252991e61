"""Publishers of estimates to the robot's own programs. To add one: a class, and its format in `open_publisher`."""

from fleetmap.bus import Bus
from fleetmap.errors import UsageError
from fleetmap.geometry import Array, se3_inverse
from fleetmap.messages import EstimateMessage, Placement, covariance_entries, encode_message, robot_key
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sources.intake import Intake
from locclient.daemon.publisher import Publisher
from locclient.localization.estimate import Estimate
from locclient.output_section import OutputSection, check_for_ros2
from locclient.robot.continuous_odom import PublishedPose

_MAX_HYPOTHESES = 16


class MessagePackPublisher(Publisher):
    """Sends EstimateMessage under the robot's key."""

    def __init__(self, bus: Bus, key: str) -> None:
        self._bus, self._key = bus, key

    def publish(self, estimate: Estimate, published: PublishedPose, base_from_body: Array) -> None:
        body_from_base = se3_inverse(base_from_body)
        hypotheses = estimate.hypotheses[:_MAX_HYPOTHESES]
        message = EstimateMessage(
            stamp_ns=estimate.stamp_ns,
            status=estimate.status.value,
            cause=estimate.cause.value,
            calibration=estimate.calibration.text[:2000],
            map_version=estimate.map_version,
            odom_from_base=Placement.of(published.odom_from_base),
            map_from_odom=None if published.map_from_odom is None else Placement.of(published.map_from_odom),
            cov_rot_trans=None if published.cov_rot_trans is None else covariance_entries(published.cov_rot_trans),
            hypotheses=tuple(Placement.of(h.map_from_body @ body_from_base) for h in hypotheses),
            floor=estimate.floor,
            hypothesis_floors=tuple(h.floor for h in hypotheses) if published.level else (),
        )
        self._bus.publish(self._key, encode_message(message), may_drop=True)


def open_publisher(
    section: OutputSection, bus: Bus, site: str, robot: str, calibration: RigCalibration, intake: Intake
) -> Publisher:
    """Open the publisher of the section. intake: receives commands of the robot's own programs.

    Raises UsageError for an unknown format or an invalid topic.
    """
    if section.format == "messagepack":
        return MessagePackPublisher(bus, robot_key(site, robot, "estimate"))
    if section.format == "ros2":
        from locclient.daemon.ros2_localizer import Ros2Localizer

        check_for_ros2(section)
        return Ros2Localizer(bus, robot, section, calibration, intake)
    raise UsageError(f"[output] format = {section.format!r}; known are messagepack and ros2")
