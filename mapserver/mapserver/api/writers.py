"""Permission to change something over HTTP: on the server's own machine for everybody, elsewhere with the token."""

import hmac
from dataclasses import dataclass
from ipaddress import ip_address

from fastapi import Request
from starlette.exceptions import HTTPException


@dataclass(frozen=True, slots=True)
class Writers:
    """token: what requests must show as a bearer token; without one only loopback may write.

    is_loopback: whether the server listens on loopback alone.
    """

    token: str | None = None
    is_loopback: bool = True

    def check(self, request: Request) -> None:
        """Raises HTTPException 401 for a missing or wrong token, 403 where writing is off."""
        self.check_shown(request, request.headers.get("authorization", ""))

    def check_shown(self, request: Request, authorization: str) -> None:
        """As `check`, with an authorization that came otherwise than in the request's header."""
        if self.token is not None:
            shown = authorization.encode("latin-1", "replace")
            if not hmac.compare_digest(shown, f"Bearer {self.token}".encode()):
                raise HTTPException(401, "this needs the server's token", {"WWW-Authenticate": "Bearer"})
        elif not self.is_loopback:
            raise HTTPException(403, "the server listens beyond loopback without a token; start it with --token-file")
        elif not is_loopback_name(_host_of(request)):
            # A page from elsewhere may reach loopback under a name of its own (DNS rebinding).
            raise HTTPException(403, "ask the server under its loopback address to change something without a token")


def is_loopback_name(host: str) -> bool:
    """Whether a host's name or address is the machine itself."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def _host_of(request: Request) -> str:
    host = request.headers.get("host", "")
    return host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]
