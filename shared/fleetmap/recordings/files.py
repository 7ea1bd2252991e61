"""Reading of files that may be missing, too large or of another kind: Git LFS pointers, HTML pages, zip files."""

import hashlib
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path

from fleetmap.errors import FleetmapError, RecordingError
from fleetmap.recordings.limits import MAX_TABLE_BYTES

_BLOCK_BYTES = 1 << 20


def what_instead(head: bytes) -> str:
    """Name the unexpected kind of a file by its first bytes, with advice; empty if they may be the expected content."""
    if head.startswith(b"version https://git-lfs.github.com/spec/"):
        return "a Git LFS pointer in place of the file; `git lfs pull` fetches it"
    if head.startswith(b"PK\x03\x04"):
        return "a zip file; `unzip` it and name what was in it"
    if head[:512].lstrip(b"\xef\xbb\xbf \t\r\n").lower().startswith((b"<!doctype html", b"<html")):
        advice = "download it again while signed in, or with `git lfs pull` where it is in Git LFS"
        return f"an HTML page (of a sign-in or an error) in place of the file; {advice}"
    return ""


def file_head(path: Path, size: int) -> bytes:
    """The first bytes of a file; empty unless it is a readable regular file."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as file:
            return file.read(size)
    except OSError:
        return b""


def what_file_instead(path: Path) -> str:
    """As `what_instead`, for the file at `path`."""
    return what_instead(file_head(path, 512))


def read_text(
    path: Path,
    expected: str,
    *,
    most_bytes: int = MAX_TABLE_BYTES,
    errors: str = "strict",
    error_type: type[FleetmapError] = RecordingError,
) -> str:
    """Read a text file without its byte order mark; raises `error_type` if it is unreadable, not text, too large or of another kind.

    expected: description of the expected content. errors: `replace` for tables, so that damage costs lines and not the file.
    """
    if fault := what_file_instead(path):
        raise error_type(f"{path} is {fault}")
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise error_type(f"{path} is not a regular file; {expected}")
        if status.st_size > most_bytes:
            raise error_type(f"{path} has {status.st_size} bytes; at most {most_bytes} are read, {expected}")
        return path.read_text(encoding="utf-8-sig", errors=errors)
    except OSError as error:
        raise error_type(f"{path} cannot be read ({error.strerror}); check the path, {expected}") from error
    except UnicodeDecodeError as error:
        raise error_type(f"{path} is not a text file (byte {error.start} is not UTF-8); {expected}") from error


def lines_of(text: str, where: object) -> Iterator[tuple[str, str]]:
    """The lines of a table, each with its place for messages, without empty ones and those that begin with #."""
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield f"{where}, line {number}", line


def hash_file(path: Path, digest: "hashlib._Hash") -> None:
    """Feed the bytes of a file to `digest`, a block at a time."""
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise RecordingError(f"{path} is no file but a folder, a pipe or a device; copy the recording again")
            while block := file.read(_BLOCK_BYTES):
                digest.update(block)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read any more ({error.strerror}); was the recording moved?") from error


def natural_key(name: str) -> tuple[object, ...]:
    """Sort key of file names by the numbers in them."""
    return tuple(int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name))
