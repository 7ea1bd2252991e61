"""Instant actions on maps and position: their parameters, states and errors."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from fleetmap.errors import LinkError
from locclient.plugins.vda5050.messages import Action, ActionState, Error, Reference

PARAMETERS: Mapping[str, Mapping[str, str]] = {
    "downloadMap": {"mapId": "STRING", "mapVersion": "STRING", "mapDownloadLink": "STRING", "mapHash": "STRING?"},
    "enableMap": {"mapId": "STRING", "mapVersion": "STRING"},
    "deleteMap": {"mapId": "STRING", "mapVersion": "STRING"},
    "initializePosition": {"x": "NUMBER", "y": "NUMBER", "theta": "NUMBER", "mapId": "STRING", "lastNodeId": "STRING"},
    "stateRequest": {},
    "factsheetRequest": {},
    "clearInstantActions": {},
}
"""Parameters and their types by action; `?`: optional."""
MAP_ACTIONS = ("downloadMap", "enableMap", "deleteMap")
OVER = ("FINISHED", "FAILED")
_MOST_STATES = 200
_MOST_SIGNS = 2000


class RefusedActionError(LinkError):
    """An instant action that fails, with type and level of its error."""

    def __init__(self, error_type: str, words: str, level: str = "WARNING") -> None:
        super().__init__(words)
        self.error_type, self.level = error_type, level


def parameters(action: Action, robot_actions: Sequence[str] = ()) -> dict[str, Any]:
    """Return the action's parameters by name; RefusedActionError for an unknown action, and for missing, unknown or invalid ones."""
    refused, name = partial(RefusedActionError, "INVALID_INSTANT_ACTION"), action.action_type
    if name not in PARAMETERS:
        raise refused(f"{name[:80]!r} is unknown here; known are {', '.join([*PARAMETERS, *robot_actions])}")
    kinds, given = PARAMETERS[name], {parameter.key: parameter.value for parameter in action.action_parameters}
    for key in [key for key in given if key not in kinds]:
        raise refused(f"{name} has no parameter {key[:80]!r}; it has {', '.join(kinds) or 'none'}")
    for key, kind in kinds.items():
        if key not in given and not kind.endswith("?"):
            raise refused(f"{name} needs the parameter {key}")
        if key in given and not _fits(given[key], kind.rstrip("?")):
            raise refused(f"{key} = {str(given[key])[:80]!r} of {name} must be a {kind.rstrip('?').lower()}")
    return given


def _fits(value: object, kind: str) -> bool:
    if kind == "STRING":
        return isinstance(value, str) and len(value) <= _MOST_SIGNS
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


class ActionBook:
    """States of received instant actions, and errors by their end condition. For one thread at a time."""

    def __init__(self) -> None:
        self._states: dict[str, ActionState] = {}
        self._told: set[str] = set()  # actions whose end was in a state
        self._errors: dict[str, list[Error]] = {}

    def __contains__(self, action_id: str) -> bool:
        return action_id in self._states

    def set(self, action: Action, status: str, result: str = "") -> None:
        """Set the state of an action; above the maximum number, drop those that finished first."""
        self._states[action.action_id] = ActionState(
            action_id=action.action_id,
            action_type=action.action_type,
            action_descriptor=action.action_descriptor or None,
            action_status=status,  # type: ignore[arg-type]
            action_result=result[:_MOST_SIGNS] or None,
        )
        over = [key for key, state in self._states.items() if state.action_status in OVER]
        for key in over[: max(0, len(self._states) - _MOST_STATES)]:
            del self._states[key]

    def tell(self) -> list[ActionState]:
        """Return all states, for a message that reports them."""
        self._told = {key for key, state in self._states.items() if state.action_status in OVER}
        return list(self._states.values())

    def clear(self) -> None:
        """Forget actions whose end was reported."""
        self._states = {key: state for key, state in self._states.items() if key not in self._told}

    def fail(self, action: Action, fault: Exception) -> None:
        """Mark the action as failed, with an error until another action of its kind is accepted."""
        told = fault if isinstance(fault, RefusedActionError) else RefusedActionError("MAP_ACTION_FAILED", str(fault))
        self.set(action, "FAILED", str(told))
        given = {each.key: str(each.value)[:_MOST_SIGNS] for each in action.action_parameters[:20]}
        until, shown = "map" if action.action_type in MAP_ACTIONS else "instant", {"actionId": action.action_id} | given
        self.add_error(until, told.error_type, str(told), shown, told.level)

    def accepted(self, action: Action) -> None:
        """End errors that last until an action of this kind is accepted."""
        self.end("instant")
        if action.action_type in MAP_ACTIONS:
            self.end("map")

    def add_error(
        self, until: str, error_type: str, words: str, references: Mapping[str, str], level: str = "WARNING"
    ) -> None:
        """Add an error that lasts until `end(until)`; at most as many as actions."""
        error = Error(
            error_type=error_type,
            error_level=level,  # type: ignore[arg-type]
            error_references=[
                Reference(reference_key=key[:200], reference_value=str(value)) for key, value in references.items()
            ],
            error_description=words[:_MOST_SIGNS],
        )
        self._errors.setdefault(until, []).append(error)
        del self._errors[until][:-_MOST_STATES]

    def end(self, until: str) -> None:
        self._errors.pop(until, None)

    @property
    def errors(self) -> list[Error]:
        return [error for errors in self._errors.values() for error in errors]
