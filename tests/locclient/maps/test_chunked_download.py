"""Parts: put together in order, bounded, and never believed."""

import pytest

from fleetmap.errors import LinkError, UnreachableError
from fleetmap.messages import PART_BYTES, ChunkRequest, Part, decode_message, encode_message, part_of
from locclient.maps import map_client
from locclient.maps.map_client import ChunkReader
from support.fleet.memory_bus import MemoryBus, MemoryHub

DATA = bytes(range(256)) * 3000  # three parts
WHOLE = PART_BYTES + 5


def answered(*parts: Part) -> ChunkReader:
    """A reader of a server that answers these, whatever is asked."""
    hub, left = MemoryHub(), list(parts)
    MemoryBus(hub).queryable("x", lambda *_: encode_message(left.pop(0)))
    return ChunkReader(MemoryBus(hub), timeout_s=0.01, patience_s=0)


def test_parts_become_the_whole() -> None:
    hub = MemoryHub()
    MemoryBus(hub).queryable("x", lambda _, asked: part_of(DATA, asked))
    MemoryBus(hub).queryable("empty", lambda _, asked: part_of(b"", asked))
    reader = ChunkReader(MemoryBus(hub), timeout_s=0.01, patience_s=0)
    assert reader.read("x", max_bytes=len(DATA)) == DATA
    assert reader.received_bytes == len(DATA)
    assert reader.read("empty", max_bytes=0) == b""
    with pytest.raises(LinkError, match="at most 100"):
        reader.read("x", max_bytes=100)


def test_an_empty_question_asks_for_the_first_part() -> None:
    part = decode_message(part_of(DATA, b""), Part)
    assert (part.total_bytes, part.offset, part.data) == (len(DATA), 0, DATA[:PART_BYTES])
    beyond = decode_message(part_of(DATA, encode_message(ChunkRequest(offset=10**9))), Part)
    assert (beyond.total_bytes, beyond.data) == (len(DATA), b"")
    for nonsense in (b"x", b"\x80\x80", encode_message(Part(total_bytes=1, offset=0, data=b""))[:-1]):
        with pytest.raises(LinkError):
            part_of(DATA, nonsense)


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (Part(total_bytes=WHOLE, offset=0, data=b"01234"), "from 0 on"),
        (Part(total_bytes=WHOLE, offset=PART_BYTES, data=b""), "0 bytes from byte 262144"),
        (Part(total_bytes=WHOLE, offset=PART_BYTES, data=b"0123"), "4 bytes from byte 262144"),
        (Part(total_bytes=WHOLE, offset=PART_BYTES, data=b"0123456"), "got 7 from 262144"),
        (Part(total_bytes=10**6, offset=PART_BYTES, data=b"0"), "has 1000000 bytes"),
    ],
)
def test_nonsense_is_refused(second: Part, words: str) -> None:
    reader = answered(Part(total_bytes=WHOLE, offset=0, data=bytes(PART_BYTES)), second)
    with pytest.raises(LinkError, match=words):
        reader.read("x", max_bytes=WHOLE)


def test_row_15_a_server_that_gives_bytes_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    hub, asked = MemoryHub(), []

    def slow(_: str, question: bytes) -> bytes:
        offset = decode_message(question, ChunkRequest).offset
        asked.append(offset)
        return encode_message(Part(total_bytes=500, offset=offset, data=b"x"))

    MemoryBus(hub).queryable("x", slow)
    with pytest.raises(LinkError, match="1 bytes from byte 0 on of 500"):
        ChunkReader(MemoryBus(hub), timeout_s=0.01, patience_s=0).read("x", max_bytes=500)
    assert asked == [0]
    monkeypatch.setattr(map_client, "PART_BYTES", 1)  # the control: without the rule it goes on
    ChunkReader(MemoryBus(hub), timeout_s=0.01, patience_s=0).read("x", max_bytes=500)
    assert len(asked) == 501


def test_patience_ends() -> None:
    hub, now = MemoryHub(), [0.0]
    bus = MemoryBus(hub)
    asked = []

    def get(key: str, payload: bytes = b"", *, timeout_s: float = 5.0) -> bytes:
        asked.append(key)
        now[0] += timeout_s
        raise UnreachableError(key)

    bus.get = get
    with pytest.raises(UnreachableError):
        ChunkReader(bus, timeout_s=5.0, patience_s=9.0, clock_s=lambda: now[0]).read("x", max_bytes=1)
    assert len(asked) == 2
