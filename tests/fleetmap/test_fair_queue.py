"""Senders are served in turn: one who floods waits for himself, and memory stays bounded."""

import threading
import time
from collections import deque
from collections.abc import Callable

from fleetmap.bus.fair_queue import SHARED, FairQueue, sender_of


def test_the_sender_stands_in_the_key() -> None:
    assert sender_of("fleetmap/hall/robots/tug-7/health") == "hall/tug-7"
    assert sender_of("fleetmap/hall/blobs/abc") == SHARED
    assert sender_of("") == SHARED


def waits_behind_a_flood(put: Callable[[str, int, Callable[[], None]], object]) -> int:
    """How many jobs of the one who floods are done before that of another, which comes last."""
    done: list[str] = []
    gate, ended = threading.Event(), threading.Event()
    put("flood", 1, gate.wait)
    for _ in range(1000):
        put("flood", 1, lambda: done.append("flood"))
    put("calm", 1, lambda: (done.append("calm"), ended.set()))
    gate.set()
    assert ended.wait(10)
    return done.index("calm")


def test_a_flood_is_in_its_own_way_alone() -> None:
    queue = FairQueue("test")
    assert waits_behind_a_flood(queue.put) <= 1
    queue.close()
    # The control: one queue for all.
    plain: deque[Callable[[], None]] = deque()
    is_open = True

    def run() -> None:
        while is_open:
            if plain:
                plain.popleft()()
            else:
                time.sleep(0.001)

    thread = threading.Thread(target=run)
    thread.start()
    assert waits_behind_a_flood(lambda _, __, job: plain.append(job)) == 1000
    is_open = False
    thread.join()


def test_what_waits_is_bounded_in_number_and_bytes() -> None:
    queue, gate, taken = FairQueue("test"), threading.Event(), 0
    assert queue.put("a", 1, gate.wait)
    while queue._jobs:
        time.sleep(0.001)
    taken = sum(queue.put("a", 1, lambda: None) for _ in range(1000))
    assert taken == 64
    assert sum(queue.put("b", 1 << 20, lambda: None) for _ in range(10)) == 2
    many = sum(queue.put(f"robot {number}", 1 << 20, lambda: None) for number in range(100))
    assert many == 29, "32 MiB in all"
    assert not queue.put("another", 1 << 20, lambda: None)
    assert "another" not in queue._jobs
    gate.set()
    until_s = time.monotonic() + 10
    while queue._jobs and time.monotonic() < until_s:
        time.sleep(0.001)
    time.sleep(0.01)
    assert (queue._all_bytes, queue._bytes) == (0, {})
    queue.close()
    assert not queue.put("a", 1, lambda: None)


def test_jobs_of_one_sender_keep_their_order() -> None:
    queue, found, ended = FairQueue("test"), [], threading.Event()
    for number in range(30):
        queue.put("ab"[number % 2], 1, lambda number=number: found.append(number))
    queue.put("a", 1, ended.set)
    queue.put("c", 1, ended.set)
    assert ended.wait(10)
    time.sleep(0.05)
    assert [n for n in found if n % 2] == list(range(1, 30, 2))
    assert [n for n in found if n % 2 == 0] == list(range(0, 30, 2))
    queue.close()
