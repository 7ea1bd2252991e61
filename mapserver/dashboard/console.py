"""The frame of every page: templates filled from the same functions as the HTTP API, under a policy that runs no script of a page's text.

What a page needs to know goes into `fill`; what moves from second to second comes by a stream of server-sent events, and what changes
now and then is fetched anew by `static/renew.js`. Acts are requests to the HTTP API, by `static/acts.js`.
"""

import asyncio
from base64 import b64encode
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, StreamingResponse
from fastapi.staticfiles import StaticFiles
from markupsafe import Markup

from fleetmap.encoding import to_json
from fleetmap.errors import FleetmapError, UsageError
from mapserver.api.guard import SIGN_IN
from mapserver.api.moments import zone_of
from mapserver.dashboard.layout import LOOK_COOKIE, PAGES, ZONE_COOKIE, PageContext, Services, check_query, load, person
from mapserver.dashboard.map_layers import Layer, box_around, box_of, ground
from mapserver.dashboard.rendering import TEMPLATES
from mapserver.operators.roles import Scope

PATH = "/dashboard"
_HERE = Path(__file__).parent
_EVERY_S = 1.0
_MODULES = {"leaflet": "leaflet/leaflet.js", "three": "three/three.module.min.js", "three/addons/": "three/"}
_THEMES = {"dark": "body--dark", "light": ""}  # else as the system has it
# {}: the hash of the import map, the one script within a page.
_POLICY = (
    "default-src 'none'; script-src 'self' 'sha256-{}'; style-src 'self'; img-src 'self' data:; connect-src 'self'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'none'"
)


@dataclass(frozen=True, slots=True)
class Console:
    """Where pages are added."""

    app: FastAPI
    services: Services

    def files(self) -> None:
        """Adds what all pages load."""
        self.app.mount("/static", StaticFiles(directory=_HERE / "static"))

    def nothing_else(self) -> None:
        """Adds the page for addresses that no page has."""

        def no_page(context: PageContext) -> dict[str, object]:
            raise UsageError("There is no such page here.")

        @self.app.exception_handler(404)
        async def missing(request: Request, _: Exception) -> HTMLResponse:
            """Within the frame, with a way back."""
            return await self._shown(request, "none", "", no_page, tuple(request.query_params), list)

    def page(
        self,
        path: str,
        template: str,
        fill: Callable[..., dict[str, object]],
        *,
        knows: Sequence[str] = (),
        under_way: Callable[[], list[str]] = list,
    ) -> None:
        """Adds a page. fill: what its template needs beside `context`, of that and the parts of `path` in braces; it may block.

        A FleetmapError becomes a notice within the frame. knows: query parameters beside the site. under_way: sites that the page
        knows though the store has no version of them.
        """

        @self.app.get(f"/{path}", include_in_schema=False)
        async def shown(request: Request) -> HTMLResponse:
            """A page."""
            return await self._shown(request, path.partition("/")[0], template, fill, knows, under_way)

    def stream(
        self,
        path: str,
        one: Callable[..., dict[str, object]],
        *,
        under_way: Callable[[], list[str]] = list,
    ) -> None:
        """Adds what a page follows: looked at every second and told when it has changed, for as long as the session lasts.

        one: as `fill` of a page.
        """

        @self.app.get(f"/{path}", include_in_schema=False)
        async def followed(request: Request, site: str) -> StreamingResponse:
            """A stream of server-sent events."""
            chosen = site if site in await load(under_way) else await load(self.services.maps.chosen_site, site)
            context = PageContext(
                _root(request), "", chosen, zone_of(request.cookies.get(ZONE_COOKIE)), request.query_params
            )
            guard = self.services.guard

            def event() -> bytes:
                is_signed_in = getattr(request.state, "operator", None) is not None
                if is_signed_in and guard.identify(request.scope, uses=False) is None:
                    return b"event: ended\ndata: %s\n\n" % SIGN_IN.encode()
                return b"data: %s\n\n" % to_json(one(context, **request.path_params))

            async def events() -> AsyncIterator[bytes]:
                told = b""
                while not await request.is_disconnected():
                    found = await load(event)
                    yield b":\n\n" if found == told else found
                    told = found
                    await asyncio.sleep(_EVERY_S)

            return StreamingResponse(events(), media_type="text/event-stream", headers={"Cache-Control": "no-store"})

    async def _shown(
        self,
        request: Request,
        page: str,
        template: str,
        fill: Callable[..., dict[str, object]],
        knows: Sequence[str],
        under_way: Callable[[], list[str]],
    ) -> HTMLResponse:
        root, site, found, status = _root(request), request.query_params.get("site"), {}, 200
        sites: list[str] = []
        try:
            growing = await load(under_way)
            sites = sorted({*await load(self.services.maps.sites), *growing})
            if site not in growing:
                site = growing[0] if site is None and growing else await load(self.services.maps.chosen_site, site)
            check_query(request, knows)
            zone = zone_of(request.cookies.get(ZONE_COOKIE))
            context = PageContext(root, page, site, zone, request.query_params)
            found = {"context": context} | await load(lambda: fill(context, **request.path_params))
        except FleetmapError as error:
            template, found, status = "problem.html", {"words": str(error)}, 404
            site = site if site in sites else None  # links lead somewhere
        files = {name: f"{root}/static/vendor/{file}" for name, file in _MODULES.items()}
        imports = to_json({"imports": files}).decode()
        look, who = request.cookies.get(LOOK_COOKIE, ""), getattr(request.state, "operator", None)
        frame = {
            "root": root,
            "api": f"{root.removesuffix(PATH)}/v1",
            "imports": Markup(imports),
            "pages": PAGES,
            "page": page,
            "sites": sites,
            "site": site,
            "look": look if look in _THEMES else "",
            "theme": _THEMES.get(look, "print"),
            "person": person(request),
            "may_change": who is None or Scope.CHANGE in who.scopes,
            "is_named": who is not None,
            "warning": self.services.guard.warning,
        }
        policy = _POLICY.format(b64encode(sha256(imports.encode()).digest()).decode())
        filled = TEMPLATES.get_template(template).render(frame | found)
        return HTMLResponse(filled, status, {"Content-Security-Policy": policy})


def scene_of(
    services: Services,
    context: PageContext,
    version: int,
    over: Sequence[Layer],
    *,
    places_m: Sequence[tuple[float, float]] = (),
    shows_coverage: bool = False,
) -> dict[str, object]:
    """A version's map with layers over it, for `site_map` of templates. places_m: what is in sight first, everything without them."""
    plan = services.maps.plan(context.site, version)
    below = services.maps.underlays(context.site, version, context.root)
    picture, areas = context.plan_picture(version), services.maps.areas(context.site)
    layers = [*ground(plan, picture, areas, below, shows_coverage=shows_coverage), *over]
    box = box_around(places_m, box_of(plan))
    return {"label": f"Map of {context.site}, version {version}", "box": box, "layers": layers, "follows": False}


def _root(request: Request) -> str:
    return str(request.scope.get("root_path", ""))
