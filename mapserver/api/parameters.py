"""What endpoints are given: the service, parameters of paths and queries, and pages of long lists.

A page has `limit` items behind `cursor`; `next` is the following page's cursor.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path as File
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, cast

from fastapi import Depends, Path, Query, Request
from fastapi.dependencies.utils import get_flat_params
from fastapi.params import Header
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.mapformat.names import NAME_PATTERN, SHA256_PATTERN
from mapserver.api.guard import GuardSettings
from mapserver.api.metrics import Metrics
from mapserver.api.moments import read_range
from mapserver.api.views import Page
from mapserver.config import MapserverConfig
from mapserver.fleet.fleet import Fleet
from mapserver.operators.operators import Operators
from mapserver.operators.roles import OPERATOR_PATTERN
from mapserver.serving.night_runs import NightRuns
from mapserver.store import FailureFilter, MapStore
from mapserver.trust.http_certificate import HttpCertificate

T = TypeVar("T")


class ApiSettings(NamedTuple):
    """Settings of access, and those of the server's file; the certificate of HTTP, webhook and inbox, None without one."""

    guard: GuardSettings = GuardSettings()
    config: MapserverConfig = MapserverConfig()
    certificate: HttpCertificate | None = None
    webhook: Any = None
    nights: NightRuns | None = None

    @property
    def inbox(self) -> File | None:
        """The folder with an inbox for each site."""
        return None if self.nights is None else self.nights.inbox


class Served(NamedTuple):
    """What endpoints work with. bus: None if the server has none; uploads: the files that are being uploaded."""

    store: MapStore
    fleet: Fleet
    metrics: Metrics
    bus: Bus | None
    settings: ApiSettings
    operators: Operators
    uploads: set[File]


async def _served(request: Request) -> Served:
    return cast(Served, request.app.state.served)


async def _store(request: Request) -> MapStore:
    return cast(Served, request.app.state.served).store


Service = Annotated[Served, Depends(_served)]
Store = Annotated[MapStore, Depends(_store)]
"""The open store of the application."""

Site = Annotated[str, Path(pattern=NAME_PATTERN, examples=["hall"])]
Robot = Annotated[str, Path(pattern=NAME_PATTERN, examples=["tug-7"])]
Operator = Annotated[str, Path(pattern=OPERATOR_PATTERN, examples=["ada"])]
TokenNumber = Annotated[str, Path(pattern="^[0-9a-f]{12}$", examples=["3fa9c1d25e7b"])]
RequestId = Annotated[str, Path(pattern="^[0-9a-f]{8}$", examples=["3fa9c1d2"])]
SiteFilter = Annotated[str | None, Query(pattern=NAME_PATTERN, description="of this site alone", examples=["hall"])]
Version = Annotated[int, Path(ge=1, le=1 << 31, examples=[3])]
Sha256 = Annotated[str, Path(pattern=SHA256_PATTERN, examples=["5e" * 32])]
Number = Annotated[int, Path(ge=1, le=1 << 62, examples=[12])]
RecordingName = Annotated[str, Path(max_length=220, examples=["monday.mcap"])]
Box = Annotated[Literal["held", "bad"], Path(examples=["held"])]
PictureNumber = Annotated[int, Path(ge=0, le=100, examples=[1])]
Axis = Annotated[
    Literal["site", "robot", "version", "tile", "area", "cause"],
    Query(description="what the figures are for", examples=["version"]),
]
Hours = Annotated[
    int, Query(ge=1, le=24 * 400, description="number of past hours, the current one included", examples=[24])
]
KeyFilter = Annotated[
    str | None, Query(max_length=64, description="only this robot, version, tile, area or cause", examples=[None])
]
VersionFilter = Annotated[int | None, Query(ge=1, le=1 << 31, description="on this version alone", examples=[None])]
Limit = Annotated[int, Query(ge=1, le=1000, description="items of a page", examples=[100])]
_NEXT = "`next` of the previous page"
NumberCursor = Annotated[int | None, Query(ge=0, le=(1 << 62), description=_NEXT, examples=[None])]
NameCursor = Annotated[str | None, Query(max_length=500, description=_NEXT, examples=[None])]
_TIME = "ISO 8601; without an offset the server's local time; a date alone is the whole day"
Since = Annotated[
    str | None, Query(max_length=40, description=f"not before: {_TIME}", examples=["2026-01-02T03:04:05Z"])
]
Until = Annotated[str | None, Query(max_length=40, description=f"before: {_TIME}", examples=[None])]


def time_range(since: Since = None, until: Until = None) -> tuple[int | None, int | None]:
    """Return nanoseconds since 1970, None for an open end; 422 for an invalid time or an end before the start."""
    return read_range(since, until)


TimeRange = Annotated[tuple[int | None, int | None], Depends(time_range)]


def file_body(media_type: str = "application/octet-stream", **more: bool) -> dict[str, Any]:
    """The OpenAPI description of a body that is a file."""
    return {"requestBody": {"content": {media_type: {"schema": {"type": "string", "format": "binary"}}}, **more}}


async def known_parameters(request: HTTPConnection) -> None:
    """Refuse query parameters unknown to an API address: an ignored filter would give a wrong result.

    Pages check their own parameters.
    """
    route = request.scope.get("route")
    if not request.query_params or not isinstance(route, APIRoute) or not route.include_in_schema:
        return
    asked = [each for each in get_flat_params(route.dependant) if not isinstance(each.field_info, Header)]
    known = {each.alias for each in asked} - route.param_convertors.keys()
    unknown = [name for name in request.query_params if name not in known]
    if unknown:
        words = f"this address knows {', '.join(sorted(known))}" if known else "this address has none"
        raise HTTPException(422, f"unknown query parameter {unknown[0][:40]!r}; {words}")


def failure_filter(
    within: TimeRange,
    site: SiteFilter = None,
    robot: KeyFilter = None,
    version: VersionFilter = None,
    tile: KeyFilter = None,
    area: KeyFilter = None,
    cause: KeyFilter = None,
    kind: KeyFilter = None,
) -> FailureFilter:
    """Return the filter of a list of failures."""
    return FailureFilter(site, robot, version, tile, cause, kind, *within, area)


FailuresWanted = Annotated[FailureFilter, Depends(failure_filter)]


@dataclass(frozen=True, slots=True)
class _Page:
    limit: Limit = 100

    def cut(self, items: Iterable[T], key: Callable[[T], Any]) -> tuple[list[T], str | None]:
        """The first `limit` items and the next page's cursor, of items behind this one's cursor, one more if there are more."""
        found = list(items)
        shown = found[: self.limit]
        return shown, str(key(shown[-1])) if len(found) > self.limit else None

    def of(self, items: Iterable[T], key: Callable[[T], Any]) -> Page[T]:
        """This page of a list."""
        shown, following = self.cut(items, key)
        return Page(items=shown, next=following)


@dataclass(frozen=True, slots=True)
class _ByNumber(_Page):
    """A page of a list whose items are asked for behind a number."""

    cursor: NumberCursor = None


@dataclass(frozen=True, slots=True)
class _ByName(_Page):
    """A page of a list by name, of all its items."""

    cursor: NameCursor = None

    def cut(self, items: Iterable[T], key: Callable[[T], Any]) -> tuple[list[T], str | None]:
        behind = (item for item in items if self.cursor is None or str(key(item)) > self.cursor)
        return _Page.cut(self, sorted(behind, key=key), key)


NamePage = Annotated[_ByName, Depends()]
NumberPage = Annotated[_ByNumber, Depends()]
"""The page of a list that is asked for."""
