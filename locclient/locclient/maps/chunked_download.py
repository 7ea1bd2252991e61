"""Bytes in parts over the bus: nothing that came is asked for twice, and an absent server is waited for."""

import time
from collections.abc import Callable

from fleetmap.bus import Bus
from fleetmap.errors import LinkError, UnreachableError
from fleetmap.messages import ChunkRequest, Part, decode_message, encode_message

_RETRY_S = 0.2
_MAX_BEGUN = 8


class ChunkReader:
    """Reads what a server sends in parts. What was begun is kept until it is whole, over errors and calls."""

    def __init__(
        self, bus: Bus, *, timeout_s: float, patience_s: float, clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        """timeout_s: for each part. patience_s: without any part, after which a read gives up (and can be taken up again)."""
        self._bus = bus
        self._timeout_s = timeout_s
        self._patience_s = patience_s
        self._clock_s = clock_s
        self._begun: dict[str, bytearray] = {}
        self.received_bytes = 0

    def read(self, key: str, *, max_bytes: int) -> bytes:
        """All bytes under `key`, not yet verified.

        Raises UnreachableError where nobody answers, LinkError for a refusal, for more than max_bytes and for nonsense.
        """
        data = self._begun.pop(key, bytearray())
        try:
            while (part := self._part(key, len(data), max_bytes)).total_bytes > len(data) + len(part.data):
                data += part.data
            return bytes(data + part.data)
        except UnreachableError:
            self._begun[key] = data
            while len(self._begun) > _MAX_BEGUN:
                self._begun.pop(next(iter(self._begun)))
            raise

    def _part(self, key: str, offset: int, max_bytes: int) -> Part:
        part = self._patiently(key, encode_message(ChunkRequest(offset=offset)))
        self.received_bytes += len(part.data)
        if part.total_bytes > max_bytes:
            raise LinkError(f"{key} has {part.total_bytes} bytes where at most {max_bytes} are expected")
        if part.offset != offset or offset + len(part.data) > part.total_bytes:
            raise LinkError(f"{key}: asked from byte {offset} on, got {len(part.data)} from {part.offset} on")
        if not part.data and part.total_bytes > offset:
            raise LinkError(f"{key}: nothing from byte {offset} on, though there are {part.total_bytes}")
        return part

    def _patiently(self, key: str, question: bytes) -> Part:
        """Asks until somebody answers or patience ends. Raises UnreachableError, or LinkError for a refusal."""
        deadline_s = self._clock_s() + self._patience_s
        while True:
            try:
                return decode_message(self._bus.get(key, question, timeout_s=self._timeout_s), Part)
            except UnreachableError:
                if self._clock_s() >= deadline_s:
                    raise
                time.sleep(_RETRY_S)
