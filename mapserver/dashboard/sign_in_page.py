"""Sign-in and sign-out: a page without scripts, for those whom nobody knows yet."""

from urllib.parse import parse_qs

from anyio import to_thread
from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, RedirectResponse
from starlette.responses import Response

from mapserver.api.guard import SIGN_IN, SIGN_OUT, STYLE, GuardSettings, address_of, set_session
from mapserver.dashboard.rendering import TEMPLATES

_MAX_ADDRESS = 300  # percent-encoded it must fit into the sign-in's body, beside name and password


def install(app: FastAPI, settings: GuardSettings) -> None:
    """Adds the page and its two actions."""

    @app.get(SIGN_IN, include_in_schema=False)
    def sign_in_page(request: Request, next: str = "/") -> Response:
        """The form; whoever needs none goes on."""
        if not settings.is_sign_in_on or settings.identify(request.scope) is not None:
            return RedirectResponse(_local(next), 303)
        return _page(next)

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
            page = _page(then, name, found.refusal, 429 if found.retry_s else 401)
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


def _page(then: str, name: str = "", refusal: str = "", status: int = 200) -> HTMLResponse:
    shown = {"style": STYLE, "action": SIGN_IN, "then": _local(then), "name": name, "refusal": refusal}
    page = TEMPLATES.get_template("sign_in.html").render(shown)
    return HTMLResponse(page, status, {"Cache-Control": "no-store"})


def _local(address: str) -> str:
    """The address where it is one of this server, else the first page: a link from elsewhere must not lead on to elsewhere."""
    is_local = address.startswith("/") and not address.startswith(("//", "/\\")) and address.isprintable()
    is_local = is_local and len(address) <= _MAX_ADDRESS
    return address if is_local and not address.startswith((SIGN_IN, SIGN_OUT)) else "/"
