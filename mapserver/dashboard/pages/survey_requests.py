"""Part of the map page: draw where a survey is wanted, and say that one was made."""

from markupsafe import Markup
from nicegui import ui

from mapserver.dashboard.layout import PageContext, Services, html
from mapserver.dashboard.map_layers import Item, Layer, Line, Mark, Outline
from mapserver.dashboard.pages.confirm import change_button, may_change
from mapserver.dashboard.site_map import SiteMap
from mapserver.floor_plan.survey_requests import SurveyRequest
from mapserver.store import Actor

DRAWN = "Survey that you draw"
Corners = list[tuple[float, float]]


def layers(requests: list[SurveyRequest]) -> list[Layer]:
    """What people asked for, and what is drawn now."""
    asked = [Outline([[(x, y) for x, y in request.corners_map_m]], f"survey {request.id}") for request in requests]
    return [Layer("Surveys asked for", asked), Layer(DRAWN)]


def request_form(services: Services, context: PageContext, requests: list[SurveyRequest], drawn: SiteMap) -> None:
    """Open requests, each with the act that ends it, and the act that makes one of what is drawn on the map."""
    html(Markup("<h2>Surveys asked for</h2>"))
    if not requests:
        html(
            Markup(
                '<p class="quiet">None. Draw one on the map above to put its tiles on the list of the next survey; it ends by itself '
                "when a version with a survey of it is published.</p>"
            )
        )
    for request in requests:
        _one(services, context, request)
    if not may_change():
        return
    corners: Corners = []
    with ui.row().classes("actions"):
        switch = ui.switch("Draw on the map: each click is a corner").props("color=primary")
        undo = ui.button("Take back the last corner", color=None).props("no-caps flat").classes("plain")
        change_button(
            services,
            "Ask for a survey of it",
            lambda: _words(corners, context),
            lambda actor: _asked(services, context, corners, actor),
            css="forward",
        )

    def show() -> None:
        drawn.show(DRAWN, _items(corners))

    def pick(x_m: float, y_m: float) -> None:
        if switch.value:
            corners.append((x_m, y_m))
            show()

    def take_back() -> None:
        del corners[-1:]
        show()

    drawn.on_pick(pick)
    undo.on_click(take_back)


def _one(services: Services, context: PageContext, request: SurveyRequest) -> None:
    words = f"Survey {request.id}, asked by {request.actor or 'somebody'} at {context.moment(request.asked_ns)}"
    with ui.row().classes("actions"):
        html(Markup("<p>{}{}</p>").format(words, f": {request.reason}" if request.reason else ""))
        change_button(
            services,
            f"Survey {request.id} is done",
            "Its tiles leave the list of the next survey, unless robots fail there. Maps and robots are not changed.",
            lambda actor: services.maps.end_survey_request(context.site, request.id, actor),
        )


def _words(corners: Corners, context: PageContext) -> str:
    if len(corners) < 3:
        return "Switch drawing on and click at least three corners into the map first."
    whose = f"this polygon of {len(corners)} corners"
    return f"The tiles of {whose} go on the list of the next survey of {context.site}. Robots are not changed."


def _asked(services: Services, context: PageContext, corners: Corners, actor: Actor) -> str:
    return services.maps.ask_for_survey(context.site, corners, actor)


def _items(corners: Corners) -> list[Item]:
    ends: list[Item] = [Mark(x, y, "accent", "square", f"corner {n}") for n, (x, y) in enumerate(corners, 1)]
    return [*([Line([*corners, corners[0]], "accent", width=2)] if len(corners) > 1 else []), *ends]
