"""Parts of a store outside of its folder: bytes in an object store, metadata in PostgreSQL."""

from collections.abc import Callable

from fleetmap.errors import UsageError
from mapserver.store.database import Database


def open_postgres(url: str, clock_ns: Callable[[], int], *, create: bool) -> Database:
    """Return the database under a URL; UsageError without its library, other errors as of `PostgresDatabase`."""
    try:
        from mapserver.plugins.remote_stores.postgres import PostgresDatabase
    except ImportError as error:
        raise UsageError(f"a database in PostgreSQL needs {error.name}; install fleetmap[server,postgres]") from error
    return PostgresDatabase(url, clock_ns, create=create)
