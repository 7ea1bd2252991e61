"""Download of bytes in chunks over the bus: resumed where it broke off, patient with an absent server."""

import time
from collections.abc import Callable

from fleetmap.bus import Bus, RobotQuestions
from fleetmap.errors import LinkError, UnreachableError
from fleetmap.messages import PART_BYTES, ChunkRequest, Part, decode_message, encode_message

_RETRY_S = 0.2
_MAX_INCOMPLETE = 8


class ChunkReader:
    """Reads what a server sends in chunks. Chunks of an incomplete download are kept over errors and calls."""

    def __init__(
        self,
        bus: Bus | RobotQuestions,
        *,
        timeout_s: float,
        patience_s: float,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """timeout_s: for each chunk. patience_s: without any chunk, after which a read gives up; a later one resumes it."""
        self._bus = bus
        self._timeout_s = timeout_s
        self._patience_s = patience_s
        self._clock_s = clock_s
        self._incomplete: dict[str, bytearray] = {}
        self.received_bytes = 0

    def read(self, key: str, *, max_bytes: int) -> bytes:
        """All bytes under `key`, not yet verified.

        Raises UnreachableError where nobody answers, LinkError for a refusal, for more than max_bytes, for parts that are not full
        and for nonsense.
        """
        data = self._incomplete.pop(key, bytearray())
        try:
            while (chunk := self._chunk(key, len(data), max_bytes)).total_bytes > len(data) + len(chunk.data):
                data += chunk.data
            return bytes(data + chunk.data)
        except UnreachableError:
            self._incomplete[key] = data
            while len(self._incomplete) > _MAX_INCOMPLETE:
                self._incomplete.pop(next(iter(self._incomplete)))
            raise

    def _chunk(self, key: str, offset: int, max_bytes: int) -> Part:
        chunk = self._request(key, encode_message(ChunkRequest(offset=offset)))
        self.received_bytes += len(chunk.data)
        if chunk.total_bytes > max_bytes:
            raise LinkError(f"{key} has {chunk.total_bytes} bytes where at most {max_bytes} are expected")
        if chunk.offset != offset or offset + len(chunk.data) > chunk.total_bytes:
            raise LinkError(f"{key}: asked from byte {offset} on, got {len(chunk.data)} from {chunk.offset} on")
        # Fewer bytes at a time would let whoever answers keep a robot busy for ever: so a part must come within each patience.
        if len(chunk.data) < min(PART_BYTES, chunk.total_bytes - offset):
            raise LinkError(
                f"{key}: {len(chunk.data)} bytes from byte {offset} on of {chunk.total_bytes}, where a part has {PART_BYTES}; "
                "do both sides run the same fleetmap, and is it the server that answers?"
            )
        return chunk

    def _request(self, key: str, request: bytes) -> Part:
        """Repeats the request until it is answered or patience ends. Raises UnreachableError, or LinkError for a refusal."""
        deadline_s = self._clock_s() + self._patience_s
        while True:
            try:
                return decode_message(self._bus.get(key, request, timeout_s=self._timeout_s), Part)
            except UnreachableError:
                if self._clock_s() >= deadline_s:
                    raise
                time.sleep(_RETRY_S)
