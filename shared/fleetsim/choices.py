"""Choices by name from tables."""

from collections.abc import Mapping
from typing import TypeVar

from fleetmap.errors import UsageError

T = TypeVar("T")


def chosen(what: str, name: str, known: Mapping[str, T]) -> T:
    """Return the entry of a name; UsageError naming the known ones."""
    if name not in known:
        raise UsageError(f"unknown {what} {name!r}; known are {', '.join(known)}")
    return known[name]
