"""A cache of bytes, bounded in size: the least recently used go first."""

import threading
from collections import OrderedDict
from collections.abc import Callable

_ENTRY_BYTES = 200  # what an entry takes beside its bytes, so that empty ones are bounded too


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
        """What is held, the entries' own size included."""
        with self._lock:
            return self._bytes

    def get(self, key: str, make: Callable[[], bytes]) -> bytes:
        """The bytes of `key`, made where they are not held; what `make` raises passes through and is not kept.

        One thread makes them, the others that ask meanwhile wait for it: a whole fleet asks for the same patch at once.
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
