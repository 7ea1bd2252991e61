"""The ROS 2 definitions (`ros2msg`) of messages and services that the project writes, field by field as ROS 2 fixes them."""

DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/String": "string data",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    "sensor_msgs/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 "
        "step\nuint8[] data"
    ),
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "sensor_msgs/RegionOfInterest": ("uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify"),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
        "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi"
    ),
    "sensor_msgs/Imu": (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance"
    ),
    "nav_msgs/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist"
    ),
    "nav_msgs/Path": "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses",
    "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count",
    "sensor_msgs/PointCloud2": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
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
_SEPARATOR = "=" * 80


def ros2msg(type_name: str) -> str:
    """The full definition of a message type such as `sensor_msgs/Imu`, followed by those of its parts."""
    parts = [DEFINITIONS[type_name]]
    for name in _parts_of(type_name):
        parts += [_SEPARATOR, f"MSG: {name}", DEFINITIONS[name]]
    return "\n".join(parts) + "\n"


def _parts_of(type_name: str) -> list[str]:
    found: list[str] = []
    waiting = [type_name]
    while waiting:
        for line in DEFINITIONS[waiting.pop(0)].splitlines():
            name = line.split()[0].removesuffix("[]")
            if name in DEFINITIONS and name not in found:
                found.append(name)
                waiting.append(name)
    return found
