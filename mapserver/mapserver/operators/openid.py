"""Sign-in at an OpenID Connect provider by authlib: authorization code flow with state, nonce and PKCE. docs/security.md explains it.

The way back must bring the state that this server gave to the same browser (its cookie), once, within ten minutes. Of the provider's
ID token signature, issuer, audience, times and nonce are checked, and nothing else of its answer is used.
"""

import asyncio
import hmac
import re
import secrets
import ssl
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from fleetmap.errors import LinkError, UsageError
from mapserver.fleet.rate_limit import RateLimit
from mapserver.operators.binding import is_loopback_name
from mapserver.operators.roles import PROVIDER_PREFIX, Role

if TYPE_CHECKING:
    from authlib.integrations.starlette_client import StarletteOAuth2App

WAIT_S = 600  # for a person who signs in at the provider
_MOST_WAITING = 1000
_BURST, _PER_S = 20, 1.0  # sign-ins that begin from one address
_TIMEOUT_S, _ASK_AGAIN_S = 10, 5
_LEEWAY_S = 60
# With the others the client's secret would sign, or nobody.
_ALGORITHMS = {"RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA", "Ed25519"}
_ENDPOINTS = ("authorization_endpoint", "token_endpoint", "jwks_uri")
_NAME = re.compile(r"[A-Za-z0-9._@+|:/=~-]{1,128}")
_CODE = re.compile(r"[a-z_]{1,40}")


class ProviderError(LinkError):
    """Why nobody is signed in, in words for the person. status: of the answer; name: who it was, where that was proved."""

    def __init__(self, status: int, words: str, name: str = "") -> None:
        self.status, self.name = status, name
        super().__init__(words)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProviderSettings:
    """A provider and what it decides. roles: by group; name_claim: what people are called by in the log, after `oidc:`.

    UsageError for an issuer that is read over a network without TLS.
    """

    issuer: str
    client_id: str
    client_secret: str = field(repr=False)
    roles: Mapping[str, Role]
    groups_claim: str = "groups"
    name_claim: str = "sub"
    scope: str = "openid profile email"

    def __post_init__(self) -> None:
        if not _is_safe(self.issuer) or urlsplit(self.issuer).query or urlsplit(self.issuer).fragment:
            raise UsageError(
                f"--oidc-issuer {self.issuer[:200]!r}: give the https address that the provider names itself by"
            )


@dataclass(frozen=True, slots=True)
class Person:
    """Whom the provider vouches for. subject: its own word for the person, and whose it is, for the log."""

    name: str
    role: Role
    subject: str


@dataclass(frozen=True, slots=True)
class _Waiting:
    state: str
    nonce: str
    verifier: str
    redirect_uri: str
    then: str
    begun_s: float


class Provider:
    """The provider of a server. For one event loop."""

    def __init__(self, settings: ProviderSettings, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._settings, self._clock_s = settings, clock_s
        self._waiting: dict[str, _Waiting] = {}  # by the cookie's secret, oldest first
        self._begins = RateLimit(_BURST, _PER_S, lambda: int(clock_s() * 1e9))
        self._looking = asyncio.Lock()
        self._metadata: dict[str, Any] | None = None
        self._fault, self._failed_s = "", -1e9
        import_authlib()
        # Once, with the system's authorities: authlib makes a client for each question, which would read them anew.
        self._http = {"timeout": _TIMEOUT_S, "verify": ssl.create_default_context()}

    @property
    def host(self) -> str:
        """Where people are sent to."""
        return urlsplit(self._settings.issuer).netloc

    async def begin(self, redirect_uri: str, then: str, address: str) -> tuple[str, str]:
        """The provider's address for one sign-in, and the secret of the browser's cookie; ProviderError where it cannot begin.

        redirect_uri: where it sends people back to; then: where they wanted to go.
        """
        if not self._begins.admits(address):
            raise ProviderError(429, "Too many tries. Wait before the next one.")
        made = await self._app(await self._discover()).create_authorization_url(redirect_uri)
        now_s = self._clock_s()
        for secret in [kept for kept, one in self._waiting.items() if now_s - one.begun_s > WAIT_S]:
            del self._waiting[secret]
        while len(self._waiting) >= _MOST_WAITING:
            del self._waiting[next(iter(self._waiting))]
        secret = secrets.token_urlsafe(32)
        self._waiting[secret] = _Waiting(made["state"], made["nonce"], made["code_verifier"], redirect_uri, then, now_s)
        return made["url"], secret

    async def finish(self, secret: str, query: Mapping[str, str]) -> tuple[Person, str]:
        """Who came back with this cookie and query, and where they wanted to go; ProviderError for anybody else."""
        one = self._waiting.get(secret)
        if one is None or not hmac.compare_digest(one.state.encode(), query.get("state", "").encode()):
            raise ProviderError(400, "This sign-in was not begun in this browser, or took too long. Begin again.")
        del self._waiting[secret]
        if self._clock_s() - one.begun_s > WAIT_S:
            raise ProviderError(400, "This sign-in took too long. Begin again.")
        if "error" in query:
            code = query["error"] if _CODE.fullmatch(query["error"]) else "an error"
            raise ProviderError(403, f"{self.host} let nobody in: {code}.")
        if query.get("iss", self._settings.issuer) != self._settings.issuer:
            raise ProviderError(400, "The way back names another provider. Begin again.")
        return self._person(await self._claims(one, query.get("code", ""))), one.then

    async def _claims(self, one: _Waiting, code: str) -> Mapping[str, Any]:
        """What the ID token says that the provider gives for a code."""
        app = self._app(await self._discover())
        expected = {
            "iss": {"essential": True, "value": self._settings.issuer},
            "aud": {"essential": True, "value": self._settings.client_id},
        }
        try:
            token = await app.fetch_access_token(redirect_uri=one.redirect_uri, code=code, code_verifier=one.verifier)
            found = await app.parse_id_token(token, one.nonce, claims_options=expected, leeway=_LEEWAY_S)
        except Exception as error:  # whatever an answer of elsewhere may cause in the libraries that read it
            raise ProviderError(502, f"The answer of {self.host} is refused: {_short(error)}.") from error
        if found is None:
            raise ProviderError(502, f"The answer of {self.host} is refused: it has no ID token.")
        claims: Mapping[str, Any] = found
        return claims

    def _person(self, claims: Mapping[str, Any]) -> Person:
        given, value = self._settings, claims.get(self._settings.name_claim)
        if not isinstance(value, str) or not _NAME.fullmatch(value):
            raise ProviderError(
                403,
                f"{self.host} gave no name that can stand in the log as {given.name_claim!r}; an administrator sets another claim.",
            )
        name = PROVIDER_PREFIX + value
        if given.name_claim == "email" and claims.get("email_verified") is not True:
            raise ProviderError(403, f"{self.host} has not verified your address.", name)
        groups = claims.get(given.groups_claim)
        groups = [groups] if isinstance(groups, str) else groups if isinstance(groups, list) else []
        roles = {given.roles[group] for group in groups if isinstance(group, str) and group in given.roles}
        if not roles:
            raise ProviderError(
                403,
                f"None of your groups at {self.host} has a role here; an administrator can give it one.",
                name,
            )
        return Person(name, max(roles, key=list(Role).index), f"{ascii(claims['sub'])[:200]} of {given.issuer}")

    async def _discover(self) -> dict[str, Any]:
        """The provider's addresses, asked once; ProviderError where there is no proper answer."""
        async with self._looking:
            if self._metadata is None:
                if self._clock_s() - self._failed_s < _ASK_AGAIN_S:
                    raise ProviderError(502, self._fault)
                try:
                    self._metadata = await self._asked()
                except Exception as error:  # as above
                    self._failed_s = self._clock_s()
                    self._fault = (
                        f"{self.host} gives no proper answer now: {_short(error)}. Try again, or sign in by a password."
                    )
                    raise ProviderError(502, self._fault) from error
            return self._metadata

    async def _asked(self) -> dict[str, Any]:
        from authlib.integrations.httpx_client import AsyncOAuth2Client

        issuer = self._settings.issuer
        async with AsyncOAuth2Client(**self._http) as client:
            answer = await client.request(
                "GET", f"{issuer.rstrip('/')}/.well-known/openid-configuration", withhold_token=True
            )
        answer.raise_for_status()
        found = answer.json()
        if found["issuer"] != issuer:
            raise ValueError("it names itself otherwise than --oidc-issuer")
        for name in _ENDPOINTS:
            if not _is_safe(found[name]):
                raise ValueError(f"its {name} is no https address")
        algorithms = sorted(_ALGORITHMS.intersection(found.get("id_token_signing_alg_values_supported", ())))
        methods = found.get("token_endpoint_auth_methods_supported", ["client_secret_basic"])
        method = "client_secret_basic" if "client_secret_basic" in methods else "client_secret_post"
        kept = {name: found[name] for name in _ENDPOINTS}
        return kept | {
            "id_token_signing_alg_values_supported": algorithms or ["RS256"],
            "token_endpoint_auth_method": method,
        }

    def _app(self, metadata: Mapping[str, Any]) -> "StarletteOAuth2App":
        """A client for one sign-in: authlib's would keep the provider's keys for ever."""
        from authlib.integrations.starlette_client import StarletteOAuth2App

        return StarletteOAuth2App(
            None,
            "provider",
            client_id=self._settings.client_id,
            client_secret=self._settings.client_secret,
            client_kwargs={"scope": self._settings.scope, "code_challenge_method": "S256", **self._http},
            **metadata,
        )


def import_authlib() -> None:
    """UsageError where the extra is not installed."""
    try:
        from authlib.deprecate import AuthlibDeprecationWarning

        with warnings.catch_warnings():
            # It asks for httpx2 in the place of httpx, and takes either.
            warnings.simplefilter("ignore", AuthlibDeprecationWarning)
            import authlib.integrations.starlette_client  # noqa: F401
    except ModuleNotFoundError as error:
        raise UsageError(
            f"--oidc-issuer needs {error.name}, which is not installed; pip install '.[server,oidc]' in fleetmap's source folder"
        ) from error


def _is_safe(address: str) -> bool:
    """Whether nobody on the way can answer in its place."""
    try:
        parts = urlsplit(address)
        host = parts.hostname or ""
        return bool(host) and (parts.scheme == "https" or (parts.scheme == "http" and is_loopback_name(host)))
    except (ValueError, AttributeError, TypeError):
        return False


def _short(error: Exception) -> str:
    """A fault of a library in one line: what claims say stands in some, and may be long."""
    return f"{type(error).__name__} {ascii(str(error))[1:-1][:120]}".rstrip(" .")
