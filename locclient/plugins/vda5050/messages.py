"""Received messages of VDA 5050 3.0.0, and the robot program's part of the state. Names are those of the standard.

Objects copied into sent messages are decoded strictly, so that they cannot make a message invalid.
"""

from datetime import UTC, datetime
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from fleetmap.encoding import bounded
from fleetmap.errors import LinkError

MAX_PAYLOAD_BYTES = 256 << 10
_MOST = 1000
T = TypeVar("T")

Text = Annotated[str, msgspec.Meta(max_length=4096)]
Count = Annotated[int, msgspec.Meta(ge=0, le=(1 << 32) - 1)]
Percent = Annotated[float, msgspec.Meta(ge=0, le=100)]
Positive = Annotated[float, msgspec.Meta(ge=0)]
Angle = Annotated[float, msgspec.Meta(ge=-3.14159265359, le=3.14159265359)]


class Struct(msgspec.Struct, rename="camel", omit_defaults=True, kw_only=True):
    """An object of the standard; unknown fields are ignored."""


class Strict(Struct, forbid_unknown_fields=True):
    """An object that is copied into sent messages."""


class ActionParameter(Struct):
    key: Text
    value: Any = None


class Action(Struct):
    action_type: Text
    action_id: Text
    blocking_type: Text
    action_descriptor: Text = ""
    action_parameters: Annotated[list[ActionParameter], msgspec.Meta(max_length=_MOST)] = []


class InstantActions(Struct):
    header_id: int
    actions: Annotated[list[Action], msgspec.Meta(max_length=_MOST)]


class NodePosition(Struct):
    map_id: Text


class OrderNode(Struct):
    node_position: NodePosition | None = None


class Order(Struct):
    order_id: Text
    nodes: Annotated[list[OrderNode], msgspec.Meta(max_length=100_000)]


class PowerSupply(Strict):
    state_of_charge: Percent
    charging: bool
    battery_voltage: float | None = None
    battery_current: float | None = None
    battery_health: Percent | None = None
    range: Positive | None = None


class SafetyState(Strict):
    active_emergency_stop: Literal["MANUAL", "REMOTE", "NONE"]
    field_violation: bool


class Velocity(Strict):
    vx: float | None = None
    vy: float | None = None
    omega: float | None = None


class StateNodePosition(Strict):
    x: float
    y: float
    map_id: Text
    theta: Angle | None = None


class NodeState(Strict):
    node_id: Text
    sequence_id: Count
    released: bool
    node_descriptor: Text | None = None
    node_position: StateNodePosition | None = None


class EdgeState(Strict):
    edge_id: Text
    sequence_id: Count
    released: bool
    edge_descriptor: Text | None = None


class Load(Strict):
    load_id: Text | None = None
    load_type: Text | None = None
    load_position: Text | None = None
    weight: Positive | None = None


class Reference(Strict):
    reference_key: Text
    reference_value: Text


class Error(Strict):
    error_type: Text
    error_level: Literal["WARNING", "URGENT", "CRITICAL", "FATAL"]
    error_references: list[Reference] | None = None
    error_description: Text | None = None
    error_hint: Text | None = None


class ActionState(Strict):
    action_id: Text
    action_status: Literal["WAITING", "INITIALIZING", "RUNNING", "PAUSED", "RETRIABLE", "FINISHED", "FAILED"]
    action_type: Text | None = None
    action_descriptor: Text | None = None
    action_result: Text | None = None


class Information(Strict):
    info_type: Text
    info_level: Literal["INFO", "DEBUG"]
    info_references: list[Reference] | None = None
    info_descriptor: Text | None = None


class RobotPart(Strict):
    operating_mode: Literal["STARTUP", "AUTOMATIC", "SEMIAUTOMATIC", "INTERVENED", "MANUAL", "SERVICE", "TEACH_IN"]
    power_supply: PowerSupply
    safety_state: SafetyState
    driving: bool | None = None
    paused: bool | None = None
    new_base_request: bool | None = None
    distance_since_last_node: Positive | None = None
    velocity: Velocity | None = None
    order_id: Text = ""
    order_update_id: Count = 0
    last_node_id: Text = ""
    last_node_sequence_id: Count = 0
    node_states: Annotated[list[NodeState], msgspec.Meta(max_length=_MOST)] = []
    edge_states: Annotated[list[EdgeState], msgspec.Meta(max_length=_MOST)] = []
    action_states: Annotated[list[ActionState], msgspec.Meta(max_length=_MOST)] = []
    loads: Annotated[list[Load], msgspec.Meta(max_length=_MOST)] | None = None
    instant_action_states: Annotated[list[ActionState], msgspec.Meta(max_length=_MOST)] = []
    errors: Annotated[list[Error], msgspec.Meta(max_length=_MOST)] = []
    information: Annotated[list[Information], msgspec.Meta(max_length=_MOST)] = []


def without_nulls(value: Any) -> Any:
    """Return decoded JSON without the members that are null: fleet managers write optional fields that they do not use so."""
    if isinstance(value, dict):
        return {key: without_nulls(member) for key, member in value.items() if member is not None}
    return [without_nulls(each) for each in value] if isinstance(value, list) else value


def decode(payload: bytes, kind: type[T]) -> T:
    """Decode the message of a payload; LinkError if invalid."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise LinkError(f"{len(payload)} bytes, the limit is {MAX_PAYLOAD_BYTES}")
    try:
        return bounded(msgspec.convert(without_nulls(msgspec.json.decode(payload)), kind))
    except (ValueError, RecursionError) as error:
        raise LinkError(str(error)[:300]) from error


def timestamp(wall_ns: int) -> str:
    """Format a time as the standard requires."""
    moment = datetime.fromtimestamp(wall_ns // 1_000_000 / 1000, UTC)
    return moment.replace(tzinfo=None).isoformat(timespec="milliseconds") + "Z"
