"""One night at a time for each site: a lock that a dead process does not hold."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fleetmap.errors import BusyError, StoreError


@contextmanager
def only_one(store: Path, site: str) -> Iterator[None]:
    """Holds the site's night for the block; raises BusyError where another process does, StoreError where the disk refuses."""
    path = store / f"nightly-{site}.lock"
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise StoreError(f"{path} cannot be made ({error.strerror}); check the store's rights and space") from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BusyError(f"another nightly run of site {site} holds {path}; it ends by itself, try later") from error
        yield
    finally:
        os.close(descriptor)
