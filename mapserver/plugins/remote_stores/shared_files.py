"""Files in the folders of servers that share a store in PostgreSQL: signed lists, enrolled robots. The database has the present ones.

Beside them it has who is connected to which server.
"""

import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from fleetmap.encoding import to_json
from fleetmap.errors import BusyError, disk_errors
from fleetmap.files import write_atomically
from fleetmap.mapformat.names import sha256_hex
from mapserver.store.database import Database, StoreFiles, Transaction
from mapserver.store.files import is_plain_file, make_folder

_SHARED = {"trust": "*.json", "keys": "robots.json"}
"""By folder, what its files are called."""
_LATE = ("1.root.json", "timestamp.json")  # they announce the others
_CONNECTIONS = "connections"  # under each server's own name
_PRESENT_NS = 12_000_000_000  # two of its turns; then the server is gone


class SharedFiles(StoreFiles):
    """Files that are copied to and from the database. Raises StoreError if disk or database refuse."""

    def __init__(self, root: Path, database: Database) -> None:
        super().__init__(root, database)
        self._server = f"{_CONNECTIONS}/{secrets.token_hex(8)}"

    @contextmanager
    def changing(self, folder: str) -> Iterator[Path]:
        """As of `StoreFiles`: robots see nothing of the change before the database has it."""
        with super().changing(folder):
            self._take(folder)
            with TemporaryDirectory() as draft:
                make_folder(Path(draft) / folder)
                for name in self._hashes(self._root, folder):
                    shutil.copy(self._root / folder / name, Path(draft) / folder)
                yield Path(draft)
                here, there = self._hashes(Path(draft), folder), self._there(folder)
                with self._database.write() as change:
                    for name in there.keys() - here.keys():
                        change.execute("DELETE FROM shared_files WHERE name = ?", (f"{folder}/{name}",))
                    for name in (name for name in here if here[name] != there.get(name)):
                        _keep(change, f"{folder}/{name}", (Path(draft) / folder / name).read_bytes())
            self._take(folder)

    def share(self) -> None:
        for folder in (folder for folder in _SHARED if (self._root / folder).is_dir()):
            with self.changing(folder):
                pass

    def follow(self) -> None:
        for folder in _SHARED:
            if self._differing(folder):
                with suppress(BusyError), self._database.locked(f"{folder}/lock", waits=False):
                    self._take(folder)

    def connected(self, here: Sequence[str]) -> list[str]:
        now_ns, found, gone = self._database.now_ns(), list[str](), list[str]()
        query = "SELECT name, data FROM shared_files WHERE name LIKE ? AND name <> ?"
        for row in self._database.query(query, (f"{_CONNECTIONS}/%", self._server)):
            stamp_ns, certificates = msgspec.json.decode(row["data"], type=tuple[int, list[str]])
            if abs(now_ns - stamp_ns) <= _PRESENT_NS:
                found += certificates
            else:
                gone.append(row["name"])
        with self._database.write(durable=False) as change:
            _keep(change, self._server, to_json((now_ns, list(here))))
            for name in gone:
                change.execute("DELETE FROM shared_files WHERE name = ?", (name,))
        return found

    def _take(self, folder: str) -> None:
        differing = self._differing(folder)
        for name in sorted(differing, key=lambda name: (name in _LATE and 1 + _LATE.index(name), name)):
            path = self._root / folder / name
            with disk_errors(f"{path} cannot be written", "check the folder"):
                if differing[name]:
                    make_folder(path.parent)
                    query = "SELECT data FROM shared_files WHERE name = ?"
                    write_atomically(path, [bytes(self._database.value(query, (f"{folder}/{name}",)))])
                else:
                    path.unlink(missing_ok=True)

    def _differing(self, folder: str) -> dict[str, bool]:
        """Return names of files that are not as in the database, and whether they are there; none before the first change."""
        there = self._there(folder)
        here = self._hashes(self._root, folder) if there else {}
        return {name: name in there for name in here.keys() | there.keys() if here.get(name) != there.get(name)}

    def _hashes(self, root: Path, folder: str) -> dict[str, str]:
        with disk_errors(f"{root / folder} cannot be read", "check the folder"):
            paths = [path for path in (root / folder).glob(_SHARED[folder]) if is_plain_file(path)]
            return {path.name: sha256_hex(path.read_bytes()) for path in paths if not path.name.startswith(".")}

    def _there(self, folder: str) -> dict[str, str]:
        rows = self._database.query("SELECT name, sha256 FROM shared_files WHERE name LIKE ?", (f"{folder}/%",))
        return {row["name"].partition("/")[2]: row["sha256"] for row in rows}


def _keep(change: Transaction, name: str, data: bytes) -> None:
    otherwise = "ON CONFLICT (name) DO UPDATE SET sha256 = excluded.sha256, data = excluded.data"
    change.insert("shared_files", [{"name": name, "sha256": sha256_hex(data), "data": data}], otherwise)
