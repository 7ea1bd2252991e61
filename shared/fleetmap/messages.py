"""Messages between robots and the server, as MessagePack, and the keys of the bus that carry them.

fleetmap/{site}/robots/{robot}/wanted    queried by the robot; published by the server when it changes: WantedVersion
fleetmap/{site}/robots/{robot}/initial_pose published by the server when an operator sets the robot's pose: InitialPoseMessage
fleetmap/{site}/robots/{robot}/ack       published by the robot: RobotAck
fleetmap/{site}/robots/{robot}/health    published by the robot: RobotHealth
fleetmap/{site}/robots/{robot}/pose      published by the robot: PoseMessage
fleetmap/{site}/robots/{robot}/estimate  published by the robot for every frame: EstimateMessage
fleetmap/{site}/robots/{robot}/failures  queried by the robot, FailureReport: FailureAck, once the server has stored it
fleetmap/{site}/robots/{robot}/replays   queried by the robot, ReplayPart: FailureAck, with the received bytes of a failure's recording
fleetmap/{site}/robots/{robot}/alive     liveliness token of the robot
fleetmap/{site}/robots/{robot}/renew     queried by the robot with its next key: fleetmap.trust.enrolment
fleetmap/{site}/robots/{robot}/manifests/{version} queried by the robot, ChunkRequest: Part of a manifest
fleetmap/{site}/robots/{robot}/blobs/{sha256} queried by the robot, ChunkRequest: Part of a tile, vocabulary or manifest
fleetmap/{site}/robots/{robot}/trust/{file} queried by the robot, ChunkRequest: Part of a file of the signed lists, empty if absent
fleetmap/{site}/live/survey              published by a running survey: fleetmap.live_survey
"""

from enum import StrEnum
from typing import Annotated, Self, TypeVar

import msgspec
import numpy as np

from fleetmap.encoding import MOST, bounded, to_msgpack
from fleetmap.errors import LinkError
from fleetmap.geometry import Array, quat_wxyz_from_rotation, rotation_from_quat_wxyz, se3

MAX_MESSAGE_BYTES = 1 << 20
PART_BYTES = 256 << 10  # small enough to arrive within seconds over a poor radio link, and to be repeated
MAX_THUMBNAIL_BYTES = 64 << 10  # four of them and the rest of a failure's report stay far below a message's limit
_ROOT = "fleetmap"
MAP_PARTS = ("manifests", "blobs", "trust")  # of a robot's map queries, after its name
_MAX_KEY = 256  # two names and two addresses of bytes

_STORED = r"\A[^\x00]*\Z"  # not every database takes NUL in text
Name = Annotated[str, msgspec.Meta(max_length=64, pattern=_STORED)]
FileName = Annotated[str, msgspec.Meta(max_length=64, pattern=r"\A[A-Za-z0-9_-]+\Z")]
Text = Annotated[str, msgspec.Meta(max_length=2000, pattern=_STORED)]
Version = Annotated[int, msgspec.Meta(ge=1, le=(1 << 31))]
_Key = Annotated[str, msgspec.Meta(max_length=64)]  # in JSON, where NUL is escaped
Metrics = Annotated[dict[_Key, float | int | Text | bool | None], msgspec.Meta(max_length=256)]
Flags = Annotated[tuple[Name, ...], msgspec.Meta(max_length=64)]


class Status(StrEnum):
    """Status of a robot's estimate.

    Messages carry statuses, causes and kinds as text, not as these types: another version of fleetmap may send unknown ones, which
    the receiver keeps and shows unchanged.
    """

    INITIALISING = "INITIALISING"
    TRACKING = "TRACKING"
    DEGRADED = "DEGRADED"
    AMBIGUOUS = "AMBIGUOUS"
    LOST = "LOST"


class Cause(StrEnum):
    """Reason why an estimate is not TRACKING, or of a failure; docs/service.md explains each."""

    NONE = ""
    DARK = "dark"
    GLARE = "glare"
    FROZEN = "frozen"
    BLURRED = "blurred"
    OCCLUDED = "occluded"
    ODOMETRY = "odometry lost"
    UNMATCHED = "nothing in the map agrees"
    NO_FRAMES = "no_frames"
    NO_MAP = "no_map"
    AMBIGUOUS = "ambiguous"
    NO_MATCH = "no_match"
    FIX_REFUSED = "fix_refused"
    MOVED = "moved"
    CARRIED = "carried"
    RIDING = "riding"
    ALIASED = "aliased"
    MAP_CHANGED = "map_changed"
    CALIBRATION = "calibration"
    OVERLOADED = "overloaded"


class Flag(StrEnum):
    """Flag in a robot's health report, in addition to causes; docs/service.md explains each."""

    BLIND = "blind"
    NOT_LOCALISED = "not_localised"
    OFF_MAP = "off_map"
    IMU_REFUSED = "imu_refused"
    IMU_SILENT = "imu_silent"
    ACCELEROMETER_REFUSED = "accelerometer_refused"
    WHEELS_REFUSED = "wheels_refused"
    WHEELS_UNMOUNTED = "wheels_unmounted"
    IMAGES_REFUSED = "images_refused"
    OVERLOADED = "overloaded"
    PRIOR_REFUSED = "prior_refused"


class FailureKind(StrEnum):
    """`blind`: no reliable position. `suspected`: tracking, but fixes contradict it. `not_found`: it still searches for its place."""

    BLIND = "blind"
    SUSPECTED = "suspected"
    NOT_FOUND = "not_found"


class ChunkRequest(msgspec.Struct, frozen=True, kw_only=True):
    """Query for at most max_bytes from offset on; an empty payload requests the first part."""

    offset: Annotated[int, msgspec.Meta(ge=0, le=1 << 40)] = 0
    max_bytes: Annotated[int, msgspec.Meta(ge=1, le=PART_BYTES)] = PART_BYTES


class Part(msgspec.Struct, frozen=True, kw_only=True):
    """Part of a file of total_bytes, from offset on; empty only beyond the end."""

    total_bytes: Annotated[int, msgspec.Meta(ge=0, le=1 << 40)]
    offset: Annotated[int, msgspec.Meta(ge=0, le=1 << 40)]
    data: bytes


class SurveyArea(msgspec.Struct, frozen=True, kw_only=True):
    """An area of which operators want a new survey: a polygon in `map`, metres, its first corner not repeated at the end."""

    id: FileName
    corners_map_m: Annotated[list[tuple[float, float]], msgspec.Meta(min_length=3, max_length=200)]


class WantedVersion(msgspec.Struct, frozen=True, kw_only=True):
    """Version that a robot should run; None while the site has none.

    In the answer to a question, restored_ns: when the server's store was last restored from a backup, 0 if never; surveys: the areas that
    robots may survey, the oldest requests.
    """

    site: Name
    version: Version | None
    manifest_sha256: str | None
    restored_ns: Annotated[int, msgspec.Meta(ge=0, le=1 << 62)] = 0
    surveys: Annotated[tuple[SurveyArea, ...], msgspec.Meta(max_length=20)] = ()


class InitialPoseMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Pose of the robot's base on the floor of `map`, set by an operator, as ROS's `initialpose`.

    heading_rad: from x towards y, None if not given. sigma_m: standard deviation along x and along y.
    """

    site: Name
    robot: Name
    x_map_m: float
    y_map_m: float
    heading_rad: float | None = None
    sigma_m: float = 0.5


class RobotAck(msgspec.Struct, frozen=True, kw_only=True):
    """Version that a robot runs. refused: why it does not run the wanted one, empty if it does."""

    site: Name
    robot: Name
    stamp_ns: int
    version: Version | None
    refused: Text = ""


class RobotHealth(msgspec.Struct, frozen=True, kw_only=True):
    """A robot's report: status of the localization, raised flags, metrics by name.

    stamp_ns: sensor clock; wall_ns: the robot's wall clock when it sent this, from which the server measures the clock's error.
    metrics that the server evaluates, without unknown ones: speed_mps, radius_95_m and frame_ms_mean are current. Since the previous
    report: fix_innovation, the largest squared Mahalanobis distance (6 degrees of freedom) between a fix and its prediction,
    fix_innovation_m, the largest such distance in metres, and dock_error_m, the distance between estimate and dock at an arrival; both
    in metres only where the robot was TRACKING. Since the start of the run: frames, frames_dropped, landmarks_expected and
    landmarks_seen (searched for in images, and found), first_fix_s, the time to the first fix.
    """

    site: Name
    robot: Name
    stamp_ns: int
    version: Version | None
    status: Name
    wall_ns: int | None = None
    flags: Flags = ()
    metrics: Metrics = {}


class Placement(msgspec.Struct, frozen=True, kw_only=True):
    """A rigid transform: position in metres, unit quaternion."""

    position_m: tuple[float, float, float]
    quat_wxyz: tuple[float, float, float, float]

    @classmethod
    def of(cls, target_from_source: Array) -> Self:
        """Convert a transform (4, 4) to a message."""
        x, y, z = target_from_source[:3, 3].tolist()
        qw, qx, qy, qz = quat_wxyz_from_rotation(target_from_source[:3, :3]).tolist()
        return cls(position_m=(x, y, z), quat_wxyz=(qw, qx, qy, qz))

    @property
    def target_from_source(self) -> Array:
        """(4, 4) transform."""
        return se3(rotation_from_quat_wxyz(np.array(self.quat_wxyz)), np.array(self.position_m))


class PoseMessage(msgspec.Struct, frozen=True, kw_only=True):
    """An estimate of map_from_base: position in metres, unit quaternion, covariance (rotation first, row by row)."""

    stamp_ns: int
    position_map_m: tuple[float, float, float]
    quat_wxyz: tuple[float, float, float, float]
    cov_rot_trans: Annotated[tuple[float, ...], msgspec.Meta(min_length=36, max_length=36)]
    status: Name
    map_version: Version | None

    @classmethod
    def of(
        cls, stamp_ns: int, map_from_base: Array, cov_rot_trans: Array, status: str, map_version: int | None
    ) -> Self:
        """Convert map_from_base (4, 4) with cov_rot_trans (6, 6) to a message."""
        placed = Placement.of(map_from_base)
        return cls(
            stamp_ns=int(stamp_ns),
            position_map_m=placed.position_m,
            quat_wxyz=placed.quat_wxyz,
            cov_rot_trans=covariance_entries(cov_rot_trans),
            status=status,
            map_version=map_version,
        )

    @property
    def map_from_base(self) -> Array:
        """(4, 4) transform of this message."""
        return se3(rotation_from_quat_wxyz(np.array(self.quat_wxyz)), np.array(self.position_map_m))


class EstimateMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Estimate of one frame for the navigation of the robot itself.

    cause: a `Cause`, why the status is not TRACKING. odom_from_base is continuous; map_from_odom moves with every fix and is None
    while there is no single pose. cov_rot_trans: of map_from_base in map axes, rotation first, row by row, None with it.
    hypotheses: competing poses while AMBIGUOUS. calibration: the wrong parameter and its error, if that is the cause. floor: site whose map
    the pose is of, in a building, empty for the robot's own; hypothesis_floors: of each hypothesis, empty for a site without floors.
    protection_m, protection_deg: what the errors of position and rotation exceed once in 100,000 fixes, None where nothing is promised.
    """

    stamp_ns: int
    status: Name
    cause: Name = ""
    calibration: Text = ""
    map_version: Version | None
    odom_from_base: Placement
    map_from_odom: Placement | None
    cov_rot_trans: Annotated[tuple[float, ...], msgspec.Meta(min_length=36, max_length=36)] | None
    hypotheses: Annotated[tuple[Placement, ...], msgspec.Meta(max_length=16)] = ()
    floor: Name = ""
    protection_m: float | None = None
    protection_deg: float | None = None
    hypothesis_floors: Annotated[tuple[Name, ...], msgspec.Meta(max_length=16)] = ()


class FixNote(msgspec.Struct, frozen=True, kw_only=True):
    """One comparison of a frame with the map before a failure.

    position_map_m is None without a fix; refused: reason why it was not used. innovation: its squared Mahalanobis distance, None
    without a prediction.
    """

    stamp_ns: int
    status: Name
    position_map_m: tuple[float, float, float] | None = None
    inliers: int | None = None
    innovation: float | None = None
    refused: Text = ""


class Thumbnail(msgspec.Struct, frozen=True, kw_only=True):
    """A small JPEG. kind: `frame`, the left image; `matches`, the same beside the landmarks expected by the map."""

    stamp_ns: int
    kind: Name
    jpeg: Annotated[bytes, msgspec.Meta(max_length=MAX_THUMBNAIL_BYTES)]


class CameraNote(msgspec.Struct, frozen=True, kw_only=True):
    """A robot's left camera after rectification, without distortion, and its mounting; older robots do not report it."""

    size_px: tuple[int, int]
    focal_px: float
    centre_px: tuple[float, float]
    base_from_cam: Placement


_Count = Annotated[int, msgspec.Meta(ge=-(1 << 31), le=1 << 31)]


class FailureEvidence(msgspec.Struct, frozen=True, array_like=True):
    """What the server judges a failure by, beside its report, at most 200 bytes.

    Of the first image without a fix: view_percent of its cells with tracked points; cells: of the map, a metre wide, those with the most
    expected landmarks: x and y in cells from the robot's believed one, and its expected and seen landmarks. usual_percent of the expected
    landmarks were seen until then, 0 if unknown. places: where fixes agree: x and y in `map` in centimetres, number of fixes, and percent
    of the landmarks expected there that they found. broke: all tracks were lost between two good images. dropped_percent of the last
    seconds' frames. flags: sensors left out or silent, and overload.
    """

    view_percent: _Count
    usual_percent: _Count
    cells: Annotated[tuple[tuple[_Count, _Count, _Count, _Count], ...], msgspec.Meta(max_length=9)] = ()
    places: Annotated[tuple[tuple[_Count, _Count, _Count, _Count], ...], msgspec.Meta(max_length=3)] = ()
    broke: bool = False
    dropped_percent: _Count = 0
    flags: Annotated[tuple[Name, ...], msgspec.Meta(max_length=2)] = ()


class FailureReport(msgspec.Struct, frozen=True, kw_only=True):
    """A position failure with its context, as docs/reports.md defines failures.

    Sent until it is acknowledged; (site, robot, id) is unique forever, so that duplicates are stored once.

    stamp_ns: start, sensor clock; wall_ns: the same moment by the robot's wall clock. duration_s: its duration
    when it was detected. kind: a `FailureKind`; suspected ones estimate silent failures and are not counted. cause: a `Cause`.
    tile, map_from_base, radius_95_m: the robot's estimate at the start, None without a pose. wrong_by_m: distance from it to
    the place of fixes that agree with each other, None without such fixes. landmarks_expected, landmarks_seen: in the first image in which
    the robot was not localised, by its estimate then. exposure: mean brightness of the left image, 0 to 1; sharpness: variance of the steps
    between neighbouring pixels of a row, 1 is typical for the robot. calibration: the wrong parameter and its error, empty for none.
    view: of a rig with several, the one that was compared with the map, whose camera and pictures these are; None with one. evidence:
    None from older robots.
    """

    site: Name
    robot: Name
    id: Name
    stamp_ns: int
    wall_ns: int
    duration_s: Annotated[float, msgspec.Meta(ge=0)]
    kind: Name
    status: Name
    cause: Name
    version: Version | None
    tile: tuple[int, int] | None = None
    map_from_base: Placement | None = None
    radius_95_m: float | None = None
    wrong_by_m: float | None = None
    landmarks_expected: int | None = None
    landmarks_seen: int | None = None
    innovation: float | None = None
    inliers: int | None = None
    exposure: float | None = None
    sharpness: float | None = None
    calibration: Text = ""
    camera: CameraNote | None = None
    view: Annotated[int, msgspec.Meta(ge=0, le=15)] | None = None
    evidence: FailureEvidence | None = None
    fixes: Annotated[tuple[FixNote, ...], msgspec.Meta(max_length=20)] = ()
    thumbnails: Annotated[tuple[Thumbnail, ...], msgspec.Meta(max_length=4)] = ()


class FailureAck(msgspec.Struct, frozen=True, kw_only=True):
    """The server has stored this report, now or earlier. refused: reason for a permanent refusal, so that it is not sent again.
    received_bytes: of the failure's recording, from its beginning on; its size once it is stored."""

    id: Name
    refused: Text = ""
    received_bytes: Annotated[int, msgspec.Meta(ge=0, le=1 << 40)] = 0


M = TypeVar("M", bound=msgspec.Struct)
encode_message = to_msgpack
"""Encode a message as MessagePack."""


def covariance_entries(cov_rot_trans: Array) -> tuple[float, ...]:
    """Entries (36,) of a covariance (6, 6), row by row; those that are not known, infinite or above MOST, as MOST."""
    return tuple(np.nan_to_num(cov_rot_trans, nan=MOST).clip(-MOST, MOST).ravel().tolist())


def decode_message(data: bytes, message_type: type[M]) -> M:
    """Decode the message in `data`; raises LinkError for bytes of another type, and for numbers that `bounded` refuses."""
    if len(data) > MAX_MESSAGE_BYTES:
        raise LinkError(f"{message_type.__name__} of {len(data)} bytes, the limit is {MAX_MESSAGE_BYTES}")
    try:
        return bounded(msgspec.msgpack.decode(data, type=message_type))
    except (ValueError, RecursionError) as error:
        fault = f"{len(data)} bytes are no {message_type.__name__} ({error})"
        raise LinkError(f"{fault}; do both sides run the same fleetmap?") from error


def part_of(data: bytes, question: bytes) -> bytes:
    """Return the encoded Part of `data` for an encoded ChunkRequest; raises LinkError as `decode_message`."""
    asked = decode_message(question, ChunkRequest) if question else ChunkRequest()
    part = data[asked.offset : asked.offset + asked.max_bytes]
    return encode_message(Part(total_bytes=len(data), offset=asked.offset, data=part))


def robot_key(site: str, robot: str, what: str) -> str:
    """Key of a robot's queries or publications, such as `wanted` or `blobs/{sha256}`; '*' for any site or robot."""
    return f"{_ROOT}/{site}/robots/{robot}/{what}"


def split_key(key: str) -> tuple[str, str, str]:
    """Site, robot (or 'live') and last chunk of a key; raises LinkError for any other key."""
    chunks = key.split("/") if len(key) <= _MAX_KEY else []
    if chunks[:1] == [_ROOT]:
        if chunks[2:3] == ["robots"] and (len(chunks) == 5 or (len(chunks) == 6 and chunks[4] in MAP_PARTS)):
            return chunks[1], chunks[3], chunks[-1]
        if len(chunks) == 4 and chunks[2] == "live":
            return chunks[1], chunks[2], chunks[3]
    raise LinkError(f"key {key[:200]!r} is none of fleetmap's; its keys are listed in fleetmap.messages")
