"""The page that shows a version in three dimensions, with the robots in it, and a walk through it beside the plan."""

from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from fleetmap.errors import StateError, UsageError
from mapserver.dashboard.layout import (
    RESPONSE_TIMEOUT_S,
    PageContext,
    Services,
    html,
    load,
    number,
    show,
    version_map,
)
from mapserver.dashboard.map_layers import Layer, Mark
from mapserver.dashboard.markup import link
from mapserver.dashboard.site_map import SiteMap
from mapserver.dashboard.space.robot_views import robot_views
from mapserver.dashboard.space.space_view import SpaceScene, SpaceView

_MOVE_EVERY_S = 1.0
_HERE = Layer("Where you stand")


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
            start = _start(context)
            await _page(services, context, shown, start)

        await show(services, request, "map", site, build, ("version", "x", "y"))


def _start(context: PageContext) -> tuple[float, float] | None:
    """Where the walk begins by the address; UsageError for what is no place."""
    given = [context.query.get(axis) for axis in "xy"]
    if given == [None, None]:
        return None
    try:
        x, y = (float(text or "") for text in given)
    except ValueError:
        raise UsageError(f"x={given[0]} and y={given[1]} are no place; write metres of the map") from None
    return x, y


async def _page(services: Services, context: PageContext, version: int, start: tuple[float, float] | None) -> None:
    maps = services.maps
    quality = await load(maps.quality, context.site, version)  # a version that is not there is named here
    has_surfels = await load(maps.has_surfels, context.site, version)
    scene = SpaceScene(
        f"Landmarks, places and robots of version {version}, in three dimensions",
        f"{context.root}/spaces/{context.site}/{version}.bin",
        quality.manifest.camera,
        f"../v1/sites/{context.site}/versions/{version}/view.png" if has_surfels else None,
        await load(maps.loops, context.site, version),
        robot_views(await load(services.health.cameras, context.site)),
    )
    live = await load(services.robots.look, context.site)
    with ui.element("div").classes("pair"):
        view = SpaceView(scene, live.robots)
        with ui.element("div"):
            drawn = await version_map(services, context, version, [_HERE], is_small=True)
            html(_words(context, version, len(scene.robot_views), has_surfels=has_surfels))
    _join(view, drawn)
    if start is not None:
        ui.timer(0.1, lambda: view.walk_to(*start), once=True)

    async def move() -> None:
        view.show_robots((await load(services.robots.look, context.site)).robots)

    ui.timer(_MOVE_EVERY_S, move, immediate=False)


def _join(view: SpaceView, drawn: SiteMap) -> None:
    """The plan shows where one stands, and a click into it goes there."""

    def walked(x_m: float, y_m: float, heading_rad: float) -> None:
        here = Mark(round(x_m, 2), round(y_m, 2), "accent", "arrow", "you", None, "you", heading_rad)
        drawn.show(_HERE.name, [here])

    view.on_walk(walked)
    drawn.on_pick(view.walk_to)


def _words(context: PageContext, version: int, own: int, *, has_surfels: bool) -> Markup:
    walk = "Walk: arrow keys or buttons step along the places of the surveys and turn; a click into this plan goes to the nearest one. "
    drawn = (
        "The picture beside the dots is drawn from the map's surfels: what the survey's camera should see there. "
        if has_surfels
        else f"Version {version} has no surfels, so that one walks among its landmarks; `[survey] surfel_map` makes them. "
    )
    views = f"Robots that told their camera in a failure report ({own}) have its view, all others that of the survey's camera."
    if not own:
        views = "No robot has told its camera, which failure reports do: they are drawn with the survey's."
    rest = (
        "Dots: landmarks. Blue: places that robots recognise, as their cameras stood. Green: revisits that hold the map together; red: "
        "those that were refused. Otherwise drag to turn, right button or two fingers to move, wheel to come nearer. Robots stand where "
        f"they last said that they are, and look where their heading says. {views} "
    )
    back = link(context.to("map", version=version), f"Version {version} from above")
    return Markup('<p class="quiet">{}{}{}{}</p>').format(walk, drawn, rest, back)
