"""What was used last is kept, and no more than the limit."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from mapserver.serving.caches import ByteCache


def test_the_least_recently_used_go_first() -> None:
    made: list[str] = []

    def make(key: str) -> bytes:
        made.append(key)
        return key.encode() * 100

    held = ByteCache(1000)
    for key in "abcab":
        assert held.get(key, lambda key=key: make(key)) == key.encode() * 100
    assert made == ["a", "b", "c"]
    held.get("d", lambda: make("d"))
    held.get("b", lambda: make("b"))
    held.get("c", lambda: make("c"))
    assert made == ["a", "b", "c", "d", "c"]
    assert held.total_bytes <= 1000


def test_what_is_larger_than_the_limit_and_what_fails_is_not_kept() -> None:
    held = ByteCache(1000)
    assert len(held.get("x", lambda: bytes(2000))) == 2000
    with pytest.raises(ZeroDivisionError):
        held.get("y", lambda: bytes(1 // 0))
    assert held.total_bytes == 0
    for number in range(100):
        held.get(str(number), lambda: b"")
    assert held.total_bytes <= 1000


def test_what_many_ask_for_at_once_is_made_once() -> None:
    """Also where making it fails at first: the next one tries."""
    held, begun, made = ByteCache(1000), threading.Event(), []

    def make() -> bytes:
        made.append(threading.get_ident())
        begun.wait(5)
        if len(made) == 1:
            raise LookupError
        return b"tile"

    with ThreadPoolExecutor(8) as pool:
        asked = [pool.submit(held.get, "a", make) for _ in range(8)]
        while not made:
            time.sleep(0.001)
        begun.set()
        failed = sum(answer.exception() is not None for answer in asked)
        answers = [answer.result() for answer in asked if answer.exception() is None]
    assert failed == 1
    assert answers == [b"tile"] * 7
    assert len(made) == 2
