"""Backup of a store, also while it is served.

SQLite copies the database as of one moment; blobs never change and are on the disk before the database names them, so they may be read
afterwards. If garbage collection removes one meanwhile, the database is copied again.
"""

import io
import shutil
import tarfile
import tempfile
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path

import msgspec
import pyrage

from fleetmap.errors import StateError, UsageError, disk_errors
from fleetmap.mapformat.names import sha256_hex
from mapserver.plugins.backups.snapshots import LEFT_OUT, NAMED, PIECE_BYTES, BackupTarget, Snapshot
from mapserver.store import MapStore
from mapserver.store.database import format_of
from mapserver.store.files import is_plain_file

_TRIES = 3  # copies of the database, each after another garbage collection
_LEFT_OVER = ".backup-"
Progress = Callable[[int, int], None]


class BackupReport(msgspec.Struct, frozen=True):
    """Result of a backup. uploaded: objects that the target did not have. missing: blobs that the store itself has lost or damaged.

    removed: snapshots beyond the kept ones.
    """

    snapshot: str
    bytes: int
    uploaded: int
    uploaded_bytes: int
    has_keys: bool
    missing: tuple[str, ...]
    removed: tuple[str, ...]


def recipient_of(text: str | None) -> "pyrage.x25519.Recipient | None":
    """Return the age recipient of a text; UsageError if it is none."""
    try:
        return None if text is None else pyrage.x25519.Recipient.from_str(text)
    except pyrage.RecipientError as error:
        advice = "name the line that `age-keygen` prints, age1..."
        raise UsageError(f"--recipient {text!r} is no public key of age ({error}); {advice}") from error


def back_up(
    store: MapStore,
    target: BackupTarget,
    *,
    recipient: "pyrage.x25519.Recipient | None" = None,
    keep: int = 30,
    progress: Progress = lambda done, total: None,
) -> BackupReport:
    """Write a snapshot of the store, and remove all but the newest `keep` ones; without a recipient it has no keys.

    progress: called with the numbers of blobs done and in all. Raises StoreError if either side cannot be read or written, or if another
    backup of this store is under way.
    """
    folder = store.folder
    with disk_errors(f"{folder} cannot be read", "check its rights and space"), store.locked("backup.lock"):
        for path in folder.glob(f"{_LEFT_OVER}*"):  # of a killed backup
            shutil.rmtree(path)
        upload = _Upload(target)
        files, keys = _trusted(store, upload, recipient)
        for _ in range(_TRIES):
            with tempfile.TemporaryDirectory(prefix=_LEFT_OVER, dir=folder) as temporary:
                named, versions = store.copy_database(copy := Path(temporary) / "store.sqlite3")
                files["store.sqlite3"] = [upload.put(piece) for piece in _pieces(copy)]
                store_format = format_of(copy)
            blobs, missing = upload.blobs(store, named, progress)
            if not missing & named - store.named_blobs():  # none of them was dropped since the copy
                break
        else:
            raise StateError(f"garbage was collected during each of {_TRIES} tries; back up at another time of day")
        snapshot = Snapshot(
            store_format=store_format, versions=versions, files=files, blobs=blobs, keys=keys, missing=sorted(missing)
        )
        name = target.write(snapshot, store.now())
        removed = [] if missing else target.prune(keep, store.now_ns())  # an older one may have what is missing
    total = sum(upload.sizes[address] for address in snapshot.objects())
    return BackupReport(name, total, upload.count, upload.bytes, bool(keys), tuple(snapshot.missing), tuple(removed))


class _Upload:
    """Uploads what the target lacks. sizes: of all objects there, by address; count, bytes: of the uploaded ones."""

    def __init__(self, target: BackupTarget) -> None:
        self._target, self.sizes, self.count, self.bytes = target.blobs, target.blobs.sizes(), 0, 0

    def put(self, data: bytes) -> str:
        address = sha256_hex(data)
        if self.sizes.get(address) != len(data):
            self._target.put(data)
            self._note(address, len(data))
        return address

    def blobs(self, store: MapStore, addresses: set[str], progress: Progress) -> tuple[dict[str, int], set[str]]:
        """Upload blobs. Return their sizes, and those that the store has lost or damaged and the target does not have either."""
        found, missing = dict[str, int](), set[str]()
        for number, address in enumerate(sorted(addresses), start=1):
            progress(number, len(addresses))
            size, there = store.blob_size(address), self.sizes.get(address)
            if there is None or size not in (None, there):
                if size is None or not store.is_whole(address):
                    missing.add(address)
                    continue
                self._target.put_chunks(store.blob_chunks(address), address, size)
                self._note(address, size)
            found[address] = self.sizes[address]
        return found, missing

    def _note(self, address: str, size: int) -> None:
        self.count, self.bytes, self.sizes[address] = self.count + 1, self.bytes + size, size


def _trusted(
    store: MapStore, upload: _Upload, recipient: "pyrage.x25519.Recipient | None"
) -> tuple[dict[str, list[str]], str]:
    """Upload signed lists, robots and, for a recipient, keys: older than the database, so that a restored store signs what is missing."""
    folder, files, secrets = store.folder, dict[str, list[str]](), list[Path]()
    with store.locked("trust/lock") if (folder / "trust").is_dir() else nullcontext():  # keys and lists change under it
        for path in sorted([*folder.glob("trust/*"), *folder.glob("keys/*")]):
            name = path.relative_to(folder).as_posix()
            if LEFT_OUT.fullmatch(name) or not is_plain_file(path):
                continue
            if NAMED.fullmatch(name):
                files[name] = [upload.put(piece) for piece in _pieces(path)]
            elif path.parent.name == "keys":
                secrets.append(path)
        return files, "" if recipient is None else upload.put(_packed(secrets, recipient))


def _pieces(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while piece := file.read(PIECE_BYTES):
            yield piece


def _packed(paths: list[Path], recipient: "pyrage.x25519.Recipient") -> bytes:
    """Return files of a folder of keys as an encrypted tar archive; StateError for more than a restoration reads."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        for path in paths:
            archive.add(path, path.name)
    encrypted: bytes = pyrage.encrypt(packed.getvalue(), [recipient])
    if len(encrypted) > PIECE_BYTES:
        raise StateError(f"the keys have more than {PIECE_BYTES} bytes; move what is no key out of {paths[0].parent}")
    return encrypted
