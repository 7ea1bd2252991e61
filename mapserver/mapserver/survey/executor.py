"""Who does the parts of a survey that do not depend on each other. What comes out is the same whoever does them."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Protocol, TypeVar

Batch = TypeVar("Batch")
Result = TypeVar("Result")
Shared = TypeVar("Shared")


class Executor(Protocol):
    """Does batches, in any order and anywhere; function and arguments can be pickled."""

    def map(
        self, function: Callable[[Shared, Batch], Result], shared: Shared, batches: Iterable[Batch]
    ) -> Iterator[Result]:
        """function(shared, batch) of every batch, in their order. `shared` travels once, however many calls it takes part in."""


class SerialExecutor:
    """Does everything itself, one batch after the other, each when its result is asked for."""

    def map(
        self, function: Callable[[Shared, Batch], Result], shared: Shared, batches: Iterable[Batch]
    ) -> Iterator[Result]:
        """See Executor."""
        return (function(shared, batch) for batch in batches)


SERIAL = SerialExecutor()


def in_batches(items: Sequence[Any], size: int) -> list[Any]:
    """The items, in order, in lists of at most `size`."""
    return [list(items[start : start + size]) for start in range(0, len(items), size)]
