"""Pictures that were set aside come back as they were, however many there are. Threads work in order, and not far ahead."""

import errno
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from fleetmap.errors import StoreError
from fleetmap.features.patch_align import half_pyramid
from fleetmap.sensors.rectification import RectifiedFrame
from mapserver.drafting import mapped_images
from mapserver.drafting.mapped_images import MappedImageStore
from mapserver.drafting.worker import Threads, open_executor, read_ahead
from mapserver.survey.state import Pictures


def pictures(number: int) -> Pictures:
    rng = np.random.default_rng(number)
    left, right = (rng.integers(0, 256, (24, 32), dtype=np.uint8) for _ in range(2))
    depth = rng.uniform(1, 9, (24, 32)).astype(np.float32) if number % 3 == 0 else None
    frame = RectifiedFrame(number, left, None if number % 3 == 0 else right, depth)
    return Pictures(frame, half_pyramid(left))


def test_pictures_come_back_to_the_bit(tmp_path: Path) -> None:
    """More of them than are held in memory, asked for in another order."""
    with MappedImageStore(tmp_path) as shelf:
        numbers = [shelf.put(pictures(n)) for n in range(120)]
        for n in [*range(119, -1, -7), 0, 1, 119]:
            back, wanted = shelf.get(numbers[n]), pictures(n)
            assert back.frame.stamp_ns == n
            for own, theirs in zip(back.pyramid, wanted.pyramid, strict=True):
                np.testing.assert_array_equal(own, theirs)
            for name in ("right", "disparity_px"):
                own, theirs = getattr(back.frame, name), getattr(wanted.frame, name)
                assert (own is None) == (theirs is None)
                if theirs is not None:
                    np.testing.assert_array_equal(own, theirs)
                    assert own.flags.writeable
    assert list(tmp_path.iterdir()) == []


def test_features_stay_what_they_are_out_of_memory_and_after_the_store(tmp_path: Path) -> None:
    """Arrays of several segments, one larger than a segment, an empty one."""
    rng, segment = np.random.default_rng(1), mapped_images._SEGMENT_BYTES
    given = [rng.integers(0, 256, (n, 32), np.uint8) for n in (7, segment // 32 - 100, 200, 0, segment // 16, 3)]
    given += [rng.uniform(-1, 1, (5, 3)), rng.uniform(-1, 1, (6, 2)).astype(np.float32)]
    with MappedImageStore(tmp_path) as shelf:
        kept = shelf.keep(given)
        shelf.release()
        assert list(tmp_path.iterdir()) == []
    for own, theirs in zip(kept, given, strict=True):
        np.testing.assert_array_equal(own, theirs)
        assert own.dtype == theirs.dtype
        assert own.flags.c_contiguous
        assert own.flags.writeable
        assert own.flags.aligned


def test_threads_get_their_own_pictures_back(tmp_path: Path) -> None:
    with MappedImageStore(tmp_path) as shelf, ThreadPoolExecutor(4) as pool:
        numbers = list(pool.map(lambda n: shelf.put(pictures(n)), range(200)))
        assert sorted(numbers) == list(range(200))
        for n, number in enumerate(numbers):
            np.testing.assert_array_equal(shelf.get(number).frame.left, pictures(n).frame.left)


def test_what_was_read_leaves_memory(tmp_path: Path) -> None:
    """As the kernel counts it: of 256 MB that were put and read, less than half is held."""
    rng = np.random.default_rng(0)
    with MappedImageStore(tmp_path) as shelf:
        for number in range(256):
            left = rng.integers(0, 256, (1024, 768), np.uint8)
            shelf.put(Pictures(RectifiedFrame(number, left, None, None), half_pyramid(left)))
        for number in range(256):
            shelf.get(number).frame.left.sum()
        lines = Path("/proc/self/smaps").read_text().split("VmFlags")
        held_kb = sum(int(part.split("Rss:")[1].split()[0]) for part in lines if str(tmp_path) in part)
    assert 0 < held_kb < 128 * 1024


def test_a_full_disk_is_said(tmp_path: Path, monkeypatch) -> None:
    full = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    monkeypatch.setattr(mapped_images.os, "posix_fallocate", full)
    with MappedImageStore(tmp_path) as shelf, pytest.raises(StoreError, match="free space"):
        shelf.keep([np.zeros((3, 2))])


def test_a_folder_that_takes_no_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="nowhere"):
        MappedImageStore(tmp_path / "nowhere")


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
