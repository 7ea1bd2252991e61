"""Disks that refuse, as the kernel has them: a folder mounted read-only, and one that belongs to another account."""

import codecs
import ctypes
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

KINDS = ("read-only", "another account", "unreadable")
_NOBODY = 65534
_NEW_MOUNTS, _BIND, _READ_ONLY = 0x00020000, 0x1000, 0x1021  # CLONE_NEWNS, MS_BIND, MS_REMOUNT | MS_BIND | MS_RDONLY


@contextmanager
def open_folder() -> Iterator[Path]:
    """A folder that every account reaches."""
    with TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


def on_bad_disk(kind: str, folder: Path, action: Callable[[], Any]) -> Any:
    """The result of `action` in a process to which `folder` is read-only, of another account, or of another account with unreadable files.

    Skips where this process may not arrange that.
    """
    if os.geteuid():
        pytest.skip("NO ROOT: disks that refuse are not tested; run the tests as root to do it")
    for path in folder.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o600 if kind == "unreadable" else 0o644)
    codecs.lookup("ascii")  # while the library can be read
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            _arrange(kind, folder)
            answer = (True, action())
        except BaseException as error:
            answer = (False, error)
        os.write(writing, pickle.dumps(answer))
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        is_good, value = pickle.loads(pipe.read())
    os.waitpid(child, 0)
    if not is_good:
        raise value
    return value


def _arrange(kind: str, folder: Path) -> None:
    if kind != "read-only":
        os.setgroups([])
        os.setgid(_NOBODY)
        os.setuid(_NOBODY)
        return
    libc, where = ctypes.CDLL(None, use_errno=True), str(folder).encode()
    private = 0x44000  # MS_PRIVATE | MS_REC: the mount is seen by this process alone
    if libc.unshare(_NEW_MOUNTS) or any(
        libc.mount(source, target, None, flags, None)
        for source, target, flags in ((None, b"/", private), (where, where, _BIND), (None, where, _READ_ONLY))
    ):
        pytest.skip(f"NO MOUNTS: a read-only disk is not tested ({os.strerror(ctypes.get_errno())})")
