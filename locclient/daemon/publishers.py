"""Publishers of estimates to the robot's own programs. To add one: a class, and a plug-in's `OutputHook` or a line in OUTPUTS."""

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import chosen
from fleetmap.geometry import Array, se3_inverse
from fleetmap.hooks import plugins
from fleetmap.messages import EstimateMessage, Placement, covariance_entries, encode_message, robot_key
from locclient.hooks import OutputHook
from locclient.localization.estimate import Estimate
from locclient.outputs import OutputSection, Publisher
from locclient.robot.continuous_odom import PublishedPose

_MAX_HYPOTHESES = 16


class MessagePackPublisher(Publisher):
    """Sends EstimateMessage under the robot's key."""

    def __init__(self, _section: OutputSection, bus: Bus | None, site: str, robot: str, *_: object) -> None:
        """See `OutputHook`."""
        assert bus is not None
        self._bus, self._key = bus, robot_key(site, robot, "estimate")

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
            **estimate.protection,
            hypothesis_floors=tuple(h.floor for h in hypotheses) if published.level else (),
        )
        self._bus.publish(self._key, encode_message(message), may_drop=True)


OUTPUTS = {"messagepack": OutputHook(MessagePackPublisher, lambda _section, _topics: None)}


def output_of(section: OutputSection) -> OutputHook:
    """Return the format of the section. UsageError for an unknown one."""
    known: dict[str, OutputHook] = OUTPUTS if section.format in OUTPUTS else OUTPUTS | plugins("locclient.outputs")
    return chosen("[output] format", section.format, known)
