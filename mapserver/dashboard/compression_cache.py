"""Compressed responses of the server; the page library's files are compressed once for all browsers.

A page requests some sixteen of them, half a megabyte. Reading and compressing them for each browser takes longer than the rest of the page.
"""

from dataclasses import dataclass, field

from starlette.middleware.gzip import GZipMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_FILES, _DYNAMIC = "/_nicegui/", "/dynamic_resources/"
_PARTIAL = {b"range", b"if-none-match", b"if-modified-since"}
_LEVEL = 5  # pages that change every second are not worth the last percent
_MAX_BYTES = 16_000_000


@dataclass
class _Response:
    start: Message | None = None
    body: list[bytes] = field(default_factory=list)
    is_complete: bool = False

    def record(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.start = message
        elif message["type"] == "http.response.body":
            self.body.append(message.get("body", b""))
            self.is_complete = not message.get("more_body", False)


class CompressionCache(GZipMiddleware):
    """GZipMiddleware that keeps the responses for the page library's files in memory."""

    def __init__(self, app: ASGIApp) -> None:
        super().__init__(app, compresslevel=_LEVEL)
        self._cache: dict[tuple[str, bytes, bool], tuple[Message, bytes]] = {}
        self._bytes = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One response."""
        key = _key(scope)
        if key is None:
            await super().__call__(scope, receive, send)
            return
        if key not in self._cache:
            response = _Response()

            async def recording_send(message: Message) -> None:
                response.record(message)
                await send(message)

            await super().__call__(scope, receive, recording_send)
            self._store(key, response)
            return
        start, body = self._cache[key]
        await send(start)
        await send({"type": "http.response.body", "body": body, "more_body": False})

    def _store(self, key: tuple[str, bytes, bool], response: _Response) -> None:
        body = b"".join(response.body)
        if response.start is None or not response.is_complete or response.start["status"] != 200:
            return
        if self._bytes + len(body) <= _MAX_BYTES:
            self._cache[key] = (response.start, body)
            self._bytes += len(body)


def _key(scope: Scope) -> tuple[str, bytes, bool] | None:
    """The request's properties that the response depends on; None if it is not cached."""
    if scope["type"] != "http" or scope["method"] != "GET" or _FILES not in scope["path"] or _DYNAMIC in scope["path"]:
        return None
    headers = dict(scope["headers"])
    if _PARTIAL & headers.keys():
        return None
    return scope["path"], scope["query_string"], b"gzip" in headers.get(b"accept-encoding", b"")
