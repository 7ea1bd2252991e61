"""Files in the folders of servers that share a store in PostgreSQL: signed lists, enrolled robots. The database has the present ones."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from fleetmap.errors import BusyError, disk_errors
from fleetmap.files import write_atomically
from fleetmap.mapformat import sha256_hex
from mapserver.store.files import is_plain_file, make_folder
from mapserver.store.transactions import Transactions

SHARED = {"trust": "*.json", "keys": "robots.json"}
"""By folder, what its files are called."""
_LATE = ("1.root.json", "timestamp.json")  # they announce the others


class SharedFiles:
    """Files of a store's folder. With its database there, too, nothing is copied."""

    def __init__(self, root: Path, transactions: Transactions) -> None:
        self._root, self._transactions = root, transactions

    @contextmanager
    def changing(self, folder: str) -> Iterator[Path]:
        """Hold the lock of a folder for a change of its files below the yielded path.

        With several servers the change is that of all of them, or of none: robots see nothing of it before the database has it.
        """
        with self._transactions.locked(f"{folder}/lock"):
            if not self._transactions.is_shared:
                yield self._root
                return
            self._take(folder)
            with TemporaryDirectory() as draft:
                make_folder(Path(draft) / folder)
                for name in self._hashes(self._root, folder):
                    shutil.copy(self._root / folder / name, Path(draft) / folder)
                yield Path(draft)
                self._give(Path(draft), folder)
            self._take(folder)

    def follow(self) -> None:
        """Take what other servers changed. Raises StoreError if disk or database refuse."""
        for folder in SHARED:
            if self._differing(folder):
                with suppress(BusyError), self._transactions.locked(f"{folder}/lock", waits=False):
                    self._take(folder)

    def _take(self, folder: str) -> None:
        differing = self._differing(folder)
        for name in sorted(differing, key=lambda name: (name in _LATE and 1 + _LATE.index(name), name)):
            path = self._root / folder / name
            with disk_errors(f"{path} cannot be written", "check the folder"):
                if differing[name]:
                    make_folder(path.parent)
                    query = "SELECT data FROM shared_files WHERE name = ?"
                    write_atomically(path, [bytes(self._transactions.query(query, (f"{folder}/{name}",))[0]["data"])])
                else:
                    path.unlink(missing_ok=True)

    def _give(self, draft: Path, folder: str) -> None:
        here, there = self._hashes(draft, folder), self._there(folder)
        with self._transactions.write() as connection:
            for name in there.keys() - here.keys():
                connection.execute("DELETE FROM shared_files WHERE name = ?", (f"{folder}/{name}",))
            for name in (name for name in here if here[name] != there.get(name)):
                connection.execute(
                    """INSERT INTO shared_files (name, sha256, data) VALUES (?, ?, ?)
                       ON CONFLICT (name) DO UPDATE SET sha256 = excluded.sha256, data = excluded.data""",
                    (f"{folder}/{name}", here[name], (draft / folder / name).read_bytes()),
                )

    def _differing(self, folder: str) -> dict[str, bool]:
        """Return names of files that are not as in the database, and whether they are there; none before the first change."""
        there = self._there(folder) if self._transactions.is_shared else {}
        here = self._hashes(self._root, folder) if there else {}
        return {name: name in there for name in here.keys() | there.keys() if here.get(name) != there.get(name)}

    def _hashes(self, root: Path, folder: str) -> dict[str, str]:
        with disk_errors(f"{root / folder} cannot be read", "check the folder"):
            paths = [path for path in (root / folder).glob(SHARED[folder]) if is_plain_file(path)]
            return {path.name: sha256_hex(path.read_bytes()) for path in paths if not path.name.startswith(".")}

    def _there(self, folder: str) -> dict[str, str]:
        rows = self._transactions.query("SELECT name, sha256 FROM shared_files")
        return {name: row["sha256"] for row in rows for at, _, name in [row["name"].partition("/")] if at == folder}
