"""The ROS 2 definitions of the messages and services of the node, and of those in recordings, field by field as ROS 2 fixes them."""

from fleetmap.recordings.ros2 import definitions

DEFINITIONS = definitions.DEFINITIONS | {
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
