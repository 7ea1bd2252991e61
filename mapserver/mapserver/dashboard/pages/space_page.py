"""The page that shows a version in three dimensions, with the robots in it."""

from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from fleetmap.errors import StateError
from mapserver.dashboard.layout import RESPONSE_TIMEOUT_S, PageContext, Services, html, load, number, show
from mapserver.dashboard.markup import link
from mapserver.dashboard.space.space_view import SpaceView

_MOVE_EVERY_S = 1.0


def install(services: Services) -> None:
    """Adds the page."""

    @ui.page("/space", title="Map in space – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def space_page(request: Request, site: str | None = None, version: str | None = None) -> None:
        async def build(context: PageContext) -> None:
            html(Markup("<h1>Map of {} in space</h1>").format(context.site))
            shown = number(version, "version")
            if shown is None:
                shown = await load(services.maps.current_version, context.site)
            if shown is None:
                raise StateError(f"site {context.site} has no published version; publish one, or name a draft")
            await load(services.maps.plan, context.site, shown)  # a version that is not there is named here
            live = await load(services.robots.look, context.site)
            address = f"{context.root}/spaces/{context.site}/{shown}.bin"
            view = SpaceView(
                f"Landmarks, places and robots of version {shown}, in three dimensions", address, live.robots
            )
            words = (
                "Dots: landmarks. Blue: places that robots recognise, as their cameras stood. Drag to turn, right button or two fingers to "
                "walk, wheel to come nearer; arrow keys walk, too. Robots stand where they last said that they are. "
            )
            back = link(context.to("map", version=shown), f"Version {shown} from above")
            html(Markup('<p class="quiet">{}{}</p>').format(words, back))

            async def move() -> None:
                view.show_robots((await load(services.robots.look, context.site)).robots)

            ui.timer(_MOVE_EVERY_S, move, immediate=False)

        await show(services, request, "map", site, build, ("version",))
