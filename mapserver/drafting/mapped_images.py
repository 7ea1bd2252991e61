"""Pictures and features of keyframes in a memory-mapped temporary file: long surveys do not fit in memory."""

import mmap
import os
import tempfile
import threading
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fleetmap.errors import StoreError, disk_errors
from fleetmap.free_memory import give_back_free_memory
from fleetmap.geometry import AnyArray
from fleetmap.sensors.samples import CameraFrame
from mapserver.survey.state import ImageStore, Pictures

if TYPE_CHECKING:
    from fleetmap.recordings import FrameSource

_HELD = 64  # keyframes whose pictures stay in memory: more than are compared with one keyframe
_SEGMENT_BYTES, _SEGMENTS_HELD = 1 << 24, 4  # of the file; written segments leave memory
_KEPT_BYTES = 1_000_000_000  # the first minute of a pair of 752 x 480 at 20 Hz
_ALIGNED_BYTES = 64


class MappedImageStore(ImageStore, AbstractContextManager["MappedImageStore"]):
    """A store in an unnamed file in `folder`, deleted by the system with the process. Methods may be called from any thread."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with disk_errors(f"{folder} accepts no temporary file", "check its rights and space"):
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  closed with its owner
        self._lock = threading.Lock()
        self._segments: list[mmap.mmap] = []
        self._size, self._used = 0, 0  # of the file, and of its last segment
        self._pictures: list[Pictures] = []
        self._read: set[int] = set()  # pictures since the last release

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def put(self, pictures: Pictures) -> int:
        """See ImageStore."""
        frame = pictures.frame
        with disk_errors("a temporary picture cannot be stored", "free space beside the store"), self._lock:
            left, half, quarter = (self._mapped(level) for level in pictures.pyramid)
            right, disparity = (None if a is None else self._mapped(a) for a in (frame.right, frame.disparity_px))
            kept = replace(frame, left=left, right=right, disparity_px=disparity)
            self._pictures.append(Pictures(kept, (left, half, quarter)))
            number = len(self._pictures) - 1
        self.note(number)
        return number

    def get(self, number: int) -> Pictures:
        """See ImageStore."""
        self.note(number)
        return self._pictures[number]

    def keep(self, arrays: Sequence[AnyArray]) -> list[AnyArray]:
        """See ImageStore."""
        with disk_errors("temporary features cannot be stored", "free space beside the store"), self._lock:
            return [self._mapped(array) for array in arrays]

    def release(self) -> None:
        """See ImageStore."""
        self._leave_memory()
        give_back_free_memory()

    def apart(self) -> "MappedImageStore":
        """See ImageStore."""
        return MappedImageStore(self._folder)

    def __reduce__(self) -> tuple[type[ImageStore], tuple[()]]:
        """Pickle as an empty in-memory store: another process may lack the folder."""
        return ImageStore, ()

    def note(self, number: int) -> None:
        """Record a read; after a number of reads the file leaves memory."""
        self._read.add(number)
        if len(self._read) > _HELD:
            self._leave_memory()

    def _leave_memory(self) -> None:
        """Unmap the file from this process; later reads come from the system's cache or the disk."""
        self._read = set()
        for segment in self._segments:
            segment.madvise(mmap.MADV_DONTNEED)

    def _mapped(self, array: AnyArray) -> AnyArray:
        """Return the same array in the file; OSError if the disk is full."""
        data = np.ascontiguousarray(array)
        if not data.size:
            return data
        if not self._segments or self._used + data.nbytes > len(self._segments[-1]):
            length = -(-max(data.nbytes, _SEGMENT_BYTES) // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY
            # Space is allocated before writing: a full disk would kill the process during a mapped write.
            os.posix_fallocate(self._file.fileno(), self._size, length)
            self._segments.append(mmap.mmap(self._file.fileno(), length, offset=self._size))
            self._size, self._used = self._size + length, 0
            if len(self._segments) % _SEGMENTS_HELD == 0:
                self._leave_memory()
        kept = np.frombuffer(self._segments[-1], data.dtype, data.size, self._used).reshape(data.shape)
        os.pwrite(self._file.fileno(), data.data, self._size - len(self._segments[-1]) + self._used)  # no fault a page
        self._used += -(-data.nbytes // _ALIGNED_BYTES) * _ALIGNED_BYTES
        return kept


class KeptFrames:
    """Frames of another source, each decoded once: stored in a temporary file in `folder`, up to a GB."""

    def __init__(self, source: "FrameSource", folder: Path) -> None:
        self.source, self._store = source, MappedImageStore(folder)
        self.stored, self.part, self.hash_into = source.stored, source.part, source.hash_into
        self._frames: dict[int, CameraFrame] = {}
        self._left_bytes = _KEPT_BYTES

    def frame(self, index: int) -> CameraFrame:
        """See FrameSource."""
        if index in self._frames:
            self._store.note(index)
            return self._frames[index]
        frame = self.source.frame(index)
        if self._left_bytes > 0:
            try:
                self._frames[index] = self._kept(frame)
            except StoreError:  # disk full: the frame is decoded again next time
                self._left_bytes = 0
        return frame

    def _kept(self, frame: CameraFrame) -> CameraFrame:
        images = (frame.left, frame.right, frame.depth_m)
        left, right, depth_m = (None if image is None else self._store.keep([image])[0] for image in images)
        self._left_bytes -= sum(image.nbytes for image in images if image is not None)
        others = tuple(None if other is None else self._kept(other) for other in frame.others)
        kept: dict[str, Any] = {"left": left, "right": right, "depth_m": depth_m}
        return replace(frame, **kept, others=others)

    def close(self) -> None:
        """See FrameSource."""
        self.source.close()
        self._store.__exit__()
