"""Frames whose images are files in folders."""

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import RecordingError
from fleetmap.recordings.image_series import ImageSeries, SeriesFrames, pair_images
from fleetmap.recordings.images import MAX_PIXELS, StoredImage
from fleetmap.recordings.ordering import ReadLog

_BLOCK_BYTES = 1 << 20
_MAX_IMAGE_BYTES = 8 * MAX_PIXELS
ImageFiles = ImageSeries[Path]


def existing_images(series: ImageFiles, what: str, log: ReadLog) -> ImageFiles:
    """The images with increasing stamps that exist and hold bytes; the others are noted in `log`.

    RecordingError where none is left.
    """
    series = series.forward(what, log)
    entries = (entry for folder in {path.parent for path in series.sources} for entry in _entries(folder))
    sizes = {entry.path: entry.stat().st_size for entry in entries}
    missing = [path for path in series.sources if str(path) not in sizes]
    empty = [path for path in series.sources if sizes.get(str(path)) == 0]
    for kind, paths in (("missing", missing), ("without a byte", empty)):
        if paths:
            log.note(f"{what}: images {kind}", f"{len(paths)} of {len(series)}, the first is {paths[0].name}")
    kept = np.array([i for i, path in enumerate(series.sources) if sizes.get(str(path), 0) > 0], np.int64)
    if len(kept) == 0:
        raise RecordingError(
            f"{what}: none of the {len(series)} images is there and readable ({len(empty)} are empty files); "
            "copy the recording again"
        )
    return series.take(kept)


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
        """See FrameSource."""
        return FileFrames(self.root, self.read_files, *self.taken(indices))

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
