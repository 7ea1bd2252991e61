"""Endpoints of a site's building: its named areas, and the pose of the map in its floor plan.

A file is sent as the body; author and reason are then in the query.
"""

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from starlette.exceptions import HTTPException

from fleetmap.encoding import to_plain
from mapserver.api import parameters as p
from mapserver.api import views
from mapserver.api.guard import By
from mapserver.fleet import building
from mapserver.floor_plan.pins import MAX_PINS, parse_pin
from mapserver.floor_plan.plan_file import decode_plan
from mapserver.store import MapStore

_ALIGNMENTS = asyncio.Semaphore(2)  # at once: each may hold a picture of many MB


async def _body(request: Request) -> bytes:
    return await request.body()


async def _picture(request: Request) -> AsyncIterator[bytes]:
    if _ALIGNMENTS.locked():
        raise HTTPException(429, "other alignments go on; try again when one has ended", {"Retry-After": "5"})
    async with _ALIGNMENTS:
        yield await request.body()


File = Annotated[bytes, Depends(_body)]
Plan = Annotated[bytes, Depends(_picture)]
_WHAT = "the ETag of the areas that are changed: 412 if somebody changed them since"
IfMatch = Annotated[str | None, Header(pattern=r'^(\*|(W/)?"[0-9a-f]{64}")$', description=_WHAT, examples=["*"])]
_PIN = "NAME=PX,PY:X,Y: pixels right and down in the plan, and metres in `map`; at least two"
Pins = Annotated[list[str], Query(max_length=MAX_PINS, description=_PIN, examples=[["dock=120,2310:0.4,-1.2"]])]
PlanName = Annotated[
    str | None,
    Query(min_length=1, max_length=200, description="name of the picture in the body", examples=["hall.png"]),
]
Scale = Annotated[
    float | None, Query(ge=1e-6, le=1e3, description="of the plan; without it estimated from the pins", examples=[None])
]
router = APIRouter()


@router.get("/v1/sites/{site}/areas")
def areas(response: Response, store: p.Store, site: p.Site) -> dict[str, Any]:
    """Named areas of a site as GeoJSON, with metres in `map` instead of degrees."""
    store.current(site)  # raises for an unknown site
    _tag(response, store, site)  # read first: a change in between makes the tag too old, not the areas
    return store.areas(site).geojson(site)


@router.put("/v1/sites/{site}/areas", openapi_extra=p.file_body("application/geo+json"))
def replace_areas(
    response: Response, store: p.Store, site: p.Site, by: By, data: File, if_match: IfMatch = None
) -> dict[str, Any]:
    """Replace the areas of a site by those of a file, as `mapserver areas import`. Areas drawn in the building stay in its frame."""
    store.current(site)
    kept = building.keep_areas(store, site, data, None, by, tag=_given(if_match))
    _tag(response, store, site)
    return kept.geojson(site)


@router.delete("/v1/sites/{site}/areas")
def remove_areas(store: p.Store, site: p.Site, by: By, if_match: IfMatch = None) -> views.ServiceState:
    """Remove the areas of a site; their past counts stay."""
    building.keep_areas(store, site, None, "no areas", by, tag=_given(if_match))
    return views.OK


@router.get("/v1/sites/{site}/alignment")
def alignment(store: p.Store, site: p.Site) -> dict[str, Any]:
    """The pose of the map in the drawing of its building, with what is left at each pin."""
    store.current(site)
    found = store.alignment(site)
    if found is None:
        raise HTTPException(404, f"site {site} is not aligned; PUT pins and the picture of a floor plan here")
    return dict(to_plain(found))


@router.put("/v1/sites/{site}/alignment", openapi_extra=p.file_body())
def set_alignment(
    store: p.Store, site: p.Site, by: By, data: Plan, pin: Pins, plan: PlanName = None, metres_per_pixel: Scale = None
) -> dict[str, Any]:
    """Align the map with the picture of a floor plan (PNG, JPEG, TIFF, BMP or PGM), or with pins alone, as `mapserver align`."""
    store.current(site)
    if bool(data) != (plan is not None):
        raise HTTPException(422, "send a picture as the body with its name as `plan`, or neither of them")
    drawing = None if plan is None else decode_plan(plan, data)
    fit = building.align(store, site, [parse_pin(text) for text in pin], drawing, metres_per_pixel, by)
    return dict(to_plain(fit.alignment))


@router.get("/v1/sites/{site}/alignment/estimate")
def estimate_alignment(store: p.Store, site: p.Site, pin: Pins, metres_per_pixel: Scale = None) -> dict[str, Any]:
    """The pose of the map that these pins would give, with what is left at each; nothing is kept."""
    store.current(site)
    fit = building.estimate_alignment(store, site, [parse_pin(text) for text in pin], None, metres_per_pixel)
    return dict(to_plain(fit.alignment)) | {"far_sigma_m": fit.far_sigma_m, "is_checked": fit.is_checked}


@router.delete("/v1/sites/{site}/alignment")
def forget_alignment(store: p.Store, site: p.Site, by: By) -> views.ServiceState:
    """Remove the alignment of a site and its floor plan; 409 while areas are drawn in the building."""
    store.current(site)
    building.forget_alignment(store, site, by)
    return views.OK


def _tag(response: Response, store: MapStore, site: str) -> None:
    response.headers.update({"ETag": f'"{store.areas_tag(site)}"', "Cache-Control": "no-cache"})


def _given(if_match: str | None) -> str | None:
    return None if if_match in (None, "*") else if_match.removeprefix("W/").strip('"')
