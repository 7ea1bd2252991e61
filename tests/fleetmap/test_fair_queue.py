"""Senders are served in turn: one who floods waits for himself, and memory stays bounded."""

import threading
import time
from functools import partial

import zenoh

from fleetmap.bus.fair_queue import SHARED, FairQueue, sender_of
from fleetmap.bus.zenoh_bus import Bus
from support.waiting import eventually


def test_the_sender_stands_in_the_key() -> None:
    assert sender_of("fleetmap/hall/robots/tug-7/health") == "hall/tug-7"
    assert sender_of("fleetmap/hall/live/survey") == SHARED
    assert sender_of("") == SHARED


def test_a_flood_is_in_its_own_way_alone() -> None:
    queue, done = FairQueue("test"), list[str]()
    gate, ended = threading.Event(), threading.Event()
    queue.put("flood", 1, gate.wait)
    for _ in range(1000):
        queue.put("flood", 1, lambda: done.append("flood"))
    queue.put("calm", 1, lambda: (done.append("calm"), ended.set()))
    gate.set()
    assert ended.wait(10)
    assert done.index("calm") <= 1
    queue.close()


def test_what_waits_is_bounded_in_number_and_bytes() -> None:
    queue, gate = FairQueue("test"), threading.Event()
    assert queue.put("a", 1, gate.wait)
    assert eventually(lambda: not queue._jobs)
    assert sum(queue.put("a", 1, lambda: None) for _ in range(1000)) == 64
    assert sum(queue.put("b", 1 << 20, lambda: None) for _ in range(10)) == 2
    assert sum(queue.put(f"r{number}", 1 << 20, lambda: None) for number in range(100)) == 29, "32 MiB in all"
    assert not queue.put("another", 1 << 20, lambda: None)
    assert "another" not in queue._jobs
    gate.set()
    assert eventually(lambda: (queue._jobs, queue._all_bytes, queue._bytes) == ({}, 0, {}))
    queue.close()
    assert not queue.put("a", 1, lambda: None)


def test_a_question_asked_again_is_answered_once() -> None:
    """Otherwise a server that is behind answers those only who do not wait any more, and never catches up."""
    queue, found, gate, ended = FairQueue("test"), list[str](), threading.Event(), threading.Event()
    queue.put("a", 1, gate.wait)
    assert eventually(lambda: not queue._jobs)
    for number in range(100):
        for sender, question in (("a", "x"), ("a", "y"), ("b", "x")):
            job = partial(found.append, f"{sender} {question} {number}")
            assert queue.put(sender, 1, job, question)
        if number < 2:
            queue.put(SHARED, 1, partial(found.append, f"shared {number}"), "x")
    queue.put("c", 1, lambda: None)
    queue.put("a", 1, ended.set)
    gate.set()
    assert ended.wait(10)
    of_robots, shared = (
        ["a x 99", "a y 99", "b x 99"],
        ["shared 0", "shared 1"],
    )  # who is nobody's robot asks for itself
    assert sorted(found) == of_robots + shared
    assert (queue._all_bytes, queue._bytes) == (0, {})
    queue.close()


def test_jobs_of_one_sender_keep_their_order() -> None:
    queue, found, ended = FairQueue("test"), [], threading.Event()
    for number in range(30):
        queue.put("ab"[number % 2], 1, lambda number=number: found.append(number))
    queue.put("a", 1, ended.set)
    queue.put("c", 1, ended.set)
    assert ended.wait(10)
    time.sleep(0.05)
    assert sorted(found, key=lambda n: n % 2) == [*range(0, 30, 2), *range(1, 30, 2)]
    queue.close()


def test_jobs_without_bytes_are_bounded_too() -> None:
    """Under invented names a flood of empty messages would else keep a million of them."""
    queue, gate = FairQueue("test"), threading.Event()
    taken = sum(queue.put(f"robot {n % 10_000}", 0, gate.wait) for n in range(50_000))
    assert taken < 35_000
    gate.set()
    queue.close()


def test_what_comes_beside_a_payload_counts() -> None:
    """An attachment is kept with its message: one byte with a megabyte beside it is a megabyte."""
    gate, begun, heard = threading.Event(), threading.Event(), []

    def listen(key: str, payload: bytes) -> None:
        heard.append(payload)
        begun.set()
        gate.wait(20)

    with Bus("tcp/127.0.0.1:0", is_server=True).open() as server, Bus(server.endpoint).open() as evil:
        server.subscribe("fleetmap/*/robots/*/health", listen)
        first = partial(evil.publish, "fleetmap/hall/robots/r1/health", b"first")
        assert eventually(lambda: first() or begun.wait(0.1), 20)
        before = len(heard)
        send = partial(evil._session.put, congestion_control=zenoh.CongestionControl.BLOCK)  # by default zenoh drops
        for _ in range(20):
            send("fleetmap/hall/robots/r1/health", b"x", attachment=bytes(900_000))
        send("fleetmap/hall/robots/r2/health", b"last", attachment=b"small")
        time.sleep(0.5)
        gate.set()
        assert eventually(lambda: b"last" in heard, 20)
    assert heard[before:].count(b"x") <= 2
