"""Changes to the store: a button, a dialog that explains the change and asks for reason and, without sign-in, name; then the change."""

from collections.abc import Callable

from markupsafe import Markup
from nicegui import ui
from starlette.exceptions import HTTPException

from fleetmap.errors import FleetmapError
from mapserver.dashboard.layout import Services, html, load, notice
from mapserver.operators.roles import Identity, Scope
from mapserver.store import Actor

_MAX_NAME, _MAX_REASON = 200, 2000


def may_change() -> bool:
    """Whether whoever opened the page may change anything; without sign-in everybody."""
    who = _identity()
    return who is None or Scope.CHANGE in who.scopes


def _identity() -> Identity | None:
    who: Identity | None = getattr(ui.context.client.request.state, "operator", None)
    return who


def change_button(
    services: Services, words: str, explanation: str | Callable[[], str], act: Callable[[Actor], str], *, css: str = ""
) -> None:
    """A button that asks before it acts; the page is reloaded afterwards. css: `forward` or `back`, so that acts cannot be confused.

    explanation: words, or what makes them when the button is pressed.
    act: the change, in the name of an actor; its FleetmapError is shown and changes nothing. Who may only look gets no button.
    """
    if not may_change():
        return
    who = _identity()
    with ui.dialog() as dialog, ui.column().classes("ask-box"):
        asked = html("")
        name = None
        if who is None:
            name = ui.input("Your name").props(f"outlined maxlength={_MAX_NAME} autofocus").style("width:100%")
        reason = ui.input("Reason (kept in the history)").props(f"outlined maxlength={_MAX_REASON}").style("width:100%")
        message = html("")
        with ui.row().classes("actions"):

            async def confirmed() -> None:
                refusal = await _try(services, act, None if name is None else name.value, reason.value)
                if refusal is None:
                    ui.navigate.reload()
                else:
                    message.set_content(str(notice("bad", refusal)))

            ui.button(f"Yes: {words}", on_click=confirmed, color=None).props("no-caps flat").classes("plain").mark(
                "confirm"
            )
            ui.button("No, change nothing", on_click=dialog.close, color=None).props("no-caps flat").classes("plain")

    def ask() -> None:
        told = explanation if isinstance(explanation, str) else explanation()
        asked.set_content(str(Markup("<h2>{}</h2><p>{}</p>").format(f"{words}?", told)))
        dialog.open()

    ui.button(words, on_click=ask, color=None).props("no-caps flat").classes(f"plain {css}")


async def _try(services: Services, act: Callable[[Actor], str], name: str | None, reason: str | None) -> str | None:
    """The reason for a refusal, None after the change. Who acts is asked anew: the page may have been open since yesterday."""
    typed = (name or "").strip()[:_MAX_NAME]
    if name is not None and not typed:
        return "Please enter your name; it is kept in the history."
    request, words = ui.context.client.request, (reason or "").strip()[:_MAX_REASON]
    try:
        who = await load(lambda: services.guard.acting(request, typed, words))
        await load(act, who)
    except HTTPException as error:
        return str(error.detail)
    except FleetmapError as error:
        return str(error)
    return None
