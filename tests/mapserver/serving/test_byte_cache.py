"""What was used last is kept, and no more than the limit."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from mapserver.serving.bus_service import ByteCache


def test_the_least_recently_used_go_first_and_nothing_is_kept_beyond_the_limit() -> None:
    read: list[str] = []

    def blob(key: str) -> bytes:
        read.append(key)
        if key == "missing":
            raise LookupError
        return b"" if key.startswith("empty") else key.encode() * (2000 if key == "x" else 100)

    held = ByteCache(1000, blob)
    for key in "abcabdbc":
        assert held.get(key) == key.encode() * 100
    assert read == ["a", "b", "c", "d", "c"]
    assert len(held.get("x")) == 2000
    with pytest.raises(LookupError):
        held.get("missing")
    for number in range(100):
        held.get(f"empty {number}")
    assert 0 < held.total_bytes() <= 1000


def test_what_many_ask_for_at_once_is_read_once() -> None:
    """Also where reading it fails at first: the next one tries."""
    begun, read = threading.Event(), []

    def blob(key: str) -> bytes:
        read.append(key)
        begun.wait(5)
        if len(read) == 1:
            raise LookupError
        return b"tile"

    held = ByteCache(1000, blob)
    with ThreadPoolExecutor(8) as pool:
        asked = [pool.submit(held.get, "a") for _ in range(8)]
        while not read:
            time.sleep(0.001)
        begun.set()
        failed = sum(answer.exception() is not None for answer in asked)
        answers = [answer.result() for answer in asked if answer.exception() is None]
    assert (failed, answers, len(read)) == (1, [b"tile"] * 7, 2)


def test_nobody_waits_for_other_bytes() -> None:
    """An object store that answers slowly stops only those who ask for the same."""
    begun, slow = threading.Event(), threading.Event()

    def blob(key: str) -> bytes:
        if key == "slow":
            begun.set()
            assert slow.wait(20)
        return key.encode()

    held = ByteCache(1000, blob)
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(held.get, "slow")
        assert begun.wait(20)
        assert [held.get(key) for key in ("known", "known")] == [b"known"] * 2
        slow.set()
        assert asked.result() == b"slow"
