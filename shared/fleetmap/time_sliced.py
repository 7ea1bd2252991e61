"""Work in slices, for callers that must not stop for long."""

from collections.abc import Generator
from typing import TypeVar, cast

T = TypeVar("T")
TimeSliced = Generator[None, None, T]  # work that may be interrupted wherever it yields


def finished(work: TimeSliced[T]) -> T:
    """The result of work in slices, all of them at once."""
    while True:
        try:
            next(work)
        except StopIteration as done:
            return cast(T, done.value)
