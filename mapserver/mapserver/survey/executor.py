"""Executors of independent batches of a survey. The result does not depend on the executor."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Protocol, TypeVar

Batch = TypeVar("Batch")
Result = TypeVar("Result")
Later_co = TypeVar("Later_co", covariant=True)
Shared = TypeVar("Shared")


class Work(Protocol[Later_co]):
    """Work that goes on beside what asked for it."""

    def done(self) -> bool:
        """Whether its result is there."""

    def result(self) -> Later_co:
        """Its result, waited for; or the error that it raised."""


class Executor(Protocol):
    """Computes batches, in any order and anywhere; function and arguments can be pickled."""

    def map(
        self, function: Callable[[Shared, Batch], Result], shared: Shared, batches: Iterable[Batch]
    ) -> Iterator[Result]:
        """function(shared, batch) of every batch, in their order. `shared` travels once, however many calls it takes part in."""

    @property
    def nearby(self) -> "Executor":
        """For small batches that are waited for: the way to processes and back would cost more than they take over."""

    def beside(self, function: Callable[..., Result], *arguments: Any) -> Work[Result] | None:
        """function(*arguments), which can be pickled, on another core while the caller goes on; what was asked for earlier comes first.

        None where no core is left for that: the caller computes it when it needs it.
        """


class SerialExecutor:
    """Computes one batch after the other in the calling thread, each when its result is asked for."""

    def map(
        self, function: Callable[[Shared, Batch], Result], shared: Shared, batches: Iterable[Batch]
    ) -> Iterator[Result]:
        return (function(shared, batch) for batch in batches)

    @property
    def nearby(self) -> Executor:
        return self

    def beside(self, function: Callable[..., Result], *arguments: Any) -> Work[Result] | None:
        return None


SERIAL = SerialExecutor()


def in_batches(items: Sequence[Any], size: int) -> list[Any]:
    """The items, in order, in lists of at most `size`."""
    return [list(items[start : start + size]) for start in range(0, len(items), size)]
