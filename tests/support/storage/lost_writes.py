"""Content of a disk after a power cut: of the calls in a journal, the synced ones, and some or none of the rest."""

import random
import shutil
from dataclasses import dataclass, field
from pathlib import Path

from support.storage.faulty_disk import Call, folder_of

POLICIES = ("nothing unsynced", "names without data", "data without names", "some of it", "some of it, torn")
_SECTOR_BYTES = 512


@dataclass
class _File:
    """durable: bytes that are safe; pending: writes (offset, data) and truncations (size, None) since then."""

    durable: bytearray
    pending: list[tuple[int, bytes | None]] = field(default_factory=list)


class DiskImage:
    """Follows a journal; says at any moment what a power cut would leave."""

    def __init__(self, root: Path) -> None:
        """The folder as it is, all of it durable."""
        self._root = str(root)
        self._folders = {str(p) for p in root.rglob("*") if p.is_dir()}
        self._durable_folders = set(self._folders)
        self._files = {str(p): _File(bytearray(p.read_bytes())) for p in root.rglob("*") if p.is_file()}
        self._durable_files = dict(self._files)
        self._unsynced_names: list[tuple[str, _File | None]] = []

    def apply(self, call: Call) -> None:
        """The next call of the journal."""
        kind, path = call[0], call[1]
        if kind == "create":
            self._name(path, _File(bytearray()))
        elif kind == "write":
            self._files[path].pending.append((call[2], call[3]))
        elif kind == "truncate":
            self._files[path].pending.append((call[2], None))
        elif kind == "sync":
            _settle(self._files[path], self._files[path].pending)
            self._files[path].pending = []
        elif kind == "rename":
            self._name(call[2], self._files[path])
            self._name(path, None)
        elif kind == "unlink":
            self._name(path, None)
        elif kind == "mkdir":
            self._folders.add(path)
        elif kind == "sync_folder":
            self._sync_names(path)
        else:
            raise AssertionError(kind)

    def write(self, target: Path, policy: str, rng: random.Random) -> None:
        """Makes `target` what is left after a power cut now."""
        names, folders = dict(self._durable_files), set(self._durable_folders)
        if policy == "names without data":
            names, folders = dict(self._files), set(self._folders)
        elif policy.startswith("some"):
            folders = set(self._folders) if rng.random() < 0.5 else folders
            for path, file in self._unsynced_names:
                if rng.random() < 0.5:
                    names.pop(path, None)
                    if file is not None:
                        names[path] = file
        shutil.rmtree(target, ignore_errors=True)
        for folder in sorted({self._root, *folders}):
            Path(folder.replace(self._root, str(target), 1)).mkdir(exist_ok=True, parents=True)
        for path, file in names.items():
            where = Path(path.replace(self._root, str(target), 1))
            # The index of a write-ahead log means nothing after a restart.
            if where.parent.is_dir() and not path.endswith("-shm"):
                where.write_bytes(_content(file, policy, rng))

    def _name(self, path: str, file: _File | None) -> None:
        self._files.pop(path, None)
        if file is not None:
            self._files[path] = file
        self._unsynced_names.append((path, file))

    def _sync_names(self, folder: str) -> None:
        def inside(path: str) -> bool:
            return folder_of(path) == folder

        self._durable_folders |= {path for path in self._folders if inside(path)}
        self._durable_files = {path: file for path, file in self._durable_files.items() if not inside(path)}
        self._durable_files |= {path: file for path, file in self._files.items() if inside(path)}
        self._unsynced_names = [(path, file) for path, file in self._unsynced_names if not inside(path)]


def _settle(file: _File, writes: list[tuple[int, bytes | None]]) -> None:
    for offset, data in writes:
        if data is None:
            del file.durable[offset:]
            continue
        if len(file.durable) < offset:
            file.durable.extend(bytes(offset - len(file.durable)))
        file.durable[offset : offset + len(data)] = data


def _content(file: _File, policy: str, rng: random.Random) -> bytes:
    if policy in ("nothing unsynced", "names without data"):
        return bytes(file.durable)
    kept = file.pending
    if policy != "data without names":
        kept = [write for write in kept if rng.random() < 0.5]
    if policy == "some of it, torn":
        kept = [piece for write in kept for piece in _torn(*write, rng)]
    copy = _File(bytearray(file.durable))
    _settle(copy, kept)
    return bytes(copy.durable)


def _torn(offset: int, data: bytes | None, rng: random.Random) -> list[tuple[int, bytes | None]]:
    """Some of the sectors of a write."""
    if data is None:
        return [(offset, None)]
    starts = range(0, len(data), _SECTOR_BYTES)
    return [(offset + at, data[at : at + _SECTOR_BYTES]) for at in starts if rng.random() < 0.5]
