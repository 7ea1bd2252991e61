"""A disk that fails: every file-system call of a store is counted, and can kill the process, fail, or be remembered.

What the store calls through `os` is replaced in that module. What SQLite calls is seen by a VFS of ours: a copy of its unix VFS, in
the very library that Python's `sqlite3` uses, whose files ask here first. Meant for a forked child: nothing is put back.
"""

import ctypes
import errno
import os
import pickle
import signal
import stat
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from fleetmap.errors import FleetmapError

_real = {
    name: getattr(os, name)
    for name in ("open", "close", "read", "pread", "write", "fsync", "replace", "unlink", "mkdir", "stat", "scandir")
}
_KILLED, _CHILD_WITHIN_S = 9, 60
_WRITING = {"create", "write", "truncate", "sync", "sync_folder", "rename", "unlink", "mkdir", "map"}

Call = tuple[Any, ...]
"""A disk operation: its kind, then a path (two for rename), offset and data of writes, size of truncations."""


@dataclass
class Disk:
    """The calls below `root`. fail_at: number of the call at which `how` strikes; is_lasting: and at all later ones.

    how: "kill" before the call, "tear" after half a write, "ENOSPC" and "EIO" as errors. ENOSPC strikes writing calls alone.
    """

    root: str
    fail_at: int = -1
    how: str = "kill"
    is_lasting: bool = False
    count: int = 0
    struck: int = 0
    journal: list[Call] = field(default_factory=list)

    def holds(self, path: str) -> bool:
        """True if a path is on this disk."""
        return path.startswith(self.root)

    def begin(self, kind: str) -> int:
        """Counts a call; the errno that it must fail with, 0 for none. Does not return where the process is killed."""
        number, self.count = self.count, self.count + 1
        if number != self.fail_at and not (self.is_lasting and 0 <= self.fail_at < number):
            return 0
        if self.how == "ENOSPC" and kind not in _WRITING:
            return 0
        if self.how == "tear" and kind == "write":
            return -1
        self.struck += 1
        if self.how in ("kill", "tear"):
            os._exit(_KILLED)
        return errno.ENOSPC if self.how == "ENOSPC" else errno.EIO

    def note(self, *call: Any) -> None:
        """Remembers what was done."""
        self.journal.append(call)


class FullDisk(Disk):
    """A disk without space: writing fails until something is removed, which gives as many writes as it had kilobytes."""

    free = 0

    def begin(self, kind: str) -> int:
        """ENOSPC for what needs space and finds none."""
        if kind not in ("create", "write", "map"):
            return 0
        self.free -= 1
        return errno.ENOSPC if self.free < 0 else 0

    def note(self, *call: Any) -> None:
        """A file that goes gives its space back."""
        if call[0] == "unlink":
            self.free = max(0, self.free) + self.sizes.pop(call[1], 0) // 1024

    def measure(self) -> None:
        """Looks at the files that are there."""
        names = [os.path.join(folder, name) for folder, _, files in os.walk(self.root) for name in files]  # noqa: PTH118
        self.sizes = {name: _real["stat"](name).st_size for name in names}


def folder_of(path: str) -> str:
    """The folder that a path's name is in."""
    return path.rpartition("/")[0]


def in_child(act: Callable[[], object], disk: Disk, told: Path) -> tuple[int, Disk]:
    """How a forked process ends that acts on this disk (0 done, 3 refused, 4 another error, 9 killed), and the disk by way of `told`."""
    told.unlink(missing_ok=True)
    child = os.fork()
    if child == 0:
        status = 4
        try:
            signal.alarm(_CHILD_WITHIN_S)
            install(disk)
            act()
            status = 0
        except FleetmapError:
            status = 3
        except BaseException:
            traceback.print_exc()
        finally:
            told.write_bytes(pickle.dumps(disk))
            os._exit(status)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status), pickle.loads(told.read_bytes()) if told.exists() else disk


def install(disk: Disk) -> None:
    """From now on every call of this process below the disk's root goes through `disk`."""
    sys.unraisablehook = _fail  # what goes wrong in a callback of C must not be passed over
    _install_os(disk)
    _install_sqlite(disk)


def _fail(found: Any) -> None:
    traceback.print_exception(found.exc_type, found.exc_value, found.exc_traceback)
    os._exit(5)


def _install_os(disk: Disk) -> None:
    paths: dict[int, str] = {}
    offsets: dict[int, int] = {}

    def begin(kind: str, path: str) -> None:
        number = disk.begin(kind)
        if number > 0:
            raise OSError(number, os.strerror(number), path)

    def open_(path: Any, flags: int, mode: int = 0o777, **more: Any) -> int:
        name = "" if isinstance(path, int) else os.fspath(path)
        if not disk.holds(name):
            return _real["open"](path, flags, mode, **more)
        is_new = bool(flags & os.O_CREAT) and not os.access(name, os.F_OK)
        begin("create" if is_new else "open", name)
        descriptor = _real["open"](path, flags, mode, **more)
        paths[descriptor], offsets[descriptor] = name, 0
        if is_new:
            disk.note("create", name)
        return descriptor

    def write(descriptor: int, data: Any) -> int:
        if descriptor not in paths:
            return _real["write"](descriptor, data)
        number = disk.begin("write")
        if number < 0:
            _real["write"](descriptor, bytes(data)[: len(data) // 2])
            os._exit(_KILLED)
        if number > 0:
            raise OSError(number, os.strerror(number), paths[descriptor])
        done = _real["write"](descriptor, data)
        disk.note("write", paths[descriptor], offsets[descriptor], bytes(data)[:done])
        offsets[descriptor] += done
        return done

    def fsync(descriptor: int) -> None:
        if descriptor in paths:
            kind = "sync_folder" if stat.S_ISDIR(_real["stat"](paths[descriptor]).st_mode) else "sync"
            begin(kind, paths[descriptor])
            disk.note(kind, paths[descriptor])
        _real["fsync"](descriptor)

    def close(descriptor: int) -> None:
        paths.pop(descriptor, None)
        _real["close"](descriptor)

    def replace(source: Any, target: Any) -> None:
        names = [os.fspath(path) for path in (source, target)]
        if disk.holds(names[1]):
            begin("rename", names[1])
            disk.note("rename", *names)
        _real["replace"](source, target)

    def on_path(kind: str, real: str, remembered: bool) -> Callable[..., Any]:
        def call(path: Any = ".", *rest: Any, **more: Any) -> Any:
            name = "" if isinstance(path, int) else os.fspath(path)
            if not disk.holds(name):
                return _real[real](path, *rest, **more)
            begin(kind, name)
            done = _real[real](path, *rest, **more)
            if remembered:
                disk.note(kind, name)
            return done

        return call

    def on_descriptor(real: str) -> Callable[..., Any]:
        def call(descriptor: int, *rest: Any) -> Any:
            if descriptor in paths:
                begin("read", paths[descriptor])
            return _real[real](descriptor, *rest)

        return call

    os.open, os.write, os.fsync, os.close, os.replace = open_, write, fsync, close, replace
    os.unlink, os.mkdir = on_path("unlink", "unlink", True), on_path("mkdir", "mkdir", True)
    os.stat, os.scandir = on_path("look", "stat", False), on_path("look", "scandir", False)
    os.read, os.pread = on_descriptor("read"), on_descriptor("pread")


_P, _I, _L = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64
_OPEN = ctypes.CFUNCTYPE(_I, _P, _P, _P, _I, _P)
_DELETE = ctypes.CFUNCTYPE(_I, _P, ctypes.c_char_p, _I)
_ACCESS = ctypes.CFUNCTYPE(_I, _P, ctypes.c_char_p, _I, _P)
_METHODS = {
    name: ctypes.CFUNCTYPE(_I, _P, *arguments)
    for name, arguments in {
        "close": (), "read": (_P, _I, _L), "write": (_P, _I, _L), "truncate": (_L,), "sync": (_I,), "size": (_P,),
        "map": (_I, _I, _I, _P),
    }.items()
}  # fmt: skip
_OPEN_CREATE, _JOURNALS = 0x4, 0x800 | 0x4000 | 0x80000
_SQLITE_FULL = 13
_SQLITE_ERRORS = {
    "create": 14, "open": 14, "write": 778, "read": 266, "sync": 1034, "truncate": 1546, "size": 1802,
    "unlink": 2570, "look": 3338, "map": 5386,
}  # fmt: skip


class _Vfs(ctypes.Structure):
    _fields_ = (
        ("version", _I), ("file_bytes", _I), ("max_path", _I), ("next", _P), ("name", ctypes.c_char_p), ("data", _P),
        ("open", _P), ("delete", _P), ("access", _P), ("others", _P * 12),
    )  # fmt: skip


class _Methods(ctypes.Structure):
    _fields_ = (
        ("version", _I), ("close", _P), ("read", _P), ("write", _P), ("truncate", _P), ("sync", _P), ("size", _P),
        ("locking", _P * 6), ("map", _P), ("others", _P * 5),
    )  # fmt: skip


_kept: list[Any] = []  # what C points to


def _install_sqlite(disk: Disk) -> None:
    import _sqlite3

    library = ctypes.CDLL(_sqlite3.__file__)  # finds SQLite there or in what it was linked with
    library.sqlite3_vfs_find.restype = ctypes.POINTER(_Vfs)
    unix = library.sqlite3_vfs_find(None).contents
    ours = _Vfs.from_buffer_copy(unix)
    ours.name = b"faulty"
    ours.open = _pointer(_opening(disk, _OPEN(unix.open)))
    ours.delete = _pointer(_DELETE(partial(_delete, disk, _DELETE(unix.delete))))
    ours.access = _pointer(_ACCESS(partial(_look, disk, _ACCESS(unix.access))))
    _kept.append(ours)
    assert library.sqlite3_vfs_register(ctypes.byref(ours), 1) == 0


def _pointer(function: Any) -> int:
    _kept.append(function)
    return ctypes.cast(function, _P).value or 0


def _code(disk: Disk, kind: str) -> int:
    number = disk.begin(kind)
    if number > 0:
        return _SQLITE_FULL if number == errno.ENOSPC and kind == "write" else _SQLITE_ERRORS[kind]
    return number


def _opening(disk: Disk, real: Any) -> Any:
    methods: dict[int, _Methods] = {}
    files: dict[int, list[Any]] = {}  # by address: path, and whether its folder is synced with it

    def call(vfs: int, name: int | None, file: int, flags: int, found: int) -> int:
        path = ctypes.string_at(name).decode() if name else ""
        if not disk.holds(path):
            return int(real(vfs, name, file, flags, found))
        is_new = bool(flags & _OPEN_CREATE) and not os.access(path, os.F_OK)
        if code := _code(disk, "create" if is_new else "open"):
            ctypes.c_void_p.from_address(file).value = None  # SQLite does not close what has no methods
            return code
        result = int(real(vfs, name, file, flags, found))
        own = ctypes.c_void_p.from_address(file)
        if result == 0 and own.value:
            if is_new:
                disk.note("create", path)
            files[file] = [path, bool(flags & _JOURNALS)]
            if own.value not in methods:
                methods[own.value] = _watched(disk, _Methods.from_address(own.value), files)
            own.value = ctypes.addressof(methods[own.value])
        return result

    return _OPEN(call)


def _watched(disk: Disk, unix: _Methods, files: dict[int, list[Any]]) -> _Methods:
    ours = _Methods.from_buffer_copy(unix)
    for name, kind in _METHODS.items():
        if real := getattr(unix, name):  # files without locks have no map
            setattr(ours, name, _pointer(kind(partial(_call_method, disk, files, name, kind(real)))))
    return ours


def _call_method(disk: Disk, files: dict[int, list[Any]], name: str, real: Any, file: int, *arguments: int) -> int:
    if name == "close":
        files.pop(file, None)
        return int(real(file))
    code = _code(disk, name)
    if code < 0:
        data, count, offset = arguments
        real(file, data, count // 2, offset)
        os._exit(_KILLED)
    if code:
        return code
    path, is_folder_due = files[file]
    if name == "write":
        data, count, offset = arguments
        disk.note(name, path, offset, ctypes.string_at(data, count))
    elif name == "truncate":
        disk.note(name, path, *arguments)
    elif name == "sync":
        disk.note(name, path)
        if is_folder_due:  # as the unix VFS does at a journal's first sync
            disk.note("sync_folder", folder_of(path))
            files[file][1] = False
    return int(real(file, *arguments))


def _delete(disk: Disk, real: Any, vfs: int, name: bytes, sync: int) -> int:
    path = name.decode()
    if disk.holds(path):
        if code := _code(disk, "unlink"):
            return code
        if os.access(path, os.F_OK):
            disk.note("unlink", path)
            if sync:
                disk.note("sync_folder", folder_of(path))
    return int(real(vfs, name, sync))


def _look(disk: Disk, real: Any, vfs: int, name: bytes, flags: int, found: int) -> int:
    if disk.holds(name.decode()) and (code := _code(disk, "look")):
        return code
    return int(real(vfs, name, flags, found))
