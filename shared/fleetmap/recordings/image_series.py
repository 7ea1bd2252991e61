"""Images of each camera by stamp, paired to frames and read one frame at a time."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import Indices, Mask
from fleetmap.recordings import ordering
from fleetmap.recordings.files import hash_file
from fleetmap.recordings.images import StoredFrame, StoredImage, decode_frame
from fleetmap.recordings.ordering import ReadLog, forward_only, nearest, pair_stamps
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, Stamps

SILENT_NS = 500_000_000  # a camera without images for longer is silent
_DAY_NS = 86_400_000_000_000
_TOLERANCES_NS = {"right": ordering.PAIR_TOLERANCE_NS, "depth": ordering.DEPTH_TOLERANCE_NS}


@dataclass(frozen=True)
class ImageSeries:
    """One camera's images: stamps (N,), and the storage location of each, as its reader knows it."""

    stamps_ns: Stamps
    sources: tuple[Any, ...]

    def __len__(self) -> int:
        return len(self.sources)

    def take(self, indices: Indices) -> "ImageSeries":
        """Images at `indices` (K,)."""
        return ImageSeries(self.stamps_ns[indices], tuple(self.sources[int(i)] for i in indices))

    def forward(self, what: str, log: ReadLog) -> "ImageSeries":
        """Images with increasing stamps, as `forward_only`; if days lie between them, those of the largest part."""
        kept = np.flatnonzero(forward_only(self.stamps_ns, what, log))
        largest = max(np.split(kept, np.flatnonzero(np.diff(self.stamps_ns[kept]) > _DAY_NS) + 1), key=len)
        if lost := len(kept) - len(largest):
            detail = f"{lost} of {len(kept)} left out, more than a day from the others; was the clock set?"
            log.note(f"{what}: stamps far apart", detail)
        return self.take(largest)


class ImageReader:
    """Reads the images of a recording from their storage. read_files: those that the content's hash covers, the recording first."""

    def __init__(self, read_files: Sequence[Path]) -> None:
        self.read_files, self._is_closed = read_files, False

    def read(self, source: Any, stamp_ns: int) -> StoredImage:
        """Read one image, still encoded; RecordingError if its bytes are gone."""
        raise NotImplementedError

    def apart(self) -> "ImageReader":
        """Create another reader of the same images, used and closed independently, also in other threads and processes."""
        raise NotImplementedError

    def hash_into(self, digest: "hashlib._Hash", images: list[Any]) -> None:
        """Feed the recording's content, including images, to `digest`."""
        for path in self.read_files:
            hash_file(path, digest)

    def close(self) -> None:
        """Close open files."""
        self._is_closed = True

    def check_open(self, where: str) -> None:
        """RecordingError for an image, named for messages, that is read after `close`."""
        if self._is_closed:
            closed = "was asked for after the recording was closed; keep it open while frames are read"
            raise RecordingError(f"{where} {closed}")


@dataclass(frozen=True)
class ViewImages:
    """Images of one view of a rig, by their field of StoredFrame: left, and right or depth of the same moments (N,).

    rows (F,): of each frame among these, -1 for a frame without this view.
    """

    images: Mapping[str, ImageSeries]
    rows: Indices

    def read(self, reader: ImageReader, index: int, bits: int) -> StoredFrame | None:
        """The images at a frame; bits: used ones of 16-bit images."""
        if (row := int(self.rows[index])) < 0:
            return None
        read: dict[str, Any] = {
            field: reader.read(s.sources[row], int(s.stamps_ns[row])) for field, s in self.images.items()
        }
        if bits < 16:
            read |= {field: replace(image, bits=bits) for field, image in read.items() if field != "depth"}
        return StoredFrame(int(self.images["left"].stamps_ns[row]), **read)

    def part(self, indices: Indices) -> "ViewImages":
        """The images at the frames at indices (K,), without the others: another process gets no more than it reads."""
        used, rows = np.unique(self.rows[indices], return_inverse=True)
        kept = used[used >= 0]
        return ViewImages({field: s.take(kept) for field, s in self.images.items()}, rows - (len(used) - len(kept)))


@dataclass
class SeriesFrames:
    """A FrameSource over a rig's views, of which the first one has every frame; the others are left out of frames unless has_others.

    grey_bits: used bits of 16-bit images.
    """

    reader: ImageReader
    views: tuple[ViewImages, ...]
    grey_bits: int = 16
    has_others: bool = True

    @property
    def stamps_ns(self) -> Stamps:
        """(F,) stamps of the frames."""
        return self.views[0].images["left"].stamps_ns[self.views[0].rows]

    def stored(self, index: int) -> StoredFrame:
        shown = self.views if self.has_others else self.views[:1]
        first, *others = (view.read(self.reader, index, self.grey_bits) for view in shown)
        assert first is not None
        return replace(first, others=tuple(others))

    def frame(self, index: int) -> CameraFrame:
        return decode_frame(self.stored(index))

    def part(self, indices: Indices) -> "SeriesFrames":
        return replace(self, reader=self.reader.apart(), views=tuple(view.part(indices) for view in self.views))

    def of_view(self, number: int) -> "SeriesFrames":
        """The images of one view, at the frames that have it; those of the first one are hashed with all others."""
        if number == 0:
            return replace(self, has_others=False)
        view = self.views[number]
        return replace(self, views=(view.part(np.flatnonzero(view.rows >= 0)),))

    def hash_into(self, digest: "hashlib._Hash") -> None:
        series = (series for view in self.views for series in view.images.values())
        self.reader.hash_into(digest, [source for each in series for source in each.sources])

    def close(self) -> None:
        self.reader.close()


def paired(left: ImageSeries, partner: Mapping[str, ImageSeries], log: ReadLog) -> ViewImages:
    """A view of a camera's images, alone or with their `right` or `depth` by time; those without a partner are noted in `log`."""
    images = {"left": left}
    for field, second in partner.items():
        most_ns = _TOLERANCES_NS[field]
        firsts, seconds = pair_stamps(left.stamps_ns, second.stamps_ns, most_ns)
        if len(left) + len(second) > 2 * len(firsts):
            alone = f"{len(left) + len(second) - 2 * len(firsts)} of {len(left)} and {len(second)}"
            why = _apart(left.stamps_ns, second.stamps_ns, most_ns) if len(left) and len(second) else ""
            log.note("images without their partner", f"{alone}; {len(firsts)} pairs remain{why}")
        images = {"left": left.take(firsts), field: second.take(seconds)}
    return ViewImages(images, np.arange(len(images["left"])))


def _apart(first_ns: Stamps, second_ns: Stamps, tolerance_ns: int) -> str:
    """Words on two cameras that are further apart in time than is allowed; empty if they are not, in the median."""
    both_ns = first_ns[slice(*first_ns.searchsorted([second_ns[0], second_ns[-1] + 1]))]
    shared_ns = both_ns if len(both_ns) else first_ns
    apart_ns = second_ns[nearest(second_ns, shared_ns)] - shared_ns
    # Half a period apart the nearest is sometimes the one before, sometimes the one after.
    way = np.where(np.mean(apart_ns > 0) < 0.5, -1.0, 1.0)
    apart_ms, most_ms = way * float(np.median(np.abs(apart_ns))) * 1e-6, tolerance_ns * 1e-6
    if abs(apart_ms) <= most_ms:
        return ""
    return (
        f"; the second is {apart_ms:+.3f} ms from the first in the median, {most_ms:g} ms are allowed: trigger both "
        "together, or stamp both by one clock; the stamps of one could be shifted by as much if that is constant"
    )


def rig_views(
    calibration: RigCalibration,
    cameras: Mapping[int, tuple[str, ImageSeries]],
    log: ReadLog,
    depths: Mapping[int, ImageSeries] = MappingProxyType({}),
) -> tuple[RigCalibration, tuple[ViewImages, ...]]:
    """Pair a rig's images, by the camera's number and with its name for messages; return the cameras in the order of views, and the views.

    The first view has the frames: that of the first camera, unless it is silent more often than another of its kind. Of the others the
    nearest images count, at most half a usual period away. Cameras that are silent while others send are noted with the moments.
    """
    numbers = list(cameras)
    recorded = replace(calibration, cameras=tuple(calibration.cameras[number] for number in numbers))
    every_ns = np.unique(np.concatenate([series.stamps_ns for _, series in cameras.values()]))
    for name, series in cameras.values():
        _note_silence(name, series.stamps_ns, every_ns, log)
    mounted = [tuple(numbers[k] for k in view) for view in recorded.views]
    views = []
    for left, *right in mounted:
        partner = {"right": cameras[right[0]][1]} if right else {"depth": depths[left]} if left in depths else {}
        views.append(paired(cameras[left][1], partner, log))
    alike = [k for k, view in enumerate(views) if view.images.keys() == views[0].images.keys()]
    first = min(alike, key=lambda k: int(_silent(views[k].images["left"].stamps_ns, every_ns).sum()))
    turn = sorted(range(len(views)), key=lambda k: k != first)
    order = [number for k in turn for number in mounted[k]]
    if order != sorted(order):
        names = ", ".join(f"cam{n} is {cameras[number][0]}" for n, number in enumerate(order))
        log.note("cameras in the order of their views", names)
    order += [number for number in range(len(calibration.cameras)) if number not in order]
    ordered = replace(calibration, cameras=tuple(calibration.cameras[number] for number in order))
    frame_stamps_ns = views[first].images["left"].stamps_ns
    return ordered, (views[first], *(_beside(frame_stamps_ns, views[k]) for k in turn[1:]))


def _beside(frame_stamps_ns: Stamps, view: ViewImages) -> ViewImages:
    """Another view at the frames (F,) of the first one."""
    period_ns = int(np.median(np.diff(frame_stamps_ns))) if len(frame_stamps_ns) > 1 else _DAY_NS
    frames, chosen = pair_stamps(frame_stamps_ns, view.images["left"].stamps_ns, period_ns // 2)
    rows = np.full(len(frame_stamps_ns), -1)
    rows[frames] = chosen
    return replace(view, rows=rows)


def _note_silence(name: str, stamps_ns: Stamps, every_ns: Stamps, log: ReadLog) -> None:
    silent_ns = every_ns[_silent(stamps_ns, every_ns)]
    if len(silent_ns):
        parts = np.split(silent_ns, np.flatnonzero(np.diff(silent_ns) > SILENT_NS) + 1)
        around_ns = np.concatenate([every_ns[:1], stamps_ns, every_ns[-1:]])
        gone = [np.searchsorted(stamps_ns, part[0]) for part in parts]  # from the image before to the one after
        spans_s = [(around_ns[row : row + 2] - every_ns[0]) * 1e-9 for row in gone]
        when = f"{', '.join(f'{a:.1f} to {b:.1f} s' for a, b in spans_s[:3])}{', ...' if len(parts) > 3 else ''} after the start"
        log.note("camera silent", f"{name} has no images from {when}, while others have; its view is missing there")


def _silent(stamps_ns: Stamps, every_ns: Stamps) -> Mask:
    """(N,) mask of the moments (N,) that have no stamp within half a second, or within the usual period if that is longer."""
    if not len(stamps_ns):
        return np.ones(len(every_ns), np.bool_)
    usual_ns = int(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0
    return np.asarray(np.abs(stamps_ns[nearest(stamps_ns, every_ns)] - every_ns) > max(SILENT_NS, usual_ns))
