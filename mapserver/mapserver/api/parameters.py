"""Parameters of paths and queries, and pages of long lists: `limit` items behind `cursor`, `next` the following page's cursor."""

from collections.abc import Callable, Sequence
from typing import Annotated, Literal, TypeVar

from fastapi import Path, Query
from pydantic import BaseModel

from fleetmap.mapformat.names import NAME_PATTERN, SHA256_PATTERN
from fleetmap.version_grid import FLOOR_M, TOP_M
from mapserver.store import FailureFilter

Item = TypeVar("Item")

Site = Annotated[str, Path(pattern=NAME_PATTERN, examples=["hall"])]
SiteFilter = Annotated[str | None, Query(pattern=NAME_PATTERN, description="of this site alone", examples=["hall"])]
Version = Annotated[int, Path(ge=1, le=1 << 31, examples=[3])]
RobotHeight = Annotated[
    float, Query(gt=FLOOR_M, le=TOP_M, description="metres; what hangs higher is no obstacle", examples=[1.1])
]
Sha256 = Annotated[str, Path(pattern=SHA256_PATTERN, examples=["5e" * 32])]
Number = Annotated[int, Path(ge=1, le=1 << 62, examples=[12])]
PictureNumber = Annotated[int, Path(ge=0, le=100, examples=[1])]
Axis = Annotated[
    Literal["site", "robot", "version", "tile", "area", "cause"],
    Query(description="what the figures are for", examples=["version"]),
]
Hours = Annotated[
    int, Query(ge=1, le=24 * 400, description="so many hours back, the running one included", examples=[24])
]
KeyFilter = Annotated[
    str | None, Query(max_length=64, description="this robot, version, tile, area or cause alone", examples=[None])
]
VersionFilter = Annotated[int | None, Query(ge=1, le=1 << 31, description="on this version alone", examples=[None])]
Limit = Annotated[int, Query(ge=1, le=1000, description="items of a page", examples=[100])]
_NEXT = "`next` of the page before"
NumberCursor = Annotated[int | None, Query(ge=0, le=(1 << 62), description=_NEXT, examples=[None])]
NameCursor = Annotated[str | None, Query(max_length=160, description=_NEXT, examples=[None])]


class FailureQuery(BaseModel):
    """Filters and the page of a list of failures."""

    site: SiteFilter = None
    robot: KeyFilter = None
    version: VersionFilter = None
    tile: KeyFilter = None
    area: KeyFilter = None
    cause: KeyFilter = None
    kind: KeyFilter = None
    limit: Limit = 100
    cursor: NumberCursor = None

    def filter(self) -> FailureFilter:
        """As the store takes it."""
        return FailureFilter(**self.model_dump(exclude={"limit", "cursor"}))


def page(items: Sequence[Item], limit: int, cursor_of: Callable[[Item], str]) -> tuple[list[Item], str | None]:
    """The first `limit` of `items` and the next page's cursor; `items` holds one more if there are more."""
    shown = list(items[:limit])
    return shown, cursor_of(shown[-1]) if len(items) > limit else None
