"""Caches of the bus service: bytes that were sent last, and which addresses robots of a site may fetch, and as what."""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable

_KEEP_S = 5.0
_MAX_KEPT = 20_000
_ENTRY_BYTES = 200  # what an entry takes beside its bytes, so that empty ones are bounded too


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


class ByteCache:
    """Thread-safe. Holds at most `max_bytes`."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._held: OrderedDict[str, bytes] = OrderedDict()
        self._making: dict[str, threading.Lock] = {}
        self._bytes = 0
        self._lock = threading.Lock()

    @property
    def total_bytes(self) -> int:
        with self._lock:
            return self._bytes

    def get(self, key: str, make: Callable[[], bytes]) -> bytes:
        """The bytes of `key`, made where they are not held; what `make` raises passes through and is not kept.

        One thread makes them, the others that ask meanwhile wait for it: a whole fleet asks for the same tile at once.
        """
        with self._lock:
            data = self._found(key)
            if data is not None:
                return data
            gate = self._making.setdefault(key, threading.Lock())
        with gate:
            with self._lock:
                data = self._found(key)
            if data is not None:
                return data
            try:
                data = make()
            finally:
                with self._lock:
                    self._making.pop(key, None)
                    if data is not None:
                        self._keep(key, data)
            return data

    def _found(self, key: str) -> bytes | None:
        data = self._held.get(key)
        if data is not None:
            self._held.move_to_end(key)
        return data

    def _keep(self, key: str, data: bytes) -> None:
        if key not in self._held and len(data) + _ENTRY_BYTES <= self._max_bytes:
            self._held[key] = data
            self._bytes += len(data) + _ENTRY_BYTES
            while self._bytes > self._max_bytes:
                _, old = self._held.popitem(last=False)
                self._bytes -= len(old) + _ENTRY_BYTES
