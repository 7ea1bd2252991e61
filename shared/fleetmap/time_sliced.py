"""Work in slices, for callers that must not block for long."""

from collections.abc import Generator
from typing import TypeVar, cast

T = TypeVar("T")
TimeSliced = Generator[None, None, T]  # work that may be interrupted at each yield


def finished(work: TimeSliced[T]) -> T:
    """Run all slices at once and return the result."""
    while True:
        try:
            next(work)
        except StopIteration as done:
            return cast(T, done.value)
