"""Frames whose images are files in folders."""

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import RecordingError
from fleetmap.recordings.image_series import ImageSeries, SeriesFrames, pair_images
from fleetmap.recordings.images import MAX_PIXELS, StoredImage, file_kind, image_size, is_cut, is_damaged_png
from fleetmap.recordings.ordering import ReadLog, usual_size
from fleetmap.recordings.strange_files import what_instead

_BLOCK_BYTES, _HEAD_BYTES, _TAIL_BYTES = 1 << 20, 4096, 8192
_TIFF = (b"II*\0", b"MM\0*")
_MAX_IMAGE_BYTES = 8 * MAX_PIXELS
ImageFiles = ImageSeries[Path]


def existing_images(series: ImageFiles, what: str, log: ReadLog) -> ImageFiles:
    """The images with increasing stamps that exist, are whole and of the size of most; the others are noted in `log`.

    RecordingError where none is left.
    """
    series = series.forward(what, log)
    entries = (entry for folder in {path.parent for path in series.sources} for entry in _entries(folder))
    sizes = {entry.path: entry.stat().st_size for entry in entries}
    left_out: dict[str, list[str]] = {}
    kept, sizes_px = [], []
    for index, path in enumerate(series.sources):
        try:
            if str(path) not in sizes:
                raise RecordingError("missing")
            size_px = _whole_image_size(path, sizes[str(path)])
        except RecordingError as error:
            left_out.setdefault(str(error), []).append(path.name)
            continue
        kept.append(index)
        sizes_px.append(size_px)
    for fault, names in left_out.items():
        log.note(f"{what}: images {fault}", f"{len(names)} of {len(series)}, the first is {names[0]}")
    if not kept:
        faults = "; ".join(f"{len(names)} {fault}, the first is {names[0]}" for fault, names in left_out.items())
        raise RecordingError(
            f"{what}: none of the {len(series)} images is there and readable ({faults}); copy the recording again"
        )
    usual = usual_size(sizes_px, what, log)
    return series.take(np.array(kept, np.int64)[usual])


def _whole_image_size(path: Path, file_bytes: int) -> tuple[int, int] | None:
    """Width and height by the file's head, None where that does not say; RecordingError with the fault of one that is not whole."""
    if not file_bytes:
        raise RecordingError("without a byte")
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
            file.seek(max(0, file_bytes - _TAIL_BYTES))
            tail = file.read(_TAIL_BYTES)
            is_whole_read = file_kind(head) == "png" and file_bytes <= _MAX_IMAGE_BYTES
            file.seek(0)
            is_damaged = is_whole_read and is_damaged_png(file.read(file_bytes))
    except OSError as error:
        raise RecordingError(f"that cannot be read ({error.strerror})") from error
    if fault := what_instead(head):
        raise RecordingError(f"that are {fault}")
    if is_cut(head, tail):
        raise RecordingError("cut off")
    if is_damaged:
        raise RecordingError("damaged inside")
    size_px = image_size(head)
    if size_px is None and file_kind(head) == "other" and not head.startswith(_TIFF):  # whose header may be at its end
        raise RecordingError("of no format that is read")
    return size_px


def paired_cameras(cameras: Sequence[ImageFiles], log: ReadLog) -> tuple[ImageFiles, ImageFiles | None]:
    """Left and right images of the same moments, see `pair_images`; no right ones for one camera."""
    return (cameras[0], None) if len(cameras) == 1 else pair_images(cameras[0], cameras[1], log)


class FileFrames(SeriesFrames[Path]):
    """A FrameSource over image files below `root`. `read_files`: all other files read, for the content's hash."""

    def __init__(
        self,
        root: Path,
        read_files: Sequence[Path],
        left: ImageFiles,
        right: ImageFiles | None = None,
        depth: ImageFiles | None = None,
    ) -> None:
        super().__init__(read_image, left, right, depth)
        self.root, self.read_files = root, read_files

    def part(self, indices: NDArray[np.int64]) -> "FileFrames":
        return self.like(FileFrames(self.root, self.read_files, *self.taken(indices)))

    def hash_into(self, digest: "hashlib._Hash") -> None:
        """Names, sizes and bytes of all files read, in the order of their names."""
        images = [path for series in (self.left, self.right, self.depth) if series for path in series.sources]
        named = {_portable_name(path, self.root): path for path in (*self.read_files, *images)}
        for name in sorted(named):
            digest.update(f"{name}\0{named[name].stat().st_size}\0".encode())
            hash_file(named[name], digest)

    def close(self) -> None:
        """Does nothing: no file stays open."""


def hash_file(path: Path, digest: "hashlib._Hash") -> None:
    """Feeds the bytes of a file to `digest`, a block at a time."""
    try:
        with path.open("rb") as file:
            while block := file.read(_BLOCK_BYTES):
                digest.update(block)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read any more ({error.strerror}); was the recording moved?") from error


def _portable_name(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else f"outside/{path.name}"


def _entries(folder: Path) -> list["os.DirEntry[str]"]:
    return list(os.scandir(folder)) if folder.is_dir() else []


def read_image(path: Path, _: int = 0) -> StoredImage:
    """The image in a file, not decoded; RecordingError where it cannot be read or has more bytes than any image."""
    try:
        if (size := path.stat().st_size) > _MAX_IMAGE_BYTES:
            raise RecordingError(
                f"{path} has {size} bytes; images of at most {_MAX_IMAGE_BYTES >> 20} MiB are read, remove it"
            )
        return StoredImage("file", path.read_bytes(), str(path))
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); copy the recording again") from error
