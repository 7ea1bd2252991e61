"""Compressed answers of the server; those that never change while it runs are compressed once for all browsers.

A page asks for some sixteen files of the page library, half a megabyte. Found, read and compressed anew for each browser they take
longer than everything that the page itself says.
"""

from dataclasses import dataclass, field

from starlette.middleware.gzip import GZipMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_FILES, _MADE_ANEW = "/_nicegui/", "/dynamic_resources/"
_ASKED_IN_PART = {b"range", b"if-none-match", b"if-modified-since"}
_LEVEL = 5  # pages that change every second are not worth the last percent
_MOST_BYTES = 16_000_000


@dataclass
class _Answer:
    start: Message | None = None
    body: list[bytes] = field(default_factory=list)
    is_whole: bool = False

    def note(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.start = message
        elif message["type"] == "http.response.body":
            self.body.append(message.get("body", b""))
            self.is_whole = not message.get("more_body", False)


class CompressionCache(GZipMiddleware):
    """GZipMiddleware that keeps the answers for the page library's files in memory."""

    def __init__(self, app: ASGIApp) -> None:
        super().__init__(app, compresslevel=_LEVEL)
        self._kept: dict[tuple[str, bytes, bool], tuple[Message, bytes]] = {}
        self._bytes = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One answer."""
        key = _key(scope)
        if key is None:
            await super().__call__(scope, receive, send)
            return
        if key not in self._kept:
            answer = _Answer()

            async def noting(message: Message) -> None:
                answer.note(message)
                await send(message)

            await super().__call__(scope, receive, noting)
            self._keep(key, answer)
            return
        start, body = self._kept[key]
        await send(start)
        await send({"type": "http.response.body", "body": body, "more_body": False})

    def _keep(self, key: tuple[str, bytes, bool], answer: _Answer) -> None:
        body = b"".join(answer.body)
        if answer.start is None or not answer.is_whole or answer.start["status"] != 200:
            return
        if self._bytes + len(body) <= _MOST_BYTES:
            self._kept[key] = (answer.start, body)
            self._bytes += len(body)


def _key(scope: Scope) -> tuple[str, bytes, bool] | None:
    """What an answer depends on; None where it is not kept."""
    if (
        scope["type"] != "http"
        or scope["method"] != "GET"
        or _FILES not in scope["path"]
        or _MADE_ANEW in scope["path"]
    ):
        return None
    headers = dict(scope["headers"])
    if _ASKED_IN_PART & headers.keys():
        return None
    return scope["path"], scope["query_string"], b"gzip" in headers.get(b"accept-encoding", b"")
