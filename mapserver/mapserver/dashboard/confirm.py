"""Changing something: what will happen is said first, then who and why is asked, then it is done."""

from collections.abc import Callable

from markupsafe import Markup
from nicegui import ui
from starlette.exceptions import HTTPException

from fleetmap.errors import FleetmapError
from mapserver.dashboard.layout import Rooms, html, load, notice
from mapserver.store import Actor

_MAX_NAME, _MAX_REASON = 200, 2000


def change_button(rooms: Rooms, words: str, explanation: str, act: Callable[[Actor], str]) -> None:
    """A button that asks before it acts; the page is loaded anew afterwards.

    act: what is done in the name of somebody; a FleetmapError of it is shown and changes nothing.
    """
    with ui.dialog() as dialog, ui.column().classes("ask-box"):
        html(Markup("<h2>{}</h2><p>{}</p>").format(f"{words}?", explanation))
        name = (
            ui.input("Your name")
            .props(f"outlined maxlength={_MAX_NAME} autofocus")
            .classes("w-full")
            .style("width:100%")
        )
        reason = ui.input("Why (stands in the history)").props(f"outlined maxlength={_MAX_REASON}").style("width:100%")
        token = None
        if rooms.writers.token is not None:
            token = ui.input("The server's token", password=True).props("outlined").style("width:100%")
        said = html("")
        with ui.row().classes("actions"):

            async def confirmed() -> None:
                refusal = await _try(rooms, act, name.value, reason.value, None if token is None else token.value)
                if refusal is None:
                    ui.navigate.reload()
                else:
                    said.set_content(str(notice("bad", refusal)))

            ui.button(f"Yes: {words}", on_click=confirmed, color=None).props("no-caps flat").classes("plain").mark(
                "confirm"
            )
            ui.button("No, change nothing", on_click=dialog.close, color=None).props("no-caps flat").classes("plain")
    ui.button(words, on_click=dialog.open, color=None).props("no-caps flat").classes("plain")


async def _try(
    rooms: Rooms, act: Callable[[Actor], str], name: str | None, reason: str | None, token: str | None
) -> str | None:
    """Why it was not done, None if it was."""
    who = Actor((name or "").strip()[:_MAX_NAME], (reason or "").strip()[:_MAX_REASON])
    if not who.name:
        return "Please give your name: it stands in the history."
    try:
        rooms.writers.check_shown(ui.context.client.request, f"Bearer {token or ''}")
        await load(act, who)
    except HTTPException as error:
        return str(error.detail)
    except FleetmapError as error:
        return str(error)
    return None
