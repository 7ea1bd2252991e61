"""Pictures that were set aside come back as they were, however many there are."""

import errno
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import StoreError
from fleetmap.features.patch_align import half_pyramid
from fleetmap.sensors.rectification import RectifiedFrame
from mapserver.drafting import mapped_images
from mapserver.drafting.mapped_images import MappedImageStore
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


def test_a_full_disk_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(mapped_images.os, "posix_fallocate", full)
    with MappedImageStore(tmp_path) as shelf, pytest.raises(StoreError, match="free space"):
        shelf.keep([np.zeros((3, 2))])


def test_a_folder_that_takes_no_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="nowhere"):
        MappedImageStore(tmp_path / "nowhere")
