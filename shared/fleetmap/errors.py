"""Errors caused by external input: files, network, users.

The message holds the offending value and the next step. Caught only in the commands' `main` and the HTTP API.
"I do not know where I am" is a value with a status, never one of these.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Literal, TypeVar

T = TypeVar("T")


class FleetmapError(Exception):
    """Base of the tree; `exit_status`: of a command line."""

    exit_status = 3


class UsageError(FleetmapError):
    """An invalid command line or setting."""

    exit_status = 2


class InvalidValueError(UsageError):
    """A value that cannot be, beside those that name what is asked for."""


class ForbiddenError(UsageError):
    """A request beyond the rights of whoever sends it."""


class StateError(UsageError):
    """A request that does not fit the current state, such as promoting a draft."""


class ChangedError(StateError):
    """A change of what somebody else changed since it was looked at."""


class RecordingError(FleetmapError):
    """A recording that cannot be read or contradicts itself."""


class CalibrationError(RecordingError):
    """Missing or impossible calibration."""


class SurveyError(FleetmapError):
    """A recording from which no correct map can be made."""


class MapFormatError(FleetmapError):
    """Invalid tile, manifest or vocabulary bytes."""


class NewerFormatError(MapFormatError):
    """Bytes or a store made by a newer fleetmap than this one."""


class StoreError(FleetmapError):
    """A store that cannot be opened, read or written."""


class UnknownOutcomeError(StoreError):
    """A change of which nobody knows whether the store has it."""


class LinkError(FleetmapError):
    """The other side cannot be reached, refuses or sends an invalid reply."""


class UnreachableError(LinkError):
    """No reply in time; a later retry may help."""


class UntrustedError(LinkError):
    """A map or list that the signed lists do not allow. The message begins with the kind of attack."""

    def __init__(self, kind: Literal["rollback", "freeze", "signature", "size"], words: object) -> None:
        self.kind, self.words = kind, str(words)
        super().__init__(f"{kind}: {words}")


class GateRefusedError(FleetmapError):
    """The draft is not good enough to publish."""

    exit_status = 4


class BusyError(FleetmapError):
    """Another process does the same work; it ends by itself."""

    exit_status = 5


@contextmanager
def disk_errors(fault: object, advice: str, kind: type[FleetmapError] = StoreError) -> Iterator[None]:
    """Turn an OSError of the block into `kind`: "FAULT (the system's reason); ADVICE"."""
    try:
        yield
    except OSError as error:
        raise kind(f"{fault} ({error.strerror}); {advice}") from error


def check_format(what: str, found: bytes, wanted: bytes, number: int, newest: int) -> None:
    """Check a file's magic and format number.

    MapFormatError for another kind of file, NewerFormatError for a format above the newest that this fleetmap reads.
    """
    if found != wanted:
        raise MapFormatError(f"{what} begins {found!r}, not {wanted!r}; this is another kind of file")
    if number > newest:
        raise NewerFormatError(
            f"{what} has format {number}, this fleetmap reads up to {newest}; update fleetmap to read it"
        )


def chosen(what: str, name: str, known: Mapping[str, T]) -> T:
    """Return the entry of a name; UsageError naming the known ones."""
    if name not in known:
        raise UsageError(f"unknown {what} {name!r}; known are {', '.join(known)}")
    return known[name]
