"""Sign-in and sign-out: a page without scripts, outside of the page library, so that nobody needs to be known for it."""

from pathlib import Path
from urllib.parse import parse_qs

from anyio import to_thread
from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, RedirectResponse
from markupsafe import Markup
from starlette.responses import Response

from mapserver.api.guard import (
    SIGN_IN,
    SIGN_OUT,
    GuardSettings,
    address_of,
    set_session,
)

_MAX_ADDRESS = 300  # percent-encoded it must fit into the sign-in's body, beside name and password
_STYLE = Path(__file__).parents[1] / "style.css"
_PAGE = Markup(
    '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>Sign in – fleetmap</title><link rel="icon" href="data:,">'
    '<meta name="viewport" content="width=device-width"><style>{style}</style></head>'
    '<body class="print"><main class="nicegui-content sign-in"><h1>fleetmap</h1>{notice}'
    '<form method="post" action="{action}"><input type="hidden" name="next" value="{then}">'
    '<label>Name<input name="name" value="{name}" required maxlength="64" autocapitalize="none" autocomplete="username" {focus}></label>'
    '<label>Password<input name="password" type="password" required maxlength="1000" autocomplete="current-password"></label>'
    '<button type="submit">Sign in</button></form>'
    '<p class="quiet">No account yet? An administrator makes one on the server with <code>mapserver operators add</code>.</p>'
    "</main></body></html>\n"
)


def install(app: FastAPI, settings: GuardSettings) -> None:
    """Adds the page and its two actions."""

    @app.get(SIGN_IN, include_in_schema=False)
    def sign_in_page(request: Request, next: str = "/") -> Response:
        """The form; whoever needs none goes on."""
        if not settings.is_sign_in_on or settings.identify(request.scope) is not None:
            return RedirectResponse(_local(next), 303)
        return _page(settings, next)

    @app.post(SIGN_IN, include_in_schema=False)
    async def sign_in(request: Request) -> Response:
        """Begins a session."""
        given = {
            name: values[0] for name, values in parse_qs((await request.body()).decode("utf-8", "replace")).items()
        }
        then, name, operators = given.get("next", "/"), given.get("name", "").strip().lower(), settings.operators
        if operators is None:
            return RedirectResponse(_local(then), 303)
        found = await to_thread.run_sync(operators.sign_in, name, given.get("password", ""), address_of(request.scope))
        if not found.session:
            page = _page(settings, then, name, found.refusal, 429 if found.retry_s else 401)
            if found.retry_s:
                page.headers["Retry-After"] = str(found.retry_s)
            return page
        response = RedirectResponse(_local(then), 303)
        set_session(response, request.scope, found.session)
        return response

    @app.post(SIGN_OUT, include_in_schema=False)
    def sign_out(request: Request) -> Response:
        """Ends the session."""
        who = settings.identify(request.scope)
        if who is not None and settings.operators is not None:
            settings.operators.sign_out(who)
        response = RedirectResponse(SIGN_IN, 303)
        set_session(response, request.scope, "")
        return response


def _page(settings: GuardSettings, then: str, name: str = "", refusal: str = "", status: int = 200) -> HTMLResponse:
    notice = Markup('<p class="notice bad" role="alert">{}</p>').format(refusal) if refusal else ""
    style, focus = Markup(_STYLE.read_text("utf-8")), "" if name else "autofocus"
    page = _PAGE.format(style=style, notice=notice, action=SIGN_IN, then=_local(then), name=name, focus=focus)
    return HTMLResponse(page, status, {"Cache-Control": "no-store"})


def _local(address: str) -> str:
    """The address where it is one of this server, else the first page: a link from elsewhere must not lead on to elsewhere."""
    is_local = address.startswith("/") and not address.startswith(("//", "/\\")) and address.isprintable()
    is_local = is_local and len(address) <= _MAX_ADDRESS
    return address if is_local and not address.startswith((SIGN_IN, SIGN_OUT)) else "/"
