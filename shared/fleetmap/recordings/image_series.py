"""Images of each camera by their stamps, paired to frames and read one frame at a time."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from fleetmap.recordings.images import StoredFrame, StoredImage, decode_frame
from fleetmap.recordings.ordering import PAIR_TOLERANCE_NS, ReadLog, forward_only, nearest, pair_stamps
from fleetmap.sensors.samples import CameraFrame, Stamps

T = TypeVar("T")
_DAY_NS = 86_400_000_000_000
F = TypeVar("F", bound="SeriesFrames")  # type: ignore[type-arg]


@dataclass(frozen=True)
class ImageSeries(Generic[T]):
    """One camera's images: stamps (N,), and where each one is stored."""

    stamps_ns: Stamps
    sources: tuple[T, ...]

    def __len__(self) -> int:
        return len(self.sources)

    def take(self, indices: NDArray[np.int64]) -> "ImageSeries[T]":
        """Those at `indices` (K,)."""
        return ImageSeries(self.stamps_ns[indices], tuple(self.sources[int(i)] for i in indices))

    def forward(self, what: str, log: ReadLog) -> "ImageSeries[T]":
        """Those whose stamps increase, as `forward_only`; where days lie between them, those of the largest part."""
        kept = np.flatnonzero(forward_only(self.stamps_ns, what, log))
        parts = np.split(kept, np.flatnonzero(np.diff(self.stamps_ns[kept]) > _DAY_NS) + 1)
        largest = max(parts, key=len)
        if len(parts) > 1:
            detail = f"{len(kept) - len(largest)} of {len(kept)} left out, more than a day from the others; was the clock set?"
            log.note(f"{what}: stamps far apart", detail)
        return self.take(largest)


def pair_images(
    first: ImageSeries[T], second: ImageSeries[T], log: ReadLog, tolerance_ns: int = PAIR_TOLERANCE_NS
) -> tuple[ImageSeries[T], ImageSeries[T]]:
    """Images of two cameras taken at the same moments; those without a partner are noted in `log`."""
    firsts, seconds = pair_stamps(first.stamps_ns, second.stamps_ns, tolerance_ns)
    alone = len(first) + len(second) - 2 * len(firsts)
    if alone:
        detail = f"{alone} of {len(first)} and {len(second)}; {len(firsts)} pairs remain"
        log.note("images without their partner", detail + _apart(first.stamps_ns, second.stamps_ns, tolerance_ns))
    return first.take(firsts), second.take(seconds)


def _apart(first_ns: Stamps, second_ns: Stamps, tolerance_ns: int) -> str:
    """By how much the stamps of two cameras differ, where that is more than the tolerance and what to do; else nothing."""
    if not len(first_ns) or not len(second_ns):
        return ""
    apart_ms = float(np.median(second_ns[nearest(second_ns, first_ns)] - first_ns)) * 1e-6
    if abs(apart_ms) <= tolerance_ns * 1e-6:
        return ""
    advice = "trigger both together, or stamp both by one clock; the stamps of one could be shifted by as much if that is constant"
    return f"; the second is {apart_ms:+.3f} ms from the first in the median, {tolerance_ns * 1e-6:g} ms are allowed: {advice}"


class SeriesFrames(Generic[T]):
    """Frames of paired series of equal length; `load` reads the image of a source with its stamp in ns.

    grey_bits: of left and right images of 16 bits, how many are used.
    """

    def __init__(
        self,
        load: Callable[[T, int], StoredImage],
        left: ImageSeries[T],
        right: ImageSeries[T] | None,
        depth: ImageSeries[T] | None,
    ) -> None:
        self._load = load
        self.left, self.right, self.depth = left, right, depth
        self.grey_bits = 16

    def taken(self, indices: NDArray[np.int64]) -> tuple[ImageSeries[T], ImageSeries[T] | None, ImageSeries[T] | None]:
        """left, right, depth of the frames at indices (K,)."""
        right, depth = (None if series is None else series.take(indices) for series in (self.right, self.depth))
        return self.left.take(indices), right, depth

    def like(self, part: F) -> F:
        """`part`, whose grey images use as many bits as these."""
        part.grey_bits = self.grey_bits
        return part

    def stored(self, index: int) -> StoredFrame:
        """Frame `index` with its images as they are stored."""
        left, right, depth = (
            None if series is None else self._load(series.sources[index], int(series.stamps_ns[index]))
            for series in (self.left, self.right, self.depth)
        )
        assert left is not None
        if self.grey_bits < 16:
            left = replace(left, bits=self.grey_bits)
            right = None if right is None else replace(right, bits=self.grey_bits)
        return StoredFrame(int(self.left.stamps_ns[index]), left, right, depth)

    def frame(self, index: int) -> CameraFrame:
        """Frame `index`, decoded."""
        return decode_frame(self.stored(index))
