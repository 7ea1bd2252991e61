"""Frames whose images are files in folders."""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import RecordingError
from fleetmap.recordings.folders.table_files import pair_stamps
from fleetmap.recordings.images import StoredFrame, StoredImage, decode_frame
from fleetmap.sensors.samples import CameraFrame, DataIssue, Stamps

_BLOCK_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class ImageFolder:
    """One camera's image files in the order of their stamps."""

    stamps_ns: Stamps
    paths: tuple[Path, ...]

    def chosen(self, indices: NDArray[np.int64]) -> "ImageFolder":
        """Those at `indices` (K,)."""
        return ImageFolder(self.stamps_ns[indices], tuple(self.paths[int(i)] for i in indices))


def existing_images(folder: ImageFolder, what: str, losses: list[DataIssue]) -> ImageFolder:
    """The images that exist and hold bytes; the others are counted in `losses`. RecordingError where none is left."""
    sizes = {
        entry.path: entry.stat().st_size for parent in {p.parent for p in folder.paths} for entry in _entries(parent)
    }
    missing = [path for path in folder.paths if str(path) not in sizes]
    empty = [path for path in folder.paths if sizes.get(str(path)) == 0]
    if missing:
        losses.append(
            DataIssue(
                f"{what}: images missing", f"{len(missing)} of {len(folder.paths)}, the first is {missing[0].name}"
            )
        )
    if empty:
        losses.append(
            DataIssue(
                f"{what}: images without a byte", f"{len(empty)} of {len(folder.paths)}, the first is {empty[0].name}"
            )
        )
    kept = np.array([i for i, path in enumerate(folder.paths) if sizes.get(str(path), 0) > 0], np.int64)
    if len(kept) == 0:
        raise RecordingError(
            f"{what}: none of the {len(folder.paths)} images is there and readable ({len(empty)} are empty files); "
            "copy the recording again"
        )
    return folder.chosen(kept)


def paired_cameras(cameras: Sequence[ImageFolder], losses: list[DataIssue]) -> tuple[ImageFolder, ImageFolder | None]:
    """Left and right images of the same moments; those alone are counted in `losses`.

    The right is None for one camera.
    """
    if len(cameras) == 1:
        return cameras[0], None
    lefts, rights = pair_stamps(cameras[0].stamps_ns, cameras[1].stamps_ns)
    alone = sum(len(camera.paths) - len(lefts) for camera in cameras)
    if alone:
        counts = " and ".join(str(len(camera.paths)) for camera in cameras)
        losses.append(DataIssue("images without their partner", f"{alone} of {counts}; {len(lefts)} pairs remain"))
    return cameras[0].chosen(lefts), cameras[1].chosen(rights)


class FileFrames:
    """A FrameSource over image files. `read_files` are all other files that were read, for the content's hash."""

    def __init__(
        self,
        root: Path,
        stamps_ns: Stamps,
        left: Sequence[Path],
        right: Sequence[Path] | None,
        read_files: Sequence[Path],
        depth: Sequence[Path] | None = None,
    ) -> None:
        self._root, self._stamps_ns = root, stamps_ns
        self._left, self._right, self._depth = left, right, depth
        self._read_files = read_files

    def stored(self, index: int) -> StoredFrame:
        """Frame `index` as files' bytes."""
        right = None if self._right is None else _stored(self._right[index])
        depth = None if self._depth is None else _stored(self._depth[index])
        return StoredFrame(int(self._stamps_ns[index]), _stored(self._left[index]), right, depth)

    def frame(self, index: int) -> CameraFrame:
        """Frame `index`, decoded."""
        return decode_frame(self.stored(index))

    def hash_into(self, digest: "hashlib._Hash") -> None:
        """Names, sizes and bytes of all files read, in the order of their names."""
        images = [path for paths in (self._left, self._right, self._depth) if paths is not None for path in paths]
        named = {_portable_name(path, self._root): path for path in (*self._read_files, *images)}
        for name in sorted(named):
            digest.update(f"{name}\0{named[name].stat().st_size}\0".encode())
            hash_file(named[name], digest)

    def close(self) -> None:
        """Nothing is kept open."""


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


def _stored(path: Path) -> StoredImage:
    try:
        return StoredImage("file", path.read_bytes(), str(path))
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); copy the recording again") from error
