"""Recordings in zip files, unpacked into a temporary folder that lasts as long as the recording is open.

Zip files may be hostile: what their headers say is judged before anything is unpacked, zipfile unpacks no more than they say, and
nothing is written outside the folder.
"""

import hashlib
import lzma
import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory, gettempdir

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings.images import StoredFrame
from fleetmap.recordings.recording import FrameSource, Recording
from fleetmap.sensors.samples import CameraFrame

_MAGIC = b"PK\x03\x04"
# Images are compressed already, and raw ones shrink to a third; a hundredth are zeros
_UNPACKED_BYTES, _UNPACKED_PER_FILE_BYTE = 64 << 20, 100
_DEEPEST = 4  # folders around a recording
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
_KINDS = (0, stat.S_IFREG, stat.S_IFDIR)
_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    ValueError,
    RuntimeError,
    NotImplementedError,
    OSError,
)


def recognises(path: Path) -> bool:
    """Whether `path` is a zip file or named so."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return path.suffix.lower() == ".zip" or file.read(len(_MAGIC)) == _MAGIC


def open_zip(path: Path, format_of: Callable[[Path], object], opener: Callable[[Path], Recording]) -> Recording:
    """The only recording in a zip file, which has a format and which `opener` opens; its hash is that of the same outside."""
    folder = TemporaryDirectory(prefix="fleetmap-")
    # The name of a recording is often that of its folder
    inside = Path(folder.name) / (path.stem or "recording")
    try:
        inside.mkdir()
        _unpack(path, inside)
        opened = opener(_recording_in(inside, path, format_of))
        issues = tuple(replace(i, detail=i.detail.replace(folder.name, str(path))) for i in opened.issues)
        return replace(opened, path=path, issues=issues, frames=_UnpackedFrames(opened.frames, folder))
    except (RecordingError, CalibrationError) as error:
        folder.cleanup()
        raise type(error)(str(error).replace(folder.name, str(path))) from error
    except BaseException:
        folder.cleanup()
        raise


class _UnpackedFrames:
    """Frames whose files go when they are closed. Parts are read while the whole is open."""

    def __init__(self, frames: FrameSource, folder: "TemporaryDirectory[str]") -> None:
        self._frames, self._folder = frames, folder

    def stored(self, index: int) -> StoredFrame:
        return self._frames.stored(index)

    def frame(self, index: int) -> CameraFrame:
        return self._frames.frame(index)

    def part(self, indices: NDArray[np.int64]) -> FrameSource:
        return self._frames.part(indices)

    def hash_into(self, digest: "hashlib._Hash") -> None:
        self._frames.hash_into(digest)

    def close(self) -> None:
        self._frames.close()
        self._folder.cleanup()


def _unpack(path: Path, folder: Path) -> None:
    repair = f"it is damaged: `zip -FF {path} --out repaired.zip` saves what is whole"
    try:
        with zipfile.ZipFile(path) as archive:
            members = [m for m in archive.infolist() if not m.filename.startswith("__MACOSX/")]
            _judge(path, members)
            for member in members:
                archive.extract(member, folder)
    except RecordingError:
        raise
    except _DAMAGED as error:
        raise RecordingError(f"{path} cannot be unpacked (cut off, or a CRC that does not match); {repair}") from error


def _judge(path: Path, members: list[zipfile.ZipInfo]) -> None:
    """RecordingError for what no recording needs, by the headers alone."""
    unpack = f"unpack it with `7z x {path}` and name the folder"
    for member in members:
        name = PurePosixPath(member.filename.replace("\\", "/"))
        if name.is_absolute() or ".." in name.parts or member.filename[1:2] == ":":
            raise RecordingError(f"{path}: {member.filename[:200]!r} lies outside the archive; it is not unpacked")
        if stat.S_IFMT(member.external_attr >> 16) not in _KINDS:
            raise RecordingError(f"{path}: {member.filename[:200]!r} is a link or a device; pack the files themselves")
        if member.flag_bits & 1:
            raise RecordingError(f"{path} is encrypted; {unpack}")
        if member.compress_type not in _METHODS:
            raise RecordingError(
                f"{path}: {member.filename[:200]!r} is packed by method {member.compress_type}; {unpack}"
            )
    size, packed = sum(member.file_size for member in members), path.stat().st_size
    limit = _UNPACKED_BYTES + _UNPACKED_PER_FILE_BYTE * packed
    if size > limit:
        raise RecordingError(
            f"{path}: {packed} bytes unpack to {size}, more than the limit of {limit}; no recording does"
        )
    free = shutil.disk_usage(gettempdir()).free
    if size > 0.9 * free:
        raise RecordingError(f"{path} needs {size} bytes in {gettempdir()}, {free} are free; set TMPDIR, or {unpack}")


def _recording_in(folder: Path, path: Path, format_of: Callable[[Path], object]) -> Path:
    """The folder or file that is a recording: the outermost, and the only one there. A folder may be one by several files of one format."""
    for _ in range(_DEEPEST):
        children = sorted(child for child in folder.iterdir() if not child.name.startswith("."))
        found = [child for child in children if format_of(child) is not None]
        is_one = format_of(folder) is not None
        if len({id(format_of(child)) for child in found}) > 1 or (len(found) > 1 and not is_one):
            names = ", ".join(child.name for child in found[:5])
            raise RecordingError(f"{path} holds {len(found)} recordings ({names}); unpack it and name one of them")
        if is_one or found:
            return folder if is_one else found[0]
        folders = [child for child in children if child.is_dir()]
        if len(folders) != 1:
            break
        folder = folders[0]
    names = ", ".join(sorted(child.name for child in folder.iterdir())[:5]) or "nothing"
    raise RecordingError(f"{path} holds no recording in a known format; there is {names[:200]}")
