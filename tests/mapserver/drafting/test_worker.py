"""Threads work in order, and not far ahead."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from mapserver.drafting.worker import Threads, open_executor, read_ahead
from mapserver.survey.executor import in_batches


def _blas_threads(*_: object) -> list[int]:
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


def test_linear_algebra_has_no_threads_beside_those_of_a_survey() -> None:
    """A program that uses the library may have loaded it with any number of threads, and gets them back."""
    with threadpool_limits(3, user_api="blas"):
        with open_executor(2, None) as executor:
            there = next(iter(executor.map(_blas_threads, 0, [()])))
        assert there
        assert set(there) == {1}
        assert set(_blas_threads()) == {3}


def test_results_come_in_order_and_work_does_not_run_far_ahead() -> None:
    begun: list[int] = []

    def slow(shared: int, batch: int) -> int:
        begun.append(batch)
        time.sleep(0.002 * (batch % 3))
        return shared + batch

    with ThreadPoolExecutor(2) as pool:
        found = Threads(pool, 2).map(slow, 100, range(30))
        first = next(found)
        assert len(begun) <= 6
        assert [first, *found] == [100 + n for n in range(30)]


def test_an_error_in_a_thread_comes_where_its_result_would() -> None:
    def fails(_: None, batch: int) -> int:
        if batch == 2:
            raise ValueError("two")
        return batch

    with ThreadPoolExecutor(2) as pool:
        found = Threads(pool, 2).map(fails, None, range(5))
        assert [next(found), next(found)] == [0, 1]
        with pytest.raises(ValueError, match="two"):
            next(found)


def test_reading_ahead_keeps_order_and_errors() -> None:
    used: list[int] = []

    def numbers() -> Iterator[int]:
        for number in range(8):
            used.append(threading.get_ident())
            yield number
        raise ValueError("the end is damaged")

    found = []
    with pytest.raises(ValueError, match="damaged"):
        for number in read_ahead(numbers()):
            found.append(number)  # noqa: PERF402
    assert found == list(range(8))
    assert threading.get_ident() not in used
    early = read_ahead(iter(range(100)))
    assert next(early) == 0
    early.close()  # type: ignore[attr-defined]


def test_batches_keep_everything() -> None:
    assert in_batches([1, 2, 3, 4, 5], 2) == [[1, 2], [3, 4], [5]]
    assert in_batches([], 2) == []
