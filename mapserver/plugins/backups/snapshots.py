"""The target of backups: objects by their SHA-256, and snapshots that name them.

    URL/objects/ab/<sha256>      blobs of the store; pieces of its database, signed lists, robots and encrypted keys
    URL/snapshots/<UTC>.json     what a store consisted of at that time; written last, so that each one there is complete
    URL/restores/<number>        one for each restoration, which counts them

An object is uploaded once, however many snapshots name it. URL: a folder, or s3://BUCKET/PREFIX and what else obstore opens, with the
credentials and the endpoint of the environment (AWS_ACCESS_KEY_ID, AWS_ENDPOINT_URL, ...).
"""

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

import msgspec

from fleetmap.encoding import decode_json, to_json
from fleetmap.errors import FleetmapError, MapFormatError, NewerFormatError, StoreError, UsageError
from fleetmap.mapformat.manifest import Sha256
from mapserver.store.blobs import Blobs
from mapserver.store.places import open_objects

FORMAT = 2  # 1 has no enrolled robots
PIECE_BYTES = 4 << 20
"""Size of a database's pieces, whose unchanged pages stay where they are, and the limit of other files'."""
_SNAPSHOTS, _RESTORES = "snapshots", "restores"
_NAME, _NAME_FORMAT = re.compile(r"[0-9]{8}T[0-9]{6}Z"), "%Y%m%dT%H%M%SZ"
NAMED = re.compile(r"store\.sqlite3|keys/robots\.json|trust/[a-z0-9][a-z0-9._-]{0,120}\.json")
"""Files of a store that a snapshot names by their paths; all others in `keys` are encrypted."""
LEFT_OUT = re.compile(
    r"(.*/)?(lock|\..*)|[^/]+\.lock|store[.-].+|reserve|places\.json|job-[0-9]+\.log|(blobs|sites|refused)/.*"
)
"""Files that no snapshot names: the database names the blobs, `sites` is made of it, the others are locks, logs, journals."""
_LONGEST_BACKUP_NS = 86_400_000_000_000
_MOST_BYTES = 1 << 30  # of a snapshot
_MOST_RESTORES = 50_000  # signed lists count in ten digits


class Snapshot(msgspec.Struct, frozen=True, kw_only=True):
    """A store at one time. files: pieces by path, in order. blobs: their sizes by address.

    keys: its folder of keys, encrypted; empty without a recipient. missing: blobs that the store itself had lost or had damaged.
    """

    format: int = FORMAT
    store_format: int
    versions: int
    files: dict[str, list[Sha256]]
    blobs: dict[Sha256, int]
    keys: Annotated[str, msgspec.Meta(pattern=r"^([0-9a-f]{64})?\Z")] = ""
    missing: list[str] = []

    def objects(self) -> dict[str, int]:
        """Addresses of all objects that it names, with their largest sizes."""
        keys = [self.keys] if self.keys else []
        pieces = dict.fromkeys([*keys, *(piece for pieces in self.files.values() for piece in pieces)], PIECE_BYTES)
        return {**pieces, **self.blobs}


class BackupTarget:
    """Objects and snapshots under one URL or in one folder, created if needed. Raises StoreError if it cannot be reached."""

    def __init__(self, where: str, *, create: bool = False) -> None:
        if "://" not in where and not create and not (Path(where) / _SNAPSHOTS).is_dir():
            raise UsageError(f"{where} holds no backups; `mapserver backup {where} --store DIR` makes one")
        self.where, self._objects = where, open_objects(where)
        self.blobs = Blobs(self._objects, "objects")

    def snapshots(self) -> list[str]:
        """Return the names of all snapshots, oldest first."""
        return sorted(name for name in self._names(_SNAPSHOTS) if _NAME.fullmatch(name))

    def read(self, name: str | None = None) -> tuple[str, Snapshot]:
        """Return a snapshot, the newest for None, with its name. UsageError for an unknown one, MapFormatError for a damaged one."""
        names = self.snapshots()
        name = names[-1] if name is None and names else name
        if name not in names:
            raise UsageError(
                f"{self.where} has no snapshot {name or 'at all'}; it has {', '.join(names[-5:]) or 'none'}"
            )
        if (size := self._objects.size(path := f"{_SNAPSHOTS}/{name}.json") or 0) > _MOST_BYTES:
            raise MapFormatError(f"snapshot {name} has {size} bytes, the limit is {_MOST_BYTES}")
        refusal = f"snapshot {name} is damaged ({{}}); take an earlier one with --snapshot"
        found = decode_json(b"".join(self._objects.chunks(path)), Snapshot, refusal)
        if found.format > FORMAT:
            raise NewerFormatError(
                f"snapshot {name} has format {found.format}, this fleetmap reads {FORMAT}; update it"
            )
        if unknown := [path for path in found.files if not NAMED.fullmatch(path)]:
            raise MapFormatError(f"snapshot {name} names the file {unknown[0][:200]!r}, which no store has")
        return name, found

    def write(self, snapshot: Snapshot, now: datetime) -> str:
        """Write a snapshot, whose objects are there, and return its name: the time, but later than all others, whatever the clock says."""
        moments = [datetime.strptime(name, _NAME_FORMAT).replace(tzinfo=UTC) for name in self.snapshots()[-1:]]
        name = max([now.astimezone(UTC), *(moment + timedelta(seconds=1) for moment in moments)]).strftime(_NAME_FORMAT)
        self._objects.put(f"{_SNAPSHOTS}/{name}.json", [to_json(snapshot)])
        return name

    def prune(self, keep: int, now_ns: int) -> list[str]:
        """Remove all but the newest `keep` snapshots, then objects that none names; return the names of the snapshots.

        Objects of the last day stay: they may belong to a backup under way. All of them stay beside a snapshot that cannot be read.
        """
        names = self.snapshots()
        for name in names[:-keep]:
            self._objects.remove(f"{_SNAPSHOTS}/{name}.json")
        try:
            kept = set[str]().union(*(self.read(name)[1].objects() for name in names[-keep:]))
        except FleetmapError:
            return names[:-keep]
        for address, changed_ns in self.blobs.changed_ns().items():
            if address not in kept and changed_ns < now_ns - _LONGEST_BACKUP_NS:
                self.blobs.remove(address)
        return names[:-keep]

    def count_restore(self) -> int:
        """Return the number of this restoration, from 1 on; no other one gets it. StoreError if the target cannot be written."""
        number = 1 + max((int(name) for name in self._names(_RESTORES) if re.fullmatch(r"[0-9]{1,6}", name)), default=0)
        if number > _MOST_RESTORES:
            raise StoreError(
                f"{self.where} counts {number - 1} restorations, which cannot be; look at {_RESTORES} there"
            )
        self._objects.put(f"{_RESTORES}/{number:06}", [b""], is_new=True)
        return number

    def note_root(self, number: int, root: int) -> None:
        """Keep the number of the newest root that a restoration signed."""
        self._objects.put(f"{_RESTORES}/{number:06}-root-{root}", [b""])

    def known_root(self, most: int) -> int:
        """Return the newest root of all restorations, 0 without any; StoreError for one above `most`."""
        found = [re.fullmatch(r"[0-9]{6}-root-([0-9]{1,4})", name) for name in self._names(_RESTORES)]
        newest = max((int(name[1]) for name in found if name is not None), default=0)
        if newest > most:
            raise StoreError(f"{self.where} counts {newest} roots, which cannot be; look at {_RESTORES} there")
        return newest

    def _names(self, prefix: str) -> list[str]:
        return [path.rpartition("/")[2].removesuffix(".json") for path, _, _ in self._objects.listed(prefix)]
