"""Pictures in temporary files: of keyframes, which keeps a long survey small, and of frames, which are decoded once.

What is found in keyframes lies in a file too, a tenth of a megabyte for each: it is read where it lies, and leaves memory between stages.
"""

import mmap
import os
import tempfile
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import StoreError, disk_errors
from fleetmap.features.patch_align import half_pyramid
from fleetmap.geometry import AnyArray
from fleetmap.numerics.free_memory import give_back_free_memory
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import CameraFrame
from mapserver.survey.keyframes.keyframes import MemoryImageStore, Pictures

if TYPE_CHECKING:
    import hashlib

    from fleetmap.recordings import FrameSource, StoredFrame

_HELD = 48  # more than the keyframes that one is compared with
_SEGMENT_BYTES = 1 << 24  # of the file that features lie in; a keyframe has more than a hundred in it
_ALIGNED_BYTES = 64
_KEPT_BYTES = 1_000_000_000  # all that an examination decodes of a pair of 1280 x 720


@dataclass(frozen=True, slots=True)
class _Place:
    stamp_ns: int
    arrays: tuple[tuple[int, np.dtype[Any], tuple[int, ...]] | None, ...]  # left, right, third: offset, type, shape


class _ArrayFile:
    """Arrays one after the other in an unnamed file in `folder`, which the system removes with the process."""

    def __init__(self, folder: Path) -> None:
        with disk_errors(f"{folder} takes no temporary file", "check its rights and space"):
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  closed with its owner
        self.size = 0

    def close(self) -> None:
        self._file.close()

    def put(self, stamp_ns: int, arrays: tuple[AnyArray | None, ...]) -> _Place:
        """Appends what there is; OSError where that does not go."""
        return _Place(stamp_ns, tuple(self._write(array) for array in arrays))

    def get(self, place: _Place) -> list[Any]:
        """The arrays again, each its own memory: writable, so that numba compiles no second version for it."""
        return [None if part is None else self._read(*part) for part in place.arrays]

    def _write(self, array: AnyArray | None) -> tuple[int, np.dtype[Any], tuple[int, ...]] | None:
        if array is None:
            return None
        offset, data, done = self.size, np.ascontiguousarray(array).data.cast("B"), 0
        while done < len(data):
            done += os.pwrite(self._file.fileno(), data[done:], offset + done)
        self.size += len(data)
        return offset, array.dtype, array.shape

    def _read(self, offset: int, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Any:
        array = np.empty(shape, dtype)
        if os.preadv(self._file.fileno(), [array.data.cast("B")], offset) != array.nbytes:
            raise StoreError("the survey's temporary pictures were cut short; is the disk full?")
        return array


class _MappedFile:
    """Arrays in an unnamed file in `folder` that are read where they lie; the system removes it with the last of them."""

    def __init__(self, folder: Path) -> None:
        with disk_errors(f"{folder} takes no temporary file", "check its rights and space"):
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  closed with its owner
        self._segments: list[mmap.mmap] = []
        self._size, self._used = 0, 0  # of the file, and of its last segment

    def close(self) -> None:
        self._file.close()

    def put(self, array: AnyArray) -> AnyArray:
        """The same array in the file; OSError where that has no room."""
        data = np.ascontiguousarray(array)
        if not data.size:
            return data
        if not self._segments or self._used + data.nbytes > len(self._segments[-1]):
            length = -(-max(data.nbytes, _SEGMENT_BYTES) // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY
            # Room is taken before it is written to: a full disk would end the process then.
            os.posix_fallocate(self._file.fileno(), self._size, length)
            self._segments.append(mmap.mmap(self._file.fileno(), length, offset=self._size))
            self._size, self._used = self._size + length, 0
        kept = np.frombuffer(self._segments[-1], data.dtype, data.size, self._used).reshape(data.shape)
        kept[...] = data
        self._used += -(-data.nbytes // _ALIGNED_BYTES) * _ALIGNED_BYTES
        return kept

    def release(self) -> None:
        """Takes the file out of this process's memory; what is read again comes back from the system's own, or from the disk."""
        for segment in self._segments:
            segment.madvise(mmap.MADV_DONTNEED)


class ImageSpill:
    """An ImageStore over temporary files in `folder`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file, self._features = _ArrayFile(folder), _MappedFile(folder)
        self._places: list[_Place] = []
        self._held: OrderedDict[int, Pictures] = OrderedDict()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._file.close()
        self._features.close()

    def put(self, pictures: Pictures) -> int:
        frame, number = pictures.frame, len(self._places)
        parts = (frame.left, frame.right, frame.disparity_px)
        with disk_errors(f"picture {number} of the survey cannot be set aside", "make space beside the store"):
            self._places.append(self._file.put(frame.stamp_ns, parts))
        self._hold(number, pictures)
        return number

    def get(self, number: int) -> Pictures:
        if number not in self._held:
            place = self._places[number]
            left, right, disparity = self._file.get(place)
            self._hold(number, Pictures(RectifiedFrame(place.stamp_ns, left, right, disparity), half_pyramid(left)))
        self._held.move_to_end(number)
        return self._held[number]

    def keep(self, arrays: Sequence[AnyArray]) -> list[AnyArray]:
        with disk_errors("what a keyframe shows cannot be set aside", "make space beside the store"):
            return [self._features.put(array) for array in arrays]

    def release(self) -> None:
        self._features.release()
        give_back_free_memory()

    def another(self) -> "ImageSpill":
        return ImageSpill(self._folder)

    def __reduce__(self) -> tuple[type[MemoryImageStore], tuple[()]]:
        """As what an empty one is in another process, which need not have the folder."""
        return MemoryImageStore, ()

    def _hold(self, number: int, pictures: Pictures) -> None:
        self._held[number] = pictures
        while len(self._held) > _HELD:
            self._held.popitem(last=False)


class KeptFrames:
    """Frames of another source. Those that are decoded while `keeps` holds are decoded once: a temporary file in `folder` has them."""

    def __init__(self, source: "FrameSource", folder: Path) -> None:
        self._source, self._folder = source, folder
        self._file: _ArrayFile | None = None
        self._places: dict[int, _Place] = {}
        self.keeps = True

    def stored(self, index: int) -> "StoredFrame":
        return self._source.stored(index)

    def frame(self, index: int) -> CameraFrame:
        if self._file is not None and index in self._places:
            place = self._places[index]
            return CameraFrame(place.stamp_ns, *self._file.get(place))
        frame = self._source.frame(index)
        if self.keeps:
            self._keep(index, frame)
        return frame

    def _keep(self, index: int, frame: CameraFrame) -> None:
        try:
            self._file = self._file or _ArrayFile(self._folder)
            self._places[index] = self._file.put(frame.stamp_ns, (frame.left, frame.right, frame.depth_m))
            self.keeps = self._file.size < _KEPT_BYTES
        except (OSError, StoreError):  # no room: what is not kept is decoded again
            self.keeps = False

    def part(self, indices: NDArray[np.int64]) -> "FrameSource":
        """See FrameSource; it decodes them again."""
        return self._source.part(indices)

    def hash_into(self, digest: "hashlib._Hash") -> None:
        self._source.hash_into(digest)

    def close(self) -> None:
        self._source.close()
        if self._file is not None:
            self._file.close()
