"""States of a managed ROS 2 node, and the requests that change them. Source: ROS 2's design article on managed nodes."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from fleetmap.recordings.ros2.cdr import CdrReader, CdrWriter


class LifecycleState(IntEnum):
    """lifecycle_msgs/State: ids of states; those from 10 on last only while the node changes."""

    UNKNOWN = 0
    UNCONFIGURED = 1
    INACTIVE = 2
    ACTIVE = 3
    FINALIZED = 4
    CONFIGURING = 10
    CLEANINGUP = 11
    SHUTTINGDOWN = 12
    ACTIVATING = 13
    DEACTIVATING = 14
    ERRORPROCESSING = 15


@dataclass(frozen=True, slots=True)
class Transition:
    """lifecycle_msgs/TransitionDescription: from a state to one in which the node changes, and the state after that."""

    id: int
    label: str
    start: LifecycleState
    through: LifecycleState
    goal: LifecycleState
    success_id: int


_S = LifecycleState
TRANSITIONS = (
    Transition(1, "configure", _S.UNCONFIGURED, _S.CONFIGURING, _S.INACTIVE, 10),
    Transition(2, "cleanup", _S.INACTIVE, _S.CLEANINGUP, _S.UNCONFIGURED, 20),
    Transition(3, "activate", _S.INACTIVE, _S.ACTIVATING, _S.ACTIVE, 30),
    Transition(4, "deactivate", _S.ACTIVE, _S.DEACTIVATING, _S.INACTIVE, 40),
    Transition(5, "shutdown", _S.UNCONFIGURED, _S.SHUTTINGDOWN, _S.FINALIZED, 50),
    Transition(6, "shutdown", _S.INACTIVE, _S.SHUTTINGDOWN, _S.FINALIZED, 50),
    Transition(7, "shutdown", _S.ACTIVE, _S.SHUTTINGDOWN, _S.FINALIZED, 50),
)


def requested(request: bytes, state: LifecycleState) -> Transition | None:
    """The transition that a request of lifecycle_msgs/srv/ChangeState asks for: by its label, which wins, or its id.

    None for one that does not begin at this state. ValueError for bytes that are no request.
    """
    reader = CdrReader(request)
    number, label = reader.byte(), reader.text()
    here = [transition for transition in TRANSITIONS if transition.start is state]
    return next((one for one in here if (one.label == label if label else one.id == number)), None)


def encode_state(state: LifecycleState) -> bytes:
    """The response of lifecycle_msgs/srv/GetState."""
    return _put_state(CdrWriter(), state).message()


def encode_states() -> bytes:
    """The response of lifecycle_msgs/srv/GetAvailableStates."""
    writer = CdrWriter().unsigned(len(LifecycleState))
    for state in LifecycleState:
        _put_state(writer, state)
    return writer.message()


def encode_transitions(transitions: Sequence[Transition], *, with_success: bool = False) -> bytes:
    """The response of lifecycle_msgs/srv/GetAvailableTransitions; with_success: the steps out of the states between, too."""
    steps = [(one.id, one.label, one.start, one.through) for one in transitions]
    if with_success:
        steps += [(one.success_id, "transition_success", one.through, one.goal) for one in transitions]
    steps = list(dict.fromkeys(steps))
    writer = CdrWriter().unsigned(len(steps))
    for step in steps:
        _put_step(writer, *step)
    return writer.message()


def encode_events(stamp_ns: int, transition: Transition) -> list[bytes]:
    """Two lifecycle_msgs/TransitionEvent: into the state between, and out of it."""
    return [
        _put_step(CdrWriter().long_unsigned(stamp_ns), *step).message()
        for step in (
            (transition.id, transition.label, transition.start, transition.through),
            (transition.success_id, "transition_success", transition.through, transition.goal),
        )
    ]


def _put_state(writer: CdrWriter, state: LifecycleState) -> CdrWriter:
    return writer.byte(state.value).text(state.name.lower())


def _put_step(writer: CdrWriter, number: int, label: str, start: LifecycleState, goal: LifecycleState) -> CdrWriter:
    return _put_state(_put_state(writer.byte(number).text(label), start), goal)
