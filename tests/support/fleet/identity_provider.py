"""A small OpenID Connect provider on loopback, which asks for everything that a real one does and lies on demand."""

import base64
import hashlib
import json
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

from joserfc import jwt
from joserfc.jwk import ECKey

CLIENT, SECRET = "fleetmap", "the client's secret: 50 % + more"


@dataclass
class IdentityProvider:
    """What it says next. person: claims of whoever signs in; spoiled: claims that it puts over the right ones (None takes one away);
    documents: answers in the place of its own, by path; asks: whether it shows a page first."""

    issuer: str
    person: dict[str, Any] = field(default_factory=lambda: {"sub": "42", "groups": ["map-people"]})
    spoiled: dict[str, Any] = field(default_factory=dict)
    documents: dict[str, object] = field(default_factory=dict)
    sign: Any = None
    asks: bool = False
    key: ECKey = field(default_factory=lambda: ECKey.generate_key("P-256", {"kid": "k1"}))
    codes: dict[str, dict[str, str]] = field(default_factory=dict)
    redeemed: int = 0

    def configuration(self) -> dict[str, object]:
        return {
            "issuer": self.issuer,
            "authorization_endpoint": f"{self.issuer}/authorize",
            "token_endpoint": f"{self.issuer}/token",
            "jwks_uri": f"{self.issuer}/keys",
            "id_token_signing_alg_values_supported": ["ES256", "HS256", "none"],
        }

    def way_back(self, asked: dict[str, str]) -> str:
        """Where the browser goes after somebody has signed in here."""
        assert asked["response_type"] == "code"
        assert asked["code_challenge_method"] == "S256"
        assert (asked["client_id"], "openid" in asked["scope"].split()) == (CLIENT, True)
        code = secrets.token_urlsafe()
        self.codes[code] = asked
        return f"{asked['redirect_uri']}?{urlencode({'code': code, 'state': asked['state']})}"

    def token(self, given: dict[str, str], authorization: str) -> tuple[int, object]:
        expected = base64.b64encode(f"{CLIENT}:{SECRET}".encode()).decode()
        if authorization != f"Basic {expected}":
            return 401, {"error": "invalid_client"}
        asked = self.codes.pop(given["code"], None)
        challenge = base64.urlsafe_b64encode(hashlib.sha256(given["code_verifier"].encode()).digest()).decode()
        if asked is None or asked["code_challenge"] != challenge.rstrip("="):
            return 400, {"error": "invalid_grant"}
        assert given["redirect_uri"] == asked["redirect_uri"]
        self.redeemed += 1
        now_s = int(time.time())
        claims = {"iss": self.issuer, "aud": CLIENT, "nonce": asked["nonce"], "iat": now_s, "exp": now_s + 60}
        claims = {name: value for name, value in (claims | self.person | self.spoiled).items() if value is not None}
        token = (self.sign or self.signed)(claims)
        return 200, {"access_token": "x", "token_type": "Bearer"} | ({"id_token": token} if token else {})

    def signed(self, claims: dict[str, Any]) -> str:
        return jwt.encode({"alg": "ES256", "kid": "k1"}, claims, self.key)

    def answer(self, path: str) -> tuple[int, object]:
        if path in self.documents:
            return 200, self.documents[path]
        if path == "/keys":
            return 200, {"keys": [self.key.as_dict(private=False)]}
        return (200, self.configuration()) if path == "/.well-known/openid-configuration" else (404, {})


@contextmanager
def identity_provider(port: int = 0) -> Iterator[IdentityProvider]:
    """A provider that runs until the end."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            parts = urlsplit(self.path)
            if parts.path != "/authorize":
                return self.give(*provider.answer(parts.path))
            back = provider.way_back({name: values[0] for name, values in parse_qs(parts.query).items()})
            if provider.asks:
                page = (
                    f'<!DOCTYPE html><title>provider</title><a id="go" href="{back.replace("&", "&amp;")}">It is me</a>'
                )
                return self.give(200, page)
            self.send_response(302)
            self.send_header("Location", back)
            self.end_headers()
            return None

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"])).decode()
            given = {name: values[0] for name, values in parse_qs(body).items()}
            self.give(*provider.token(given, self.headers.get("Authorization", "")))

        def give(self, status: int, content: object) -> None:
            data = content.encode() if isinstance(content, str) else json.dumps(content).encode()
            self.send_response(status)
            self.send_header("Content-Type", "text/html" if isinstance(content, str) else "application/json")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, format: str, *args: object) -> None:
            """Says nothing."""

    with ThreadingHTTPServer(("127.0.0.1", port), Handler) as server:
        provider = IdentityProvider(f"http://127.0.0.1:{server.server_port}")
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield provider
        finally:
            server.shutdown()
            thread.join()
