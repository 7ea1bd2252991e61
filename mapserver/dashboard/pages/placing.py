"""A form on the robot's page: a person says where the robot stands."""

import math

from markupsafe import Markup
from nicegui import ui

from fleetmap.errors import UsageError
from fleetmap.messages import InitialPoseMessage
from mapserver.dashboard.layout import PageContext, Services, html
from mapserver.dashboard.map_layers import Layer, Mark
from mapserver.dashboard.pages.confirm import change_button, may_change
from mapserver.dashboard.site_map import SiteMap
from mapserver.store import Actor

CHOSEN = Layer("Chosen place")
"""Goes on the map beside the form."""


def place_form(services: Services, context: PageContext, robot: str, drawn: SiteMap) -> None:
    """Fields that a click into the map fills, and the act. Nothing for who may only look."""
    if not may_change():
        return
    html(
        Markup(
            '<h2>Say where it stands</h2><p class="quiet">Click into the map, or write metres. The heading is 0 along x and 90 along y; '
            "leave it empty where you do not know it. The robot believes it over what it tracks, until what it sees outweighs it.</p>"
        )
    )
    with ui.row().classes("actions"):
        x, y, heading = (
            ui.number(words).props(f'outlined dense step={step} input-style="width:9em"')
            for words, step in (("x (m)", 0.1), ("y (m)", 0.1), ("Heading (°)", 15))
        )

        def told() -> InitialPoseMessage:
            if x.value is None or y.value is None:
                raise UsageError("click into the map, or write x and y")
            turn = None if heading.value is None else math.radians(heading.value)
            return InitialPoseMessage(
                site=context.site, robot=robot, x_map_m=float(x.value), y_map_m=float(y.value), heading_rad=turn
            )

        def explanation() -> str:
            try:
                place = told()
            except UsageError as error:
                return f"{str(error)[:1].upper()}{str(error)[1:]}."
            facing = "looking any way" if heading.value is None else f"looking at {heading.value:g} degrees"
            return f"{robot} will search for itself around {place.x_map_m:.2f}, {place.y_map_m:.2f} m, {facing}. No other robot is changed."

        def act(actor: Actor) -> str:
            services.placing.tell(told(), actor)
            return f"{robot} was told."

        change_button(services, f"{robot} is here", explanation, act, css="forward")

    def show() -> None:
        shown = []
        if x.value is not None and y.value is not None:
            turn = None if heading.value is None else math.radians(heading.value)
            shape = "cross" if turn is None else "arrow"
            shown = [Mark(float(x.value), float(y.value), "accent", shape, "chosen place", heading_rad=turn)]
        drawn.show(CHOSEN.name, shown)

    def pick(x_m: float, y_m: float) -> None:
        x.set_value(x_m), y.set_value(y_m)

    drawn.on_pick(pick)
    for field in (x, y, heading):
        field.on_value_change(show)
