"""A limit on the bodies of requests, outside of everything else: it holds before anything of a body is kept or any token is looked at."""

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mapserver.api.problems import problem

MAX_BODY_BYTES = 1 << 20  # an act has some hundred bytes; the pages' socket falls back to posts of less than this


class BodyLimit:
    """Answers 413 where a body states that it is larger than the limit, or turns out to be, and closes the connection."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] != "http":
            return await self._app(scope, receive, send)
        stated = dict(scope["headers"]).get(b"content-length", b"0")
        if not stated.isdigit() or len(stated) > 15 or int(stated) > MAX_BODY_BYTES:
            return await _refuse(scope, receive, send)
        taken, is_refused, is_answered = 0, False, False

        async def limited() -> Message:
            nonlocal taken, is_refused
            if is_refused:
                return {"type": "http.disconnect"}
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > MAX_BODY_BYTES and not is_answered:
                is_refused = True
                await _refuse(scope, receive, send)
                return {"type": "http.disconnect"}
            return message

        async def answered(message: Message) -> None:
            nonlocal is_answered
            if not is_refused:
                is_answered = True
                await send(message)

        await self._app(scope, limited, answered)
        return None


async def _refuse(scope: Scope, receive: Receive, send: Send) -> None:
    words = f"the body has more than {MAX_BODY_BYTES} bytes"
    await problem(413, words, scope["path"], {"Connection": "close"})(scope, receive, send)
