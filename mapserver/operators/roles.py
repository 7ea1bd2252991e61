"""Roles and their rights."""

import re
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple

from fleetmap.errors import UsageError

if TYPE_CHECKING:
    from mapserver.store import Actor

OPERATOR_PATTERN = r"^[a-z0-9][a-z0-9._@+-]{0,63}$"
_NAME = re.compile(OPERATOR_PATTERN)


class Scope(StrEnum):
    """Right of a request."""

    READ = "read"
    METRICS = "metrics"
    CHANGE = "change"
    ROBOTS = "robots"
    OPERATORS = "operators"


class Role(StrEnum):
    """Role of a user."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    ADMIN = "admin"


SCOPES: dict[str, frozenset[Scope]] = {
    Role.VIEWER: frozenset({Scope.READ}),
    Role.OPERATOR: frozenset({Scope.READ, Scope.METRICS, Scope.CHANGE}),
    Role.ADMIN: frozenset(Scope),
    # A program, not an operator: it has tokens only, each with its own scopes.
    "program": frozenset(Scope),
}


class Identity(NamedTuple):
    """Authenticated sender of a request, by session, token or proxy. proof: the hash of a session, empty if absent."""

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
    """Return the name; UsageError for an invalid one."""
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{name[:80]!r} is an invalid operator name; use up to 64 small letters, digits and . _ @ + -, such as ada"
        )
    return name
