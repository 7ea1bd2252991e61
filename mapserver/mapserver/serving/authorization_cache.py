"""Recent answers of the store on which addresses robots of a site may fetch, and as what."""

import threading
import time
from collections.abc import Callable

_KEEP_S = 5.0
_MAX_KEPT = 20_000


class AuthorizationCache:
    """Thread-safe. A whole fleet asks for parts of the same blobs: the store is asked once in some seconds.

    Only what may be fetched is remembered, so that a version is served as soon as it is published; what `gc` took away is
    refused after these seconds, if its bytes were still in memory.
    """

    def __init__(self, ask: Callable[[str, str], str | None], clock_s: Callable[[], float] = time.monotonic) -> None:
        """ask: the kind of an address at a site, as `MapStore.served_kind`."""
        self._ask, self._clock_s = ask, clock_s
        self._known: dict[tuple[str, str], tuple[str, float]] = {}
        self._lock = threading.Lock()

    def get(self, sha256: str, site: str) -> str | None:
        """The kind, None for what robots of this site may not fetch; errors as of `ask`."""
        now_s = self._clock_s()
        with self._lock:
            kind, until_s = self._known.get((sha256, site), ("", 0.0))
        if now_s < until_s:
            return kind
        found = self._ask(sha256, site)
        with self._lock:
            if found is None:
                self._known.pop((sha256, site), None)
            else:
                if len(self._known) >= _MAX_KEPT:
                    self._known.clear()
                self._known[sha256, site] = found, now_s + _KEEP_S
        return found
