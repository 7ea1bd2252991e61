"""Access control of the bus: zenoh's rules, derived from the names in certificates.

Messages without a rule are denied, so a certificate is revoked by removing it from the list.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

from fleetmap.messages import MAP_PARTS, robot_key

REPORTS = ("ack", "health", "pose", "estimate")
QUESTIONS = ("wanted", "failures", "replays", "renew")
ORDERS = ("wanted", "initial_pose")
"""Topics that only the server publishes, each to one robot: otherwise a copied identity could move the original robot."""
ALIVE = ("alive",)
# Far above the rates of robots: zenoh drops a message that follows another one sooner than this; it allows no burst.
_MOST_HZ = {"ack": 10.0, "health": 10.0, "pose": 60.0, "estimate": 60.0}
_REPORT_BYTES, _QUESTION_BYTES = 1 << 16, 1 << 20
_NOBODY = "-"

# Zenoh's words for the direction of a message, as the server sees it, and for its kind
Direction = Literal["ingress", "egress"]
Act = Literal[
    "put", "query", "reply", "declare_subscriber", "declare_queryable", "liveliness_token", "liveliness_query"
]


class Purpose(StrEnum):
    """Purpose of a certificate: operation of a robot, its first renewal (enrolment), or the display of a running survey."""

    ROBOT = "robot"
    ENROL = "enrol"
    SURVEY = "survey"


@dataclass(frozen=True, slots=True)
class Holder:
    """Holder of a certificate. certificate: its common name; site and robot: empty for a survey. floors: other sites of the robot's
    building, whose published maps it may fetch too.
    """

    certificate: str
    site: str = ""
    robot: str = ""
    purpose: Purpose = Purpose.ROBOT
    floors: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Rule:
    """Messages that may pass under keys that any of `keys` includes."""

    id: str
    flow: Direction
    acts: tuple[Act, ...]
    keys: tuple[str, ...]


class Access:
    """Rules for the holders of certificates; all other participants are denied everything. robots: enrolled ones, by site and name."""

    def __init__(self, holders: Iterable[Holder]) -> None:
        self._holders = {holder.certificate: holder for holder in holders}
        self.robots = {(holder.site, holder.robot) for holder in self._holders.values() if holder.robot}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Access) and self._holders == other._holders

    __hash__ = None  # type: ignore[assignment]

    def holder(self, certificate: str) -> Holder | None:
        """Holder of the certificate of this name; None if unknown or revoked."""
        return self._holders.get(certificate)

    def zenoh_config(self) -> dict[str, Any]:
        """Sections of zenoh's configuration that enforce the rules and limit rate and size of a participant's messages."""
        groups: dict[tuple[Rule, ...], list[str]] = {}  # the certificates of one robot have the same rules
        for holder in self._holders.values():
            groups.setdefault(_rules(holder), []).append(holder.certificate)
        if not groups:  # zenoh refuses empty lists, and lists that are missing
            groups = {(Rule(_NOBODY, "ingress", ("put",), (_NOBODY,)),): [_NOBODY]}
        rules = {rule.id: rule for group in groups for rule in group}
        access = {
            "enabled": True,
            "default_permission": "deny",
            "rules": [
                {"id": r.id, "permission": "allow", "flows": [r.flow], "messages": r.acts, "key_exprs": r.keys}
                for r in rules.values()
            ],
            "subjects": [{"id": names[0], "cert_common_names": names} for names in groups.values()],
            "policies": [{"rules": [r.id for r in group], "subjects": [names[0]]} for group, names in groups.items()],
        }
        rates = [{"key_expr": robot_key("*", "*", what), "freq": hz} for what, hz in _MOST_HZ.items()]
        reports = {"id": "reports", "flows": ["ingress"], "messages": ["put"]}
        report_bytes = {"key_exprs": [robot_key("*", "*", "*")], "size_limit": _REPORT_BYTES}
        questions = {"id": "questions", "flows": ["ingress"], "messages": ["query"]}
        question_bytes = {"key_exprs": ["fleetmap/**"], "size_limit": _QUESTION_BYTES}
        return {
            "access_control": access,
            "downsampling": [reports | {"rules": rates}],
            "low_pass_filter": [reports | report_bytes, questions | question_bytes],
        }


def _rules(holder: Holder) -> tuple[Rule, ...]:
    if holder.purpose is Purpose.SURVEY:
        return (Rule("survey-says", "ingress", ("put",), ("fleetmap/*/live/survey",)),)

    def own(whats: Iterable[str]) -> tuple[str, ...]:
        return tuple(robot_key(holder.site, holder.robot, what) for what in whats)

    name = f"{holder.site}/{holder.robot}"
    # A query and its reply are two messages in opposite directions; an error reply counts as a reply.
    if holder.purpose is Purpose.ENROL:
        renew = own(("renew",))
        return (
            Rule(f"{name}-enrols", "ingress", ("query",), renew),
            Rule(f"{name}-enrolled", "egress", ("reply",), renew),
        )
    questions = own((*QUESTIONS, *(f"{what}/*" for what in MAP_PARTS)))
    questions += tuple(robot_key(floor, holder.robot, f"{what}/*") for floor in holder.floors for what in MAP_PARTS)
    return (
        Rule(f"{name}-asks", "ingress", ("query",), questions),
        Rule(f"{name}-told", "egress", ("reply",), questions),
        Rule(f"{name}-reports", "ingress", ("put",), own(REPORTS)),
        Rule(f"{name}-listens", "ingress", ("declare_subscriber",), own(ORDERS)),
        Rule(f"{name}-ordered", "egress", ("put",), own(ORDERS)),
        Rule(f"{name}-alive", "ingress", ("liveliness_token",), own(ALIVE)),
    )
