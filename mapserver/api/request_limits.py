"""Limits on requests, checked first: before the body is stored or a token is read."""

import asyncio
import re
from contextlib import suppress

from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mapserver.api.guard import SIGN_IN
from mapserver.api.problems import problem
from mapserver.floor_plan.areas import MAX_AREAS_BYTES
from mapserver.floor_plan.plan_file import MAX_PLAN_BYTES
from mapserver.nightly.upload import MOST_BYTES as UPLOAD_BYTES
from mapserver.serving.http_connections import MAX_HEAD_BYTES

MAX_BODY_BYTES = 1 << 20  # an action has about 100 bytes
_FILE_BYTES = {"areas": MAX_AREAS_BYTES, "alignment": MAX_PLAN_BYTES, "inbox": UPLOAD_BYTES}
_FILE = re.compile(r"/v1/sites/[^/]+/(areas|alignment|inbox)(/[^/]+)?")
SIGN_IN_BYTES = 4 << 10  # accepted without authentication
BODY_S, SIGN_IN_S = 30.0, 10.0  # until the body is complete
LINGER_BYTES, LINGER_S = 16 << 20, 2.0  # of a refused body that are read, and discarded, after the answer
UPLOAD_BYTES_IN_BODY_S = 300_000  # least of an upload: 64 GB by the slowest radio would hold its place for months


class RequestLimits:
    """Answer 431 to large headers, 413 to a large body (declared or not), 408 to a slow one, and close the connection.

    Clients receive such an answer, and any other one that closes the connection, although they still send: see `_Limited`.
    A client that disconnects before the body is complete is not logged.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return await self._app(scope, receive, send)
        if "://" in scope["path"][:8]:  # the absolute form of a URL, which h11 does not change
            scope["path"] = "/" + "".join(scope["path"].split("/", 3)[3:])
            scope["raw_path"] = b"/" + b"".join(scope["raw_path"].split(b"/", 3)[3:])
        request = _Limited(scope, receive, send)
        head_bytes = len(scope["raw_path"]) + len(scope["query_string"])
        head_bytes += sum(len(name) + len(value) + 4 for name, value in scope["headers"])
        stated = dict(scope["headers"]).get(b"content-length", b"0")
        if head_bytes > MAX_HEAD_BYTES:
            words = f"the request's head has {head_bytes} bytes; the limit is {MAX_HEAD_BYTES}"
            return await request.refuse(431, words)
        if not stated.isdigit() or len(stated) > 15 or int(stated) > request.most_bytes:
            return await request.refuse(*request.too_large)
        with suppress(ClientDisconnect):
            await self._app(scope, request.receive, request.send)
        return None


def _limits(scope: Scope) -> tuple[int, float, bool]:
    """Return the most bytes of the body and the seconds for it; True for the upload of a recording, which has them again and again."""
    if scope["path"] == SIGN_IN:
        return SIGN_IN_BYTES, SIGN_IN_S, False
    file = _FILE.fullmatch(scope["path"]) if scope["method"] == "PUT" else None
    if file is None:
        return MAX_BODY_BYTES, BODY_S, False
    return _FILE_BYTES[file[1]], BODY_S, file[1] == "inbox"


class _Limited:
    """A request's `receive` and `send`. Before an answer closes the connection, the rest of the body is read, within limits.

    The kernel resets a connection that is closed with unread bytes, and a client whose connection is reset loses the answer.
    """

    def __init__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self._scope, self._receive, self._send = scope, receive, send
        self.most_bytes, self._within_s, self._is_upload = _limits(scope)
        self.too_large = 413, f"the body has more than {self.most_bytes} bytes"
        self._loop = asyncio.get_running_loop()
        self._until_s = self._loop.time() + self._within_s
        self._taken, self._due = 0, UPLOAD_BYTES_IN_BODY_S  # bytes, and those by then
        self._is_whole = self._is_refused = self._is_answered = self._closes = False

    async def receive(self) -> Message:
        if self._is_refused:
            return {"type": "http.disconnect"}
        refusal = self.too_large
        try:
            # After the body this waits until the connection closes.
            async with asyncio.timeout_at(None if self._is_whole or self._is_answered else self._until_s):
                message = await self._read()
        except TimeoutError:
            refusal = 408, f"the body was not complete within {self._within_s:g} s"
            if self._is_upload:
                brought = f"{self._taken - self._due + UPLOAD_BYTES_IN_BODY_S} bytes of the upload"
                words = f"{self._within_s:g} s brought {brought}, less than {UPLOAD_BYTES_IN_BODY_S}"
                refusal = 408, f"{words}; use a faster connection"
        else:
            self._taken += len(message.get("body", b""))
            if self._is_upload and self._taken >= self._due:
                self._until_s = self._loop.time() + self._within_s
                self._due = self._taken + UPLOAD_BYTES_IN_BODY_S
            if self._taken <= self.most_bytes:
                return message
        if not self._is_answered:
            self._is_refused = True
            await self.refuse(*refusal)
        return {"type": "http.disconnect"}

    async def send(self, message: Message) -> None:
        if not self._is_refused:
            self._is_answered = True
            await self._answer(message)

    async def refuse(self, status: int, words: str) -> None:
        response = problem(status, words, self._scope["path"], {"Connection": "close"})
        await response(self._scope, self._read, self._answer)

    async def _read(self) -> Message:
        message = await self._receive()
        self._is_whole = self._is_whole or not message.get("more_body", False)
        return message

    async def _answer(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self._closes = (b"connection", b"close") in message.get("headers", ())
        elif self._closes and not self._is_whole and not message.get("more_body", False):
            await self._send({**message, "more_body": True})
            message, left = {"type": "http.response.body"}, LINGER_BYTES
            with suppress(TimeoutError):
                async with asyncio.timeout(LINGER_S):
                    while left > 0 and not self._is_whole:
                        left -= len((await self._read()).get("body", b""))
        await self._send(message)
