"""Access control for the whole server and its mounted pages: host names, origins, sign-in, headers. Plain ASGI.

With sign-in on, every request except those in `_OPEN` needs a scope; an unlisted path needs the strongest scope of its method.
"""

import logging
import re
from html import escape
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from urllib.parse import quote, urlsplit

from anyio import to_thread
from fastapi import Depends, Query, Request
from starlette.exceptions import HTTPException
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fleetmap.bus.endpoints import is_loopback_name
from fleetmap.errors import StoreError
from mapserver.api.operations import OPERATIONS
from mapserver.api.problems import problem
from mapserver.api.sign_in_proxy import SignInProxy, proxied_name
from mapserver.api.views import Act
from mapserver.operators.operators import LIFE_S, Operators
from mapserver.operators.roles import Identity
from mapserver.operators.roles import Scope as Right
from mapserver.store import Actor

_log = logging.getLogger(__name__)
SIGN_IN, SIGN_OUT, STYLE = "/sign-in", "/sign-out", "/dashboard/static/style.css"
_OPEN = {"/healthz", "/readyz", SIGN_IN, SIGN_OUT, STYLE}
_RIGHTS = (  # needed for reading, too, as what operations say of their paths
    (re.compile(r"/metrics$"), Right.METRICS),
    (re.compile(r"(/v1/log|/dashboard/administration/(people|log))(/|$)"), Right.OPERATORS),
)
_FORWARDED = {"forwarded", "x-forwarded-for", "x-real-ip"}
_FORBIDDEN = Path(__file__).with_name("forbidden.html").read_text("utf-8")
_POLICY = (
    b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; base-uri 'none'; "
    b"form-action 'self'; frame-ancestors 'none'"
)
_FIXED = [
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"same-origin"),
    (b"x-frame-options", b"DENY"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"permissions-policy", b"camera=(), microphone=(), geolocation=()"),
]


class GuardSettings(NamedTuple):
    """Settings of the guard.

    names: accepted host names, beside localhost and addresses. operators: accounts; None: those of the application's store.
    must_sign_in: also before the first operator is added. warning: a banner for every page.
    proxy: an additional sign-in proxy in front of the server; None: passwords only.
    """

    names: frozenset[str] = frozenset()
    operators: Operators | None = None
    must_sign_in: bool = False
    warning: str = ""
    proxy: SignInProxy | None = None

    @property
    def is_sign_in_on(self) -> bool:
        return self.must_sign_in or (self.operators is not None and self.operators.is_sign_in_on)

    def identify(self, scope: Scope, *, uses: bool = True) -> Identity | None:
        """Return the sender of a request by the store's present state. uses: whether the request extends the session."""
        if self.operators is None:
            return None
        headers = _headers(scope)
        session = cookie_parser(headers.get("cookie", "")).get(cookie_name(scope), "")
        who = self.operators.identify(session, headers.get("authorization", ""), address_of(scope), uses=uses)
        return who or (None if self.proxy is None else self.proxy.identify(scope, address_of(scope)))


class _Sender:
    """Who sends a request: the authenticated operator, None if sign-in is off."""

    def __init__(self, request: Request) -> None:
        self.who: Identity | None = getattr(request.state, "operator", None)
        self._address = address_of(request.scope)

    def of(self, act: Act) -> Actor:
        """Return the actor of a change: the authenticated operator, or the one that it names if sign-in is off."""
        if self.who is None:
            if not act.actor:
                raise HTTPException(422, "`actor` is missing: name the person who acts")
            return Actor(act.actor, act.reason, "", self._address)
        if act.actor and act.actor != self.who.name:
            words = f"the request comes from {self.who.name} and names {act.actor[:80]!r}; leave `actor` out"
            raise HTTPException(403, words)
        return self.who.actor(act.reason)


Sender = Annotated[_Sender, Depends()]


def _acting(
    sender: Sender,
    actor: Annotated[str | None, Query(min_length=1, max_length=200, examples=["ada"])] = None,
    reason: Annotated[str, Query(max_length=2000, examples=["racks were moved"])] = "",
) -> Actor:
    return sender.of(Act(actor=actor, reason=reason))


By = Annotated[Actor, Depends(_acting)]
"""The actor of a request whose body is a file, with author and reason in the query."""


def cookie_name(scope: Scope) -> str:
    """Name of the session's cookie. Under TLS the `__Host-` name: browsers accept it from this host and over TLS only."""
    return "__Host-fleetmap" if _is_secure(scope) else "fleetmap"


def set_session(response: Response, scope: Scope, session: str) -> None:
    """Set a browser's session cookie; an empty session deletes it."""
    secure, age_s = _is_secure(scope), LIFE_S if session else 0
    response.set_cookie(cookie_name(scope), session, age_s, secure=secure, httponly=True, samesite="strict", path="/")


def address_of(scope: Scope) -> str:
    """The address that a request comes from."""
    client = scope.get("client")
    return str(client[0])[:64] if client else ""


class Guard:
    """Refuses forbidden requests, stores the operator in `request.state.operator`, and adds headers to responses."""

    def __init__(self, app: ASGIApp, settings: GuardSettings) -> None:
        self._app, self._settings = app, settings
        asked = (one for one in OPERATIONS.values() if one.needs is not Right.CHANGE)
        paths = ((re.compile(re.sub(r"{\w+}", "[^/]+", one.path) + "(/|$)"), one.needs) for one in asked)
        self._rights = (*_RIGHTS, *paths)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":  # nothing here speaks it
            await receive()
            return await send({"type": "websocket.close", "code": 4403})
        if scope["type"] != "http":
            return await self._app(scope, receive, send)
        try:
            refusal = self._refused_place(scope) or await to_thread.run_sync(self._refused_person, scope)
        except StoreError as error:  # who asks may be a stranger, to whom it says nothing of the store
            _log.error("%s %r: %s", scope["method"], scope["path"][:200], error)
            refusal = _refuse(scope, 503, "the store does not answer; see the server's log")

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": _with_ours(scope, message["headers"])}
            await send(message)

        return await (refusal or self._app)(scope, receive, answer)

    def _refused_place(self, scope: Scope) -> Response | None:
        """Refuse foreign host names (DNS rebinding) and requests sent by pages of other origins."""
        headers = _headers(scope)
        host = headers.get("host", "").lower()
        if not self._is_ours(host):
            return _refuse(scope, 403, f"unknown host name {host[:80]!r}; add it with --http-name")
        if scope["method"] in {"GET", "HEAD", "OPTIONS"}:
            return None
        origin, site = headers.get("origin"), headers.get("sec-fetch-site")
        is_other = origin is not None and origin.lower().partition("://")[2] != host
        if site not in {None, "same-origin", "none"} or is_other:
            return _refuse(scope, 403, "a page of another origin sent this request; open the server's own page")
        return None

    def _is_ours(self, host: str) -> bool:
        try:
            name = (urlsplit(f"//{host}").hostname or "").removesuffix(".")
            # An address cannot be redirected by DNS: a page under it comes from this server.
            return name == "localhost" or name in self._settings.names or bool(ip_address(name))
        except ValueError:
            return False

    def _refused_person(self, scope: Scope) -> Response | None:
        """Refuse requests without a session or token, or with insufficient rights."""
        right = self._needed(scope)
        if right is None:
            return None
        if not self._settings.is_sign_in_on:
            # The server's own machine, and not for somebody else, as a proxy on it does
            is_from_here = is_loopback_name(address_of(scope)) and _FORWARDED.isdisjoint(_headers(scope))
            is_open = right not in {Right.OPERATORS, Right.ROBOTS} or is_from_here
            words = "without operators only the server's own machine may do this; `mapserver operators add NAME --role admin` there"
            return None if is_open else _refuse(scope, 403, words)
        headers = _headers(scope)
        is_by_itself = "fleetmap-renewal" in headers or headers.get("accept") == "text/event-stream"  # an open page
        who = self._settings.identify(scope, uses=not is_by_itself)
        if who is None and (name := proxied_name(scope)):
            return _refuse(
                scope, 403, f"none of the groups of {name} has a role here; --sign-in-group gives one a role"
            )
        if who is None:
            if _is_for_a_page(scope):
                asked = scope["path"] + (f"?{scope['query_string'].decode('latin-1')}" if scope["query_string"] else "")
                return RedirectResponse(f"{SIGN_IN}?next={quote(asked, safe='')}", 303)
            return _refuse(scope, 401, "sign in, or send a valid token", {"WWW-Authenticate": "Bearer"})
        if right not in who.scopes:
            words = f"this needs the right to {right.value!r}, which {who.name} ({who.role}) does not have"
            if self._settings.operators is not None:
                self._settings.operators.note("refused", f"{scope['method']} {scope['path'][:200]!r}", who.actor())
            if _is_for_a_page(scope):
                words = f"{who.name} ({who.role}) may not open this page; an admin may."
                return HTMLResponse(_FORBIDDEN.format(style=STYLE, words=escape(words)), 403)
            return _refuse(scope, 403, words)
        scope.setdefault("state", {})["operator"] = who
        return None

    def _needed(self, scope: Scope) -> Right | None:
        path = scope["path"].removeprefix(scope.get("root_path", "").rstrip("/"))  # as routes are found
        if path in _OPEN:
            return None
        for pattern, right in self._rights:
            if pattern.match(path):
                return right
        return Right.READ if scope["method"] in {"GET", "HEAD", "OPTIONS"} else Right.CHANGE


def _with_ours(scope: Scope, headers: Any) -> list[tuple[bytes, bytes]]:
    """Return the headers of a response with those common to all; pictures have their own stricter policy."""
    fixed = [*_FIXED, *([(b"strict-transport-security", b"max-age=31536000")] if _is_secure(scope) else [])]
    names = {name for name, _ in fixed}
    kept = [(name.lower(), value) for name, value in headers if name.lower() not in names]
    if "operator" in scope.get("state", {}):
        kept = [(n, v.replace(b"public", b"private") if n == b"cache-control" else v) for n, v in kept]
    if b"content-security-policy" not in dict(kept):
        kept.append((b"content-security-policy", _POLICY))
    return kept + fixed


def _is_for_a_page(scope: Scope) -> bool:
    """True if a browser opens an address."""
    return scope["method"] == "GET" and "text/html" in _headers(scope).get("accept", "")


def _refuse(scope: Scope, status: int, words: str, headers: dict[str, str] | None = None) -> Response:
    is_read = scope["method"] in {"GET", "HEAD"}
    more = {} if is_read else {"Connection": "close"}  # the body is not read
    return problem(status, words, scope["path"], {**(headers or {}), **more})


def _headers(scope: Scope) -> dict[str, str]:
    return {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}


def _is_secure(scope: Scope) -> bool:
    return scope.get("scheme") == "https"
