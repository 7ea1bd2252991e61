"""Names of a ROS 2 node in zenoh: keys of its topics and services, with the hashes of their types, attachments of messages, and the
liveliness tokens that show them in ROS's graph.

Sources: rmw_zenoh's design document (names, graph cache); REP 2011 and REP 2016 for the hash, RIHS01, of a type's description; the README
of zenoh-plugin-ros2dds, whose bridge carries topics and services of DDS under their bare names.
"""

import hashlib
import json
import re
import struct
from dataclasses import dataclass
from functools import cache
from typing import Any

from fleetmap.errors import UsageError
from fleetmap.recordings.ros2 import definitions

# The definitions of the messages and services of the node, and of those in recordings, field by field as ROS 2 fixes them: those by which
# messages are packed and unpacked.
DEFINITIONS = definitions.DEFINITIONS
DEFINITIONS |= {
    "std_msgs/String": "string data",
    "nav_msgs/MapMetaData": (
        "builtin_interfaces/Time map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\ngeometry_msgs/Pose origin"
    ),
    "nav_msgs/OccupancyGrid": "std_msgs/Header header\nnav_msgs/MapMetaData info\nint8[] data",
    "diagnostic_msgs/KeyValue": "string key\nstring value",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte level\nstring name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values"
    ),
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status",
    "lifecycle_msgs/State": "uint8 id\nstring label",
    "lifecycle_msgs/Transition": "uint8 id\nstring label",
    "lifecycle_msgs/TransitionDescription": (
        "lifecycle_msgs/Transition transition\nlifecycle_msgs/State start_state\nlifecycle_msgs/State goal_state"
    ),
    "lifecycle_msgs/TransitionEvent": (
        "uint64 timestamp\nlifecycle_msgs/Transition transition\nlifecycle_msgs/State start_state\n"
        "lifecycle_msgs/State goal_state"
    ),
    "bond/Status": (
        "std_msgs/Header header\nstring id\nstring instance_id\nbool active\nfloat32 heartbeat_timeout\n"
        "float32 heartbeat_period"
    ),
    "service_msgs/ServiceEventInfo": (
        "uint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\nint64 sequence_number"
    ),
}
_EMPTY = "uint8 structure_needs_at_least_one_member"  # as rosidl fills a message without fields
# Fields of request and response.
_SERVICES = {
    "lifecycle_msgs/srv/GetState": (_EMPTY, "lifecycle_msgs/State current_state"),
    "lifecycle_msgs/srv/ChangeState": ("lifecycle_msgs/Transition transition", "bool success"),
    "lifecycle_msgs/srv/GetAvailableStates": (_EMPTY, "lifecycle_msgs/State[] available_states"),
    "lifecycle_msgs/srv/GetAvailableTransitions": (
        _EMPTY,
        "lifecycle_msgs/TransitionDescription[] available_transitions",
    ),
    "std_srvs/srv/Empty": (_EMPTY, _EMPTY),
    "nav2_msgs/srv/SetInitialPose": ("geometry_msgs/PoseWithCovarianceStamped pose", _EMPTY),
}


def service_definitions(name: str, request: str, response: str) -> dict[str, str]:
    """Definitions of a service such as std_srvs/srv/Empty and of its messages. Source: REP 2016."""
    return {
        f"{name}_Request": request,
        f"{name}_Response": response,
        f"{name}_Event": f"service_msgs/ServiceEventInfo info\n{name}_Request[<=1] request\n{name}_Response[<=1] response",
        name: f"{name}_Request request_message\n{name}_Response response_message\n{name}_Event event_message",
    }


for _name, _fields in _SERVICES.items():
    DEFINITIONS |= service_definitions(_name, *_fields)


# type_description_interfaces/FieldType: numbers of the types, and offsets for fixed and for unbounded arrays.
_NUMBERS = "int8 uint8 int16 uint16 int32 uint32 int64 uint64 float32 float64"
_TYPE_IDS = dict(zip(_NUMBERS.split(), range(2, 12), strict=True)) | {"bool": 15, "byte": 16, "string": 17}
_NESTED, _FIXED_ARRAY, _BOUNDED, _SEQUENCE = 1, 48, 96, 144
_FIELD = re.compile(r"^([\w/]+)(?:\[(<=)?(\d*)\])? (\w+)")
_GID_BYTES = 16
_ATTACHMENT = struct.Struct("<qqB")


def dds_type(type_name: str) -> str:
    """DDS name of a type, such as sensor_msgs::msg::dds_::Imu_."""
    package, kind, name = _long(type_name).split("/")
    return f"{package}::{kind}::dds_::{name}_"


def attachment(sequence: int, source_ns: int, gid: bytes) -> bytes:
    """Attachment of a message: sequence number, time, and the publisher's id of 16 bytes."""
    assert len(gid) == _GID_BYTES
    return _ATTACHMENT.pack(sequence, source_ns, _GID_BYTES) + gid


def answer_attachment(question: bytes, source_ns: int) -> bytes:
    """Attachment of a service's reply: number and id of the request's; empty if the request has no attachment of rmw_zenoh."""
    if len(question) != _ATTACHMENT.size + _GID_BYTES or question[_ATTACHMENT.size - 1] != _GID_BYTES:
        return b""
    return attachment(_ATTACHMENT.unpack_from(question)[0], source_ns, question[_ATTACHMENT.size :])


@cache
def type_hash(type_name: str) -> str:
    """RIHS01 of a type in DEFINITIONS, without its prefix: SHA-256 of the type's description as canonical JSON."""
    described = {
        "type_description": _description(type_name),
        "referenced_type_descriptions": [_description(name) for name in sorted(_nested(type_name), key=_long)],
    }
    return hashlib.sha256(json.dumps(described, separators=(", ", ": ")).encode()).hexdigest()


def _description(type_name: str) -> dict[str, Any]:
    return {"type_name": _long(type_name), "fields": [_field(line) for line in DEFINITIONS[type_name].splitlines()]}


def _field(line: str) -> dict[str, Any]:
    match = _FIELD.match(line)
    assert match is not None, line
    base, is_bounded, count, name = match.groups()
    array = 0 if count is None else _BOUNDED if is_bounded else _FIXED_ARRAY if count else _SEQUENCE
    type_id = _TYPE_IDS.get(base, _NESTED) + array
    nested = "" if base in _TYPE_IDS else _long(base)
    shape = {"type_id": type_id, "capacity": int(count or 0), "string_capacity": 0, "nested_type_name": nested}
    return {"name": name, "type": shape}


def _nested(type_name: str) -> set[str]:
    found: set[str] = set()
    for line in DEFINITIONS[type_name].splitlines():
        base = line.split()[0].partition("[")[0]
        if base not in _TYPE_IDS:
            found |= {base} | _nested(base)
    return found


def _long(type_name: str) -> str:
    return type_name if type_name.count("/") == 2 else type_name.replace("/", "/msg/")


def topic_chunks(topic: str) -> str:
    """The chunks of a topic's or service's name in a key; UsageError for an invalid name."""
    chunks = topic.strip("/")
    if not chunks or not all(re.fullmatch(r"[A-Za-z_]\w*", chunk) for chunk in chunks.split("/")):
        raise UsageError(f"topic {topic!r}: write it like /cam0/image_raw, of letters, digits and _")
    return chunks


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
