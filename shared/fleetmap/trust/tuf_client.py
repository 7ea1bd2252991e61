"""The update of a folder of signed lists by python-tuf's client, which follows the client workflow of the TUF specification.

Slow to import (150 ms): only where a list is fetched.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

from tuf.api.exceptions import (
    BadVersionNumberError,
    DownloadError,
    DownloadHTTPError,
    DownloadLengthMismatchError,
    ExpiredMetadataError,
    RepositoryError,
)
from tuf.ngclient import FetcherInterface, Updater, UpdaterConfig

from fleetmap.errors import FleetmapError, UnreachableError, UntrustedError
from fleetmap.trust.site_list import manifest_target

CLIENT_LIMITS = UpdaterConfig(
    max_root_rotations=64,
    max_delegations=4,
    root_max_length=64_000,
    timestamp_max_length=4_000,
    snapshot_max_length=64_000,
    targets_max_length=256_000,
)


class ListFetcher(FetcherInterface):
    """Fetches by a function that returns the bytes of a file, None where the other side says that it has none.

    Only that ends the chain of roots. Silence must not: it would make an old root the newest one.
    """

    def __init__(self, ask: Callable[[str], bytes | None]) -> None:
        self._ask = ask
        self.fault: FleetmapError | None = None

    def _fetch(self, url: str) -> Iterator[bytes]:
        name = self._name(url)
        try:
            data = self._ask(name)
        except FleetmapError as error:
            self.fault = error
            raise DownloadError(str(error)) from error
        if data is None:
            raise DownloadHTTPError(f"the server has no {name}", 404)
        return iter([data])

    def _name(self, url: str) -> str:
        return url.rpartition("/")[2]


def update_lists(folder: Path, site: str, root: bytes, ask: Callable[[str], bytes | None]) -> None:
    """Brings root, timestamp, snapshot, targets and the site's list in `folder` up to date. What was verified stays if this fails.

    root: the one that is trusted from the beginning; the folder's own is not believed without it.

    Raises UntrustedError for what must not be believed, UnreachableError and other errors of `ask`, OSError of the disk.
    """
    fetcher = ListFetcher(ask)
    try:
        updater = Updater(str(folder), "bus://trust/", fetcher=fetcher, config=CLIENT_LIMITS, bootstrap=root)
        updater.refresh()
        # A role comes with a target of it alone; nobody has a version 0.
        updater.get_targetinfo(manifest_target(site, 0))
    except ExpiredMetadataError as error:
        raise UntrustedError("freeze", error) from error
    except DownloadLengthMismatchError as error:
        raise UntrustedError("size", error) from error
    except DownloadHTTPError as error:
        raise UntrustedError("freeze", error) from error
    except DownloadError as error:
        raise fetcher.fault or UnreachableError(str(error)) from error
    except BadVersionNumberError as error:
        raise UntrustedError("rollback", error) from error
    except (RepositoryError, ValueError) as error:
        raise UntrustedError("signature", error) from error
