"""The page in three dimensions, and what the pages of failures and maps show of the dense maps."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from fastapi import Response

from fleetmap.mapformat import decode_tile
from fleetmap.messages import FailureReport
from mapserver.dashboard.console import PageContext, Services
from mapserver.dashboard.install import Host, file_response
from mapserver.dashboard.rendering import TEMPLATES
from mapserver.plugins.dense_maps import space_page
from mapserver.plugins.dense_maps.lacks import lacks_surfels, lacks_view
from mapserver.plugins.dense_maps.space_points import space_bytes, surfel_bytes
from mapserver.plugins.dense_maps.surfel_map import surfels_of
from mapserver.store import FailureRow

_FOLDER = Path(__file__).parent
_PANELS: Any = TEMPLATES.from_string((_FOLDER / "panels.html").read_text("utf-8")).module


def install(host: Host) -> None:
    """Add the page, its files and the panels of other pages."""
    console, store = host.console, host.store
    console.files("parts/dense", _FOLDER / "static")
    template = TEMPLATES.from_string((_FOLDER / "space.html").read_text("utf-8"))
    console.page("space", template, space_page.page, under="map", knows=("version", "x", "y"))
    panels: dict[str, Callable[..., str]] = {
        "failure": _expected,
        "changes": _changes,
        "version": _link,
        "place": _link_from,
    }
    for place, panel in panels.items():
        console.services.panels.setdefault(place, []).append(panel)

    @console.app.get("/spaces/{site}/{version}.bin")
    def space(site: str, version: int) -> Response:
        """Landmarks and places of a version; made at each call, since browsers keep it."""
        tiles = [decode_tile(store.blob(entry.sha256)) for entry in store.manifest(site, version).tiles]
        return file_response(space_bytes(tiles), "application/octet-stream")

    @console.app.get("/surfels/{site}/{version}.bin")
    def surfels(site: str, version: int) -> Response:
        """Surfels of a version."""
        found = surfels_of(store.manifest(site, version), store.blob)
        return file_response(surfel_bytes(found), "application/octet-stream")


def _expected(services: Services, context: PageContext, row: FailureRow, report: FailureReport) -> str:
    return str(_PANELS.expected(context.api, row.number, lacks_view(services.maps.store, report)))


def _changes(services: Services, context: PageContext, before: int, after: int) -> str:
    lacks = filter(None, (lacks_surfels(services.maps.store, context.site, number) for number in (before, after)))
    return str(_PANELS.changes(context.api, context.site, before, after, next(lacks, None)))


def _link(_: Services, context: PageContext, version: int) -> str:
    return str(_PANELS.link(context.to("space", version=version), "3D view"))


def _link_from(_: Services, context: PageContext, version: int, x_m: float, y_m: float) -> str:
    return str(
        _PANELS.link(context.to("space", version=version, x=round(x_m, 2), y=round(y_m, 2)), "3D view from there")
    )
