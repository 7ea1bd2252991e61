"""Names of a ROS 2 node in zenoh: keys of its topics and services, and the liveliness tokens that show them in ROS's graph.

Sources: rmw_zenoh's design document (topic and service names, graph cache); the README of zenoh-plugin-ros2dds, whose bridge carries topics
and services of DDS under their bare names.
"""

from dataclasses import dataclass

from fleetmap.errors import UsageError
from locclient.plugins.ros2_node.keys import dds_type, topic_chunks, type_hash

PUBLISHER, SUBSCRIPTION, SERVICE = "MP", "MS", "SS"


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service, always reliable: depth of the history, and transient local (late subscribers get the history) or not."""

    depth: int = 10
    is_transient_local: bool = False


LATCHED = Qos(1, is_transient_local=True)


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One publisher, subscription or service of a node. name: fully qualified, such as /tf; number: unique in the node, above 0."""

    kind: str
    name: str
    type_name: str
    number: int
    qos: Qos = Qos()


@dataclass(frozen=True, slots=True)
class NodeName:
    """A node in ROS's graph. namespace: empty or /like/this; session: the id of its zenoh session."""

    session: str
    name: str
    namespace: str = ""


class RmwZenohKeys:
    """Keys of rmw_zenoh, from ROS 2 Iron on: earlier releases have no type hashes."""

    def __init__(self, domain: int) -> None:
        self._domain = domain

    def key(self, name: str, type_name: str) -> str:
        """The key of a topic with messages of `type_name` (sensor_msgs/Imu), or of a service (std_srvs/srv/Empty)."""
        return f"{self._domain}/{topic_chunks(name)}/{dds_type(type_name)}/RIHS01_{type_hash(type_name)}"

    def subscription(self, topic: str) -> str:
        """Key expression for a topic of any type."""
        return f"{self._domain}/{topic_chunks(topic)}/*/*"

    def type_of(self, key: str) -> str:
        """The message type, such as sensor_msgs/Imu, of a key; empty if it has none."""
        chunks = key.split("/")
        parts = chunks[-2].split("::") if len(chunks) >= 4 else []
        return f"{parts[0]}/{parts[3].removesuffix('_')}" if len(parts) == 4 and parts[1:3] == ["msg", "dds_"] else ""

    def node_token(self, node: NodeName) -> str:
        return f"@ros2_lv/{self._domain}/{node.session}/0/0/NN/{self._place(node)}"

    def token(self, node: NodeName, endpoint: Endpoint) -> str:
        """Liveliness token. Its quality of service omits rmw_zenoh's defaults: reliable 1, volatile 2, keep last 1, 42."""
        name, kind = f"%{topic_chunks(endpoint.name).replace('/', '%')}", dds_type(endpoint.type_name)
        qos = f":{'1' if endpoint.qos.is_transient_local else ''}:,{endpoint.qos.depth}:,:,:,,"
        start = f"@ros2_lv/{self._domain}/{node.session}/0/{endpoint.number}/{endpoint.kind}"
        return f"{start}/{self._place(node)}/{name}/{kind}/RIHS01_{type_hash(endpoint.type_name)}/{qos}"

    @staticmethod
    def _place(node: NodeName) -> str:
        return f"%/{node.namespace.replace('/', '%') or '%'}/{node.name}"


class BridgedDdsKeys:
    """Keys of zenoh-bridge-ros2dds for robots on DDS."""

    def key(self, name: str, _: str) -> str:
        return topic_chunks(name)

    def subscription(self, topic: str) -> str:
        return topic_chunks(topic)

    def type_of(self, _: str) -> str:
        return ""

    def node_token(self, node: NodeName) -> str:
        """Token of a node, which other bridges see as a bridge."""
        return f"@/{node.session}/@ros2_lv"

    def token(self, node: NodeName, endpoint: Endpoint) -> str:
        """Liveliness token. Its quality of service uses Cyclone DDS's numbers: reliable 1, transient local 1, keep last 0."""
        name, (package, *_, short) = topic_chunks(endpoint.name).replace("/", "§"), endpoint.type_name.split("/")
        if endpoint.kind == SERVICE:
            return f"@/{node.session}/@ros2_lv/SS/{name}/{package}§srv§{short}"
        qos = f":1:{int(endpoint.qos.is_transient_local)}:0,{endpoint.qos.depth}:typehash=RIHS01_{type_hash(endpoint.type_name)};"
        return f"@/{node.session}/@ros2_lv/{endpoint.kind}/{name}/{package}§msg§{short}/{qos}"


KeyLayout = RmwZenohKeys | BridgedDdsKeys


def key_layout(name: str, domain: int) -> KeyLayout:
    """`rmw_zenoh` or `ros2dds`; UsageError for another name."""
    if name == "ros2dds":
        return BridgedDdsKeys()
    if name != "rmw_zenoh":
        raise UsageError(f"keys = {name!r}; known are rmw_zenoh and, for robots on DDS, ros2dds")
    return RmwZenohKeys(domain)
