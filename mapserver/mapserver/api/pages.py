"""Pages of long lists: `limit` items behind `cursor`; `next` is the cursor of the following page, null on the last."""

from collections.abc import Callable, Sequence
from typing import Annotated, TypeVar

from fastapi import Query

Item = TypeVar("Item")

MAX_LIMIT = 1000
Limit = Annotated[int, Query(ge=1, le=MAX_LIMIT, description="items of a page")]
NumberCursor = Annotated[
    int | None, Query(ge=0, le=(1 << 62), description="`next` of the page before", examples=[None])
]
NameCursor = Annotated[str | None, Query(max_length=64, description="`next` of the page before", examples=[None])]
RobotCursor = Annotated[str | None, Query(max_length=129, description="`next` of the page before", examples=[None])]
CounterCursor = Annotated[str | None, Query(max_length=160, description="`next` of the page before", examples=[None])]


def page(items: Sequence[Item], limit: int, cursor_of: Callable[[Item], str]) -> tuple[list[Item], str | None]:
    """The first `limit` of `items` and the next page's cursor; `items` holds one more if there are more."""
    shown = list(items[:limit])
    return shown, cursor_of(shown[-1]) if len(items) > limit else None
