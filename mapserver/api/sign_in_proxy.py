"""Users signed in by a proxy in front of the server. See docs/security.md.

The proxy sends their name and groups in headers. These are accepted from the proxy's addresses only and removed from all other requests.
"""

import re
import time
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from starlette.types import ASGIApp, Receive, Scope, Send

from fleetmap.errors import UsageError
from mapserver.operators.roles import SCOPES, Identity, Role
from mapserver.serving.http_connections import plain_address

USER, GROUPS = b"x-forwarded-user", b"x-forwarded-groups"
PREFIX = "proxy:"  # prefix of their names in the log; names of operators contain no colon
PAGE_S = 3600  # after which an open page is loaded and authenticated by the proxy again
_KEY = "fleetmap.proxied"
_NAME = re.compile(r"[A-Za-z0-9._@+|:/=~-]{1,128}")


class _Person(NamedTuple):
    name: str
    groups: tuple[str, ...]
    seen_s: float


class SignInProxy(NamedTuple):
    """Addresses of proxies, and the roles of their groups. UsageError for an invalid address."""

    addresses: frozenset[str]
    roles: Mapping[str, Role]
    clock_s: Callable[[], float] = time.monotonic

    @classmethod
    def of(cls, addresses: Iterable[str], groups: Iterable[str]) -> "SignInProxy":
        """Parse text such as `127.0.0.1` and `map-people=operator`; UsageError for invalid text."""
        roles: dict[str, Role] = {}
        for given in groups:
            group, _, role = given.rpartition("=")
            if not group or role not in set(Role):
                raise UsageError(
                    f"--sign-in-group {given!r}: write it like map-people=operator, with one of {', '.join(Role)}"
                )
            if group in roles:
                raise UsageError(f"--sign-in-group names {group!r} twice; give it one role")
            roles[group] = Role(role)
        if not roles:
            raise UsageError(
                "--sign-in-proxy needs --sign-in-group GROUP=ROLE: without a role no user of the proxy may sign in"
            )
        return cls(frozenset(_address(given) for given in addresses), roles)

    def identify(self, scope: Scope, address: str) -> Identity | None:
        """Return the user named by a proxy, with the highest role of their groups; None without a name, or for groups without a role."""
        person: _Person | None = scope.get(_KEY)
        if person is None or self.clock_s() - person.seen_s > PAGE_S:
            return None
        roles = (self.roles[group] for group in person.groups if group in self.roles)
        role = max(roles, key=list(Role).index, default=None)
        return None if role is None else Identity(PREFIX + person.name, role, SCOPES[role], address)


class ProxiedPeople:
    """Outermost ASGI layer: removes the headers from requests, and keeps the values sent by the proxies."""

    def __init__(self, app: ASGIApp, proxy: SignInProxy | None) -> None:
        self._app, self._proxy = app, proxy

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            named = [
                (name, value.decode("latin-1").strip()) for name, value in scope["headers"] if name in (USER, GROUPS)
            ]
            scope = {**scope, "headers": [pair for pair in scope["headers"] if pair[0] not in (USER, GROUPS)]}
            users = [value for name, value in named if name == USER]
            # A second name would come from the client and have been passed on by the proxy.
            if self._proxy is not None and len(users) == 1 and _NAME.fullmatch(users[0]) and _is_of(scope, self._proxy):
                groups = (group.strip() for name, value in named if name == GROUPS for group in value.split(","))
                scope[_KEY] = _Person(users[0], tuple(groups), self._proxy.clock_s())
        await self._app(scope, receive, send)


def proxied_name(scope: Scope) -> str:
    """Return the user named by a proxy, whatever the groups; empty if absent."""
    person: _Person | None = scope.get(_KEY)
    return "" if person is None else PREFIX + person.name


def _is_of(scope: Scope, proxy: SignInProxy) -> bool:
    try:
        return plain_address(scope["client"][0]) in proxy.addresses
    except (ValueError, TypeError):  # a client without an address
        return False


def _address(given: str) -> str:
    try:
        return plain_address(given)
    except ValueError as error:
        raise UsageError(f"--sign-in-proxy {given!r}: write the proxy's address like 127.0.0.1") from error
