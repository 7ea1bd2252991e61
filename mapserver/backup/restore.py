"""Restoring of a store from a snapshot, and verification of snapshots."""

import io
import shutil
import tarfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pyrage

from fleetmap.errors import FleetmapError, MapFormatError, StoreError, UsageError, disk_errors
from fleetmap.files import sync_path, write_atomically
from fleetmap.mapformat import blob_path
from mapserver.backup.snapshots import BackupTarget, Snapshot
from mapserver.store import Actor, MapStore
from mapserver.store.files import make_folder
from mapserver.trust import SignedLists
from mapserver.trust.signing import sign_ahead

_MOST_KEY_BYTES = 16 << 20
_VERSIONS_AHEAD = 1000  # more than a site gets between a backup and the next restoration
_LISTS_AHEAD = 100_000  # the same, of a timestamp each six hours and with each release
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class RestoreReport:
    """Result of a restoration. keys: names of the restored ones. is_signed: robots of before accept the lists that the store serves now."""

    snapshot: str
    versions: int
    keys: tuple[str, ...]
    is_signed: bool
    missing: tuple[str, ...]


@dataclass(slots=True)
class BackupFindings:
    """Result of a verification of all snapshots. faults: each a sentence."""

    snapshots: int = 0
    objects: int = 0
    bytes: int = 0
    faults: list[str] = field(default_factory=list)


def identities_of(path: Path | None) -> "list[pyrage.x25519.Identity]":
    """Return the private keys of age in a file; StoreError if it cannot be read, UsageError without any key."""
    if path is None:
        return []
    with disk_errors(f"{path} cannot be read", "check --identity"):
        lines = [line.strip() for line in path.read_text("utf-8", "replace").splitlines()]
    try:
        return [pyrage.x25519.Identity.from_str(line) for line in lines if line.startswith("AGE-SECRET-KEY-")]
    except pyrage.IdentityError as error:
        raise UsageError(
            f"{path} holds no private key of age ({error}); name the file that `age-keygen` wrote"
        ) from error


def restore(
    target: BackupTarget,
    folder: Path,
    actor: Actor,
    *,
    name: str | None = None,
    identities: "Iterable[pyrage.x25519.Identity]" = (),
    progress: Progress = lambda done, total: None,
) -> RestoreReport:
    """Make a store of a snapshot, the newest by default, in a folder that must not exist or be empty; a failure leaves it so.

    Robots of the lost store may know later versions and lists. So numbers go on some way behind those of the snapshot, farther with each
    restoration; the lists are signed anew if the keys are at hand; and robots send again what the lost store had acknowledged lately.
    Errors as of `BackupTarget.read` and `BackupTarget.get`, StoreError for the disk, UsageError for an unfit folder or key.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} is not empty; name a new folder with --store, so that nothing is overwritten")
    name, snapshot = target.read(name)
    keys = _keys(target, snapshot, list(identities))
    part = folder.with_name(f"{folder.name}.part")
    with disk_errors(f"{part} cannot be written", "check its rights and space"):
        shutil.rmtree(part, ignore_errors=True)
        make_folder(part)
        try:
            _write(target, snapshot, part, keys, progress)
            number = target.count_restore()
            with MapStore.open(part) as store:
                store.note_restored(
                    f"snapshot {name}, of {snapshot.versions} versions", number * _VERSIONS_AHEAD, actor
                )
                is_signed = not SignedLists(part).are_there or sign_ahead(store, number * _LISTS_AHEAD)
            if folder.exists():
                folder.rmdir()
            part.rename(folder)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
        sync_path(folder.parent)
    return RestoreReport(name, snapshot.versions, tuple(sorted(keys)), is_signed, tuple(snapshot.missing))


def verify(target: BackupTarget, progress: Progress = lambda done, total: None) -> BackupFindings:
    """Read every object that a snapshot names."""
    found, wanted = BackupFindings(), dict[str, str]()
    for name in target.snapshots():
        found.snapshots += 1
        try:
            wanted |= dict.fromkeys(target.read(name)[1].objects(), name)
        except MapFormatError as error:
            found.faults.append(str(error))
    for number, (address, name) in enumerate(sorted(wanted.items()), start=1):
        progress(number, len(wanted))
        try:
            found.bytes += len(target.get(address))
            found.objects += 1
        except FleetmapError as error:
            found.faults.append(f"snapshot {name}: {error}")
    return found


def _write(target: BackupTarget, snapshot: Snapshot, part: Path, keys: dict[str, bytes], progress: Progress) -> None:
    for path, pieces in snapshot.files.items():
        _write_file(part / path, (target.get(address) for address in pieces))
    for file, data in keys.items():
        _write_file(part / "keys" / file, [data])
    for number, address in enumerate(snapshot.blobs, start=1):
        progress(number, len(snapshot.blobs))
        _write_file(part / blob_path(address), [target.get(address)])


def _write_file(path: Path, chunks: Iterable[bytes]) -> None:
    make_folder(path.parent)
    write_atomically(path, chunks)


def _keys(target: BackupTarget, snapshot: Snapshot, identities: "list[pyrage.x25519.Identity]") -> dict[str, bytes]:
    """Return the key files of a snapshot by name; none without an identity."""
    if not identities:
        return {}
    if not snapshot.keys:
        raise UsageError("the snapshot has no keys: it was made without --recipient; leave --identity out")
    try:
        packed = pyrage.decrypt(target.get(snapshot.keys), identities)
    except pyrage.DecryptError as error:
        raise UsageError(
            f"--identity is not the key for which this backup was made ({error}); name the right one"
        ) from error
    with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        return dict(_members(archive))


def _members(archive: tarfile.TarFile) -> Iterator[tuple[str, bytes]]:
    for member in archive:
        file = archive.extractfile(member) if member.isreg() else None
        if file is None or "/" in member.name or member.name.startswith(".") or member.size > _MOST_KEY_BYTES:
            raise StoreError(
                f"the backup's keys hold {member.name[:200]!r}, which is no key file; take another snapshot"
            )
        yield member.name, file.read()
