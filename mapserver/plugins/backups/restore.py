"""Restoring of a store from a snapshot, and verification of snapshots."""

import io
import logging
import shutil
import tarfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Literal

import msgspec
import pyrage

from fleetmap.errors import FleetmapError, MapFormatError, StoreError, UsageError, disk_errors
from fleetmap.files import sync_path, write_atomically
from mapserver.operators.operators import Operators
from mapserver.plugins.backups.backup import Progress
from mapserver.plugins.backups.snapshots import PIECE_BYTES, BackupTarget, Snapshot
from mapserver.store import Actor, MapStore
from mapserver.store.blobs import Blobs, FolderObjects
from mapserver.store.files import locked, make_folder
from mapserver.trust import SignedLists
from mapserver.trust.enrolment import RobotRegister
from mapserver.trust.signing import sign_ahead

_NO_STORE = {"lock", "lost+found", _PART := ".restore"}
_VERSIONS_AHEAD = 1000  # more than a site gets between a backup and the next restoration
_ROOTS = 2  # beyond all that robots may know: one that the lost store made after its backup, and one more
_MOST_ROOTS = 100  # more than a store makes between a backup and its restoration; a robot follows 1024 in all
_LISTS_AHEAD = 100_000  # the same, of a timestamp each six hours and with each release
_log = logging.getLogger(__name__)


class RestoreReport(msgspec.Struct, frozen=True):
    """Result of a restoration. keys: names of the restored ones. robots: enrolled ones; people: operators, and programs with a token.

    lists: "none" without signed ones; "new": signed by new keys, all robots accept them; "ahead": robots accept them unless sites or keys
    were added after the backup; "old": signed by nobody, for lack of a key.
    """

    snapshot: str
    versions: int
    sites: int
    robots: int
    people: int
    keys: tuple[str, ...]
    lists: Literal["none", "new", "ahead", "old"]
    missing: tuple[str, ...]


class BackupFindings(msgspec.Struct):
    """Result of a verification of all snapshots. faults: each a sentence."""

    snapshots: int = 0
    objects: int = 0
    bytes: int = 0
    faults: list[str] = []


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
    """Make a store of a snapshot, the newest by default, in a folder without a store; a failure leaves it as it was.

    Robots of the lost store may know later versions and lists. So numbers go on some way behind those of the snapshot, farther with each
    restoration; the lists are signed anew if the keys are at hand; and robots send again what the lost store had acknowledged lately.
    Errors as of `BackupTarget.read` and `BackupTarget.get`, StoreError for the disk, UsageError for an unfit folder or key.
    """
    folder = folder.absolute()
    with disk_errors(f"{folder} cannot be written", "check its rights and space"):
        make_folder(folder)
        with locked(folder / "lock", shared=False):
            if others := sorted(path.name for path in folder.iterdir() if path.name not in _NO_STORE):
                raise UsageError(
                    f"{folder} holds {others[0]!r} already; name a new folder, so that nothing is overwritten"
                )
            name, snapshot = target.read(name)
            pieces = sum(map(len, snapshot.files.values()))  # one counts as often as it is named
            needed, free = sum(snapshot.blobs.values()) + PIECE_BYTES * pieces, shutil.disk_usage(folder).free
            if needed > free:
                words = f"the snapshot has up to {needed} bytes, the disk of {folder} {free}"
                raise StoreError(f"{words}; name a folder with more room")
            keys, number, part = _keys(target, snapshot, list(identities)), target.count_restore(), folder / _PART
            robots = 0
            shutil.rmtree(part, ignore_errors=True)  # of a killed restoration
            try:
                _write(target, snapshot, part, keys, progress)
                with MapStore.open(part) as store:
                    words = f"snapshot {name}, of {snapshot.versions} versions"
                    store.note_restored(words, number * _VERSIONS_AHEAD, actor)
                    lists = _sign(store, number, target)
                    with suppress(StoreError):  # damaged before the backup; everything else is worth having
                        robots = len(RobotRegister(store).robots())
                    counts = len(store.sites()), robots, len(Operators(store).all())
                # The database last: until it is there, the folder is no store.
                for path in sorted(part.iterdir(), key=lambda path: path.name.startswith("store.sqlite3")):
                    path.replace(folder / path.name)
            finally:
                shutil.rmtree(part, ignore_errors=True)
            sync_path(folder)
    return RestoreReport(name, snapshot.versions, *counts, tuple(sorted(keys)), lists, tuple(snapshot.missing))


def _sign(store: MapStore, number: int, target: BackupTarget) -> Literal["none", "new", "ahead", "old"]:
    lists = SignedLists(store.folder)
    if not lists.are_there:
        return "none"
    newest = lists.newest("root")
    roots = max(target.known_root(newest + _MOST_ROOTS) - newest, 0) + _ROOTS
    try:
        found = sign_ahead(store, number * _LISTS_AHEAD, roots)
    except FleetmapError as error:  # such as a key whose passphrase only the server's unit has
        _log.warning("the lists are not signed: %s", error)
        return "old"
    if found == "new":
        target.note_root(number, lists.newest("root"))
    return found


def verify(target: BackupTarget, progress: Progress = lambda done, total: None) -> BackupFindings:
    """Read every object that a snapshot names; damaged ones are removed, so that the next backup brings them again."""
    found, wanted = BackupFindings(), dict[str, tuple[str, int]]()
    for name in target.snapshots():
        found.snapshots += 1
        try:
            snapshot = target.read(name)[1]
            wanted |= {address: (name, size) for address, size in snapshot.objects().items()}
            found.faults += [f"snapshot {name}: the store had lost {address} before" for address in snapshot.missing]
        except MapFormatError as error:
            found.faults.append(str(error))
    for number, (address, (name, most_bytes)) in enumerate(sorted(wanted.items()), start=1):
        progress(number, len(wanted))
        try:
            size = target.blobs.size(address) or 0
            if size <= most_bytes and target.blobs.matches(address):
                found.bytes += size
                found.objects += 1
                continue
            words = f"{target.blobs.where(address)} is damaged; it is removed, and the next backup brings it if the store has it"
            found.faults.append(f"snapshot {name}: {words}")
            target.blobs.remove(address)
        except FleetmapError as error:
            found.faults.append(f"snapshot {name}: {error}")
    return found


def _write(target: BackupTarget, snapshot: Snapshot, part: Path, keys: dict[str, bytes], progress: Progress) -> None:
    files = {path: (target.blobs.get(a, PIECE_BYTES) for a in pieces) for path, pieces in snapshot.files.items()}
    for path, chunks in {**files, **{f"keys/{file}": [data] for file, data in keys.items()}}.items():
        make_folder((part / path).parent)
        write_atomically(part / path, chunks)
    blobs = Blobs(FolderObjects(part))
    for number, (address, size) in enumerate(snapshot.blobs.items(), start=1):
        progress(number, len(snapshot.blobs))
        blobs.put_chunks(target.blobs.chunks(address), address, size)


def _keys(target: BackupTarget, snapshot: Snapshot, identities: "list[pyrage.x25519.Identity]") -> dict[str, bytes]:
    """Return the key files of a snapshot by name; none without an identity."""
    if not identities:
        return {}
    if not snapshot.keys:
        raise UsageError("the snapshot has no keys: it was made without --recipient; leave --identity out")
    try:
        packed = pyrage.decrypt(target.blobs.get(snapshot.keys, PIECE_BYTES), identities)
    except pyrage.DecryptError as error:
        raise UsageError(
            f"--identity is not the key for which this backup was made ({error}); name the right one"
        ) from error
    found = {}
    with tarfile.open(fileobj=io.BytesIO(packed), mode="r:") as archive:
        for member in archive:
            file = archive.extractfile(member) if member.isreg() else None
            if file is None or "/" in member.name or member.name.startswith(".") or member.size > PIECE_BYTES:
                raise StoreError(
                    f"the backup's keys hold {member.name[:200]!r}, which is no key file; take another snapshot"
                )
            found[member.name] = file.read()
    return found
