"""Roles and what they allow."""

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from fleetmap.errors import UsageError

if TYPE_CHECKING:
    from mapserver.store import Actor

_NAME = re.compile(r"[a-z0-9][a-z0-9._@+-]{0,63}")


class Scope(StrEnum):
    """What a request may be allowed to do."""

    READ = "read"
    METRICS = "metrics"
    CHANGE = "change"
    ROBOTS = "robots"
    OPERATORS = "operators"


class Role(StrEnum):
    """What a person is to the fleet."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    ADMIN = "admin"


SCOPES: dict[str, frozenset[Scope]] = {
    Role.VIEWER: frozenset({Scope.READ}),
    Role.OPERATOR: frozenset({Scope.READ, Scope.METRICS, Scope.CHANGE}),
    Role.ADMIN: frozenset(Scope),
    # A name that is nobody's: it has tokens alone, each with the scopes that it was made with.
    "program": frozenset(Scope),
}


@dataclass(frozen=True, slots=True)
class Identity:
    """Who sends a request, as a session, a token or a proxy has proved it. proof: the hash of a session, empty without one."""

    name: str
    role: str
    scopes: frozenset[str]
    address: str
    proof: str = ""
    is_token: bool = False

    def actor(self, reason: str = "") -> "Actor":
        from mapserver.store import Actor

        return Actor(self.name, reason, f"token of {self.name}" if self.is_token else self.name, self.address)


def check_operator_name(name: str) -> str:
    """The name; UsageError for one that nobody can have."""
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{name[:80]!r} is no operator's name; use up to 64 small letters, digits and . _ @ + -, such as ada"
        )
    return name
