"""Places of a store's parts outside of its folder, by URL; the file DIR/places.json names them, absent if all is in the folder."""

from collections.abc import Callable
from pathlib import Path

import msgspec

from fleetmap.encoding import decode_json, to_json
from fleetmap.errors import UsageError, disk_errors
from fleetmap.files import write_atomically
from mapserver.hooks import open_url
from mapserver.store.blobs import FolderObjects, Objects
from mapserver.store.database import Database, SqliteDatabase

DATABASE = "store.sqlite3"
_FILE = "places.json"


class Places(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """content: URL of the object store with tiles, archives and pictures; database: of the database; None: in the folder."""

    content: str | None = None
    database: str | None = None


def read_places(root: Path) -> Places:
    """Return the places of the store in a folder; UsageError for an unreadable file."""
    path = root / _FILE
    with disk_errors(f"{path} cannot be read", "check its rights"):
        data = path.read_bytes() if path.is_file() else b"{}"
    return decode_json(
        data, Places, f"{path}: {{}}; `mapserver attach --store DIR --content URL` writes it", UsageError
    )


def write_places(root: Path, places: Places) -> None:
    """Replace the places; it is private, because a URL may hold a password. Raises StoreError on a disk error."""
    with disk_errors(f"{root / _FILE} cannot be written", "check the folder's space and rights"):
        write_atomically(root / _FILE, [to_json(places, indent=2)])


def open_objects(where: str | Path) -> Objects:
    """Return the objects in a folder or under a URL. Raises StoreError for a URL that cannot be opened."""
    if isinstance(where, Path) or "://" not in where:
        return FolderObjects(Path(where).absolute())
    opened: Objects = open_url("mapserver.objects", where, "an object store")(where)
    return opened


def open_database(
    root: Path, places: Places, clock_ns: Callable[[], int], *, create: bool, read_only: bool
) -> Database:
    """Return the database of a store, in its folder or under a URL; errors as of these."""
    if places.database is None:
        return SqliteDatabase(root / DATABASE, clock_ns, read_only=read_only)
    opens = open_url("mapserver.databases", places.database, "a store's database")
    opened: Database = opens(places.database, clock_ns, create=create)
    return opened
