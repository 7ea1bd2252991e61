"""Executors of independent batches of a survey. The result does not depend on the executor."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Protocol, TypeVar

Batch = TypeVar("Batch")
Result = TypeVar("Result")
Shared = TypeVar("Shared")


class Executor(Protocol):
    """Computes batches, in any order and in any process; function and arguments can be pickled."""

    def map(
        self, function: Callable[[Shared, Batch], Result], shared: Shared, batches: Iterable[Batch]
    ) -> Iterator[Result]:
        """Yield function(shared, batch) for every batch, in order. `shared` is sent once for any number of calls."""


class SerialExecutor:
    """Computes one batch after the other in the calling thread, each when its result is requested."""

    def map(
        self, function: Callable[[Shared, Batch], Result], shared: Shared, batches: Iterable[Batch]
    ) -> Iterator[Result]:
        return (function(shared, batch) for batch in batches)


SERIAL = SerialExecutor()


def in_batches(items: Sequence[Any], size: int) -> list[Any]:
    """Return the items, in order, in lists of at most `size`."""
    return [list(items[start : start + size]) for start in range(0, len(items), size)]
