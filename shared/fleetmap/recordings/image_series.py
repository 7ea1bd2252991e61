"""Images of each camera by stamp, paired to frames and read one frame at a time."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Generic, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.recordings.images import StoredFrame, StoredImage, decode_depth, decode_frame
from fleetmap.recordings.ordering import (
    DEPTH_TOLERANCE_NS,
    PAIR_TOLERANCE_NS,
    ReadLog,
    forward_only,
    nearest,
    pair_stamps,
)
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, Stamps

T = TypeVar("T")
SILENT_NS = 500_000_000  # a camera without images for longer is silent
_DAY_NS = 86_400_000_000_000


@dataclass(frozen=True)
class ImageSeries(Generic[T]):
    """One camera's images: stamps (N,), and the storage location of each."""

    stamps_ns: Stamps
    sources: tuple[T, ...]

    def __len__(self) -> int:
        return len(self.sources)

    def take(self, indices: NDArray[np.int64]) -> "ImageSeries[T]":
        """Images at `indices` (K,)."""
        return ImageSeries(self.stamps_ns[indices], tuple(self.sources[int(i)] for i in indices))

    def forward(self, what: str, log: ReadLog) -> "ImageSeries[T]":
        """Images with increasing stamps, as `forward_only`; if days lie between them, those of the largest part."""
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
    """Pair the images of two cameras by time; those without a partner are noted in `log`."""
    firsts, seconds = pair_stamps(first.stamps_ns, second.stamps_ns, tolerance_ns)
    alone = len(first) + len(second) - 2 * len(firsts)
    if alone:
        detail = f"{alone} of {len(first)} and {len(second)}; {len(firsts)} pairs remain"
        if len(first) and len(second):
            both_ns = first.stamps_ns[
                slice(*first.stamps_ns.searchsorted([second.stamps_ns[0], second.stamps_ns[-1] + 1]))
            ]
            shared_ns = both_ns if len(both_ns) else first.stamps_ns
            apart_ns = second.stamps_ns[nearest(second.stamps_ns, shared_ns)] - shared_ns
            # Half a period apart the nearest is sometimes the one before, sometimes the one after.
            way = np.where(np.mean(apart_ns > 0) < 0.5, -1.0, 1.0)
            apart_ms, most_ms = way * float(np.median(np.abs(apart_ns))) * 1e-6, tolerance_ns * 1e-6
            if abs(apart_ms) > most_ms:
                detail += (
                    f"; the second is {apart_ms:+.3f} ms from the first in the median, {most_ms:g} ms are allowed: trigger both "
                    "together, or stamp both by one clock; the stamps of one could be shifted by as much if that is constant"
                )
        log.note("images without their partner", detail)
    return first.take(firsts), second.take(seconds)


@dataclass(frozen=True)
class ViewSeries(Generic[T]):
    """Images of a further view of a rig: rows (F,) of its image, pair, or image with depth, at each frame, -1 for none."""

    left: ImageSeries[T]
    right: ImageSeries[T] | None
    rows: NDArray[np.int64]
    depth: ImageSeries[T] | None = None

    @classmethod
    def beside(cls, frame_stamps_ns: Stamps, images: "ViewImages[T]") -> "ViewSeries[T]":
        """The images of a view that are nearest to each frame (F,), at most half a usual period away."""
        left, right, depth = images
        rows = np.full(len(frame_stamps_ns), -1)
        if len(left):
            period_ns = int(np.median(np.diff(frame_stamps_ns))) if len(frame_stamps_ns) > 1 else _DAY_NS
            frames, chosen = pair_stamps(frame_stamps_ns, left.stamps_ns, period_ns // 2)
            rows[frames] = chosen
        return cls(left, right, rows, depth)


ViewImages = tuple[ImageSeries[T], ImageSeries[T] | None, ImageSeries[T] | None]
"""Left images, right ones and depth of a view at the same moments."""


def rig_images(
    calibration: RigCalibration,
    cameras: Mapping[int, tuple[str, ImageSeries[T]]],
    log: ReadLog,
    depths: Mapping[int, ImageSeries[T]] = MappingProxyType({}),
) -> tuple[RigCalibration, ViewImages[T], tuple[ViewSeries[T], ...]]:
    """Pair a rig's images, by the camera's number and with its name for messages; return the cameras in the order of views, and the views.

    The first view has the frames: that of the first camera, unless it is silent more often than another of its kind. Cameras that are
    silent while others send are noted with the moments.
    """
    numbers = list(cameras)
    recorded = replace(calibration, cameras=tuple(calibration.cameras[number] for number in numbers))
    views = [tuple(numbers[k] for k in view) for view in recorded.views]
    every_ns = np.unique(np.concatenate([series.stamps_ns for _, series in cameras.values()]))
    for name, series in cameras.values():
        _note_silence(name, series.stamps_ns, every_ns, log)
    images = []
    for view in views:
        left, right, depth = cameras[view[0]][1], None, depths.get(view[0])
        if len(view) == 2:
            left, right = pair_images(left, cameras[view[1]][1], log)
        elif depth is not None:
            left, depth = pair_images(left, depth, log, DEPTH_TOLERANCE_NS)
        images.append((left, right, depth))
    alike = [
        k for k, (_, *rest) in enumerate(images) if [s is None for s in rest] == [s is None for s in images[0][1:]]
    ]
    first = min(alike, key=lambda k: int(_silent(images[k][0].stamps_ns, every_ns).sum()))
    turn = sorted(range(len(views)), key=lambda k: k != first)
    order = [number for k in turn for number in views[k]]
    if order != sorted(order):
        names = ", ".join(f"cam{n} is {cameras[number][0]}" for n, number in enumerate(order))
        log.note("cameras in the order of their views", names)
    order += [number for number in range(len(calibration.cameras)) if number not in order]
    ordered = replace(calibration, cameras=tuple(calibration.cameras[number] for number in order))
    stamps_ns = images[first][0].stamps_ns
    return ordered, images[first], tuple(ViewSeries.beside(stamps_ns, images[k]) for k in turn[1:])


def _note_silence(name: str, stamps_ns: Stamps, every_ns: Stamps, log: ReadLog) -> None:
    silent_ns = every_ns[_silent(stamps_ns, every_ns)]
    if len(silent_ns):
        parts = np.split(silent_ns, np.flatnonzero(np.diff(silent_ns) > SILENT_NS) + 1)
        around_ns = np.concatenate([every_ns[:1], stamps_ns, every_ns[-1:]])
        gone = [np.searchsorted(stamps_ns, part[0]) for part in parts]  # from the image before to the one after
        spans_s = [(around_ns[row : row + 2] - every_ns[0]) * 1e-9 for row in gone]
        when = f"{', '.join(f'{a:.1f} to {b:.1f} s' for a, b in spans_s[:3])}{', ...' if len(parts) > 3 else ''} after the start"
        log.note("camera silent", f"{name} has no images from {when}, while others have; its view is missing there")


def _silent(stamps_ns: Stamps, every_ns: Stamps) -> NDArray[np.bool_]:
    """(N,) mask of the moments (N,) that have no stamp within half a second, or within the usual period if that is longer."""
    if not len(stamps_ns):
        return np.ones(len(every_ns), np.bool_)
    usual_ns = int(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0
    return np.asarray(np.abs(stamps_ns[nearest(stamps_ns, every_ns)] - every_ns) > max(SILENT_NS, usual_ns))


class ImageReader(Protocol[T]):
    """Reads the images of a recording from their storage."""

    def read(self, source: T, stamp_ns: int) -> StoredImage:
        """Read one image, still encoded; RecordingError if its bytes are gone."""

    def apart(self) -> "ImageReader[T]":
        """Create another reader of the same images, used and closed independently, also in other threads and processes."""

    def hash_into(self, digest: "hashlib._Hash", images: list[T]) -> None:
        """Feed the recording's content, including images, to `digest`."""

    def close(self) -> None:
        """Close open files."""


Register = Callable[[NDArray[np.float32], str], NDArray[np.float32]]
"""Reprojects depth in metres, named for messages, into the pixels of the left image: (H, W) metres, 0 where unknown."""


@dataclass
class SeriesFrames(Generic[T]):
    """A FrameSource over paired series of equal length.

    grey_bits: used bits of left and right 16-bit images. register: for depth that is stored unregistered. others: the rig's other
    views, left out of frames unless has_others.
    """

    reader: ImageReader[T]
    left: ImageSeries[T]
    right: ImageSeries[T] | None = None
    depth: ImageSeries[T] | None = None
    register: Register | None = None
    grey_bits: int = 16
    others: tuple[ViewSeries[T], ...] = ()
    has_others: bool = True

    def stored(self, index: int) -> StoredFrame:
        """Frame `index` with its images as stored; registered depth as PNG in whole mm."""
        stored = self._stored(index)
        if stored.depth is None or self.register is None:
            return stored
        depth_mm = self._registered_mm(decode_depth(stored.depth), stored.depth.where)
        _, png = cv2.imencode(".png", depth_mm.astype(np.uint16))
        return replace(stored, depth=StoredImage("file", png.tobytes(), stored.depth.where))

    def frame(self, index: int) -> CameraFrame:
        """Frame `index`, decoded; registered depth to one mm, as stored."""
        stored = self._stored(index)
        frame = decode_frame(stored)
        if stored.depth is None or frame.depth_m is None or self.register is None:
            return frame
        depth_mm = self._registered_mm(frame.depth_m, stored.depth.where)
        return replace(frame, depth_m=depth_mm.astype(np.float32) / np.float32(1000.0))

    def part(self, indices: NDArray[np.int64]) -> "SeriesFrames[T]":
        right, depth = (None if series is None else series.take(indices) for series in (self.right, self.depth))
        others = tuple(replace(view, rows=view.rows[indices]) for view in self.others)
        series = {"left": self.left.take(indices), "right": right, "depth": depth, "others": others}
        return replace(self, reader=self.reader.apart(), **series)  # type: ignore[arg-type]

    def of_view(self, number: int) -> "SeriesFrames[T]":
        """The images of one of the other views, counted from 1, at the frames that have them."""
        view = self.others[number - 1]
        rows = view.rows[view.rows >= 0]
        right, depth = (None if series is None else series.take(rows) for series in (view.right, view.depth))
        return replace(self, left=view.left.take(rows), right=right, depth=depth, others=())

    @property
    def other_numbers(self) -> tuple[int, ...]:
        """Numbers of the cameras of other views, if all cameras follow one another view by view."""
        first = 1 if self.right is None else 2
        return tuple(range(first, first + sum(1 if view.right is None else 2 for view in self.others)))

    def hash_into(self, digest: "hashlib._Hash") -> None:
        others = (series for view in self.others for series in (view.left, view.right, view.depth))
        read = (self.left, self.right, self.depth, *others)
        self.reader.hash_into(digest, [s for series in read if series for s in series.sources])

    def close(self) -> None:
        self.reader.close()

    def _stored(self, index: int) -> StoredFrame:
        others = (
            None if view.rows[index] < 0 else self._images(int(view.rows[index]), view.left, view.right, view.depth)
            for view in (self.others if self.has_others else ())
        )
        return replace(self._images(index, self.left, self.right, self.depth), others=tuple(others))

    def _images(
        self, row: int, left: ImageSeries[T], right: ImageSeries[T] | None, depth: ImageSeries[T] | None = None
    ) -> StoredFrame:
        first, second, third = (
            None if series is None else self.reader.read(series.sources[row], int(series.stamps_ns[row]))
            for series in (left, right, depth)
        )
        assert first is not None
        if self.grey_bits < 16:
            first = replace(first, bits=self.grey_bits)
            second = None if second is None else replace(second, bits=self.grey_bits)
        return StoredFrame(int(left.stamps_ns[row]), first, second, third)

    def _registered_mm(self, depth_m: NDArray[np.float32], where: str) -> NDArray[np.float32]:
        assert self.register is not None
        return np.round(self.register(depth_m, where) * 1000)
