"""Everything that can go wrong with what comes from outside: files, network, users.

FleetmapError                      exit status 3
├── UsageError                     exit status 2: a command line or setting that cannot be right
│   └── StateError                 what is asked for does not fit the state that something is in
├── RecordingError                 a recording that cannot be read or contradicts itself
│   └── CalibrationError           missing or impossible calibration
├── SurveyError                    a recording from which no correct map can be made
├── MapFormatError                 tile, manifest or vocabulary bytes that are not what they claim
│   └── NewerFormatError           made by a newer fleetmap; names the version that is needed
├── StoreError                     a store that cannot be opened, read or written
├── LinkError                      the other side cannot be reached, refuses or answers nonsense
│   ├── UnreachableError           nobody answered in time; asking again later may help
│   └── UntrustedError             signed lists refuse it; begins with rollback:, freeze:, signature: or size:
├── GateRefusedError               exit status 4: the draft is not good enough to publish
└── BusyError                      exit status 5: another process is at the same work

The message holds the offending value and the next step. Caught only in the commands' `main` and the HTTP API.
"I do not know where I am" is a value with a status, never one of these.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal


class FleetmapError(Exception):
    """Base of the tree; `exit_status` is what a command line ends with."""

    exit_status = 3


class UsageError(FleetmapError):
    """A command line or a setting that cannot be right."""

    exit_status = 2


class StateError(UsageError):
    """Something that does not fit the state of what it is asked of, such as promoting a draft."""


class RecordingError(FleetmapError):
    """A recording that cannot be read or contradicts itself."""


class CalibrationError(RecordingError):
    """Missing or impossible calibration."""


class SurveyError(FleetmapError):
    """A recording from which no correct map can be made."""


class MapFormatError(FleetmapError):
    """Tile, manifest or vocabulary bytes that are not what they claim to be."""


class NewerFormatError(MapFormatError):
    """Bytes or a store made by a newer fleetmap than this one."""


class StoreError(FleetmapError):
    """A store that cannot be opened, read or written."""


class LinkError(FleetmapError):
    """The other side cannot be reached, refuses or answers nonsense."""


class UnreachableError(LinkError):
    """Nobody answered in time; asking again later may help."""


class UntrustedError(LinkError):
    """Something that the signed lists of maps do not allow. The message begins with the kind of attack that it would be."""

    def __init__(self, kind: Literal["rollback", "freeze", "signature", "size"], words: object) -> None:
        self.kind, self.words = kind, str(words)
        super().__init__(f"{kind}: {words}")


class GateRefusedError(FleetmapError):
    """The draft is not good enough to publish."""

    exit_status = 4


class BusyError(FleetmapError):
    """Another process is at the same work; it ends by itself."""

    exit_status = 5


@contextmanager
def disk_errors(fault: object, advice: str, kind: type[FleetmapError] = StoreError) -> Iterator[None]:
    """Raises `kind` in the place of an OSError of the block: "FAULT (the system's reason); ADVICE"."""
    try:
        yield
    except OSError as error:
        raise kind(f"{fault} ({error.strerror}); {advice}") from error
