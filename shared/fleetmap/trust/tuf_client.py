"""Update of a folder of signed lists by python-tuf's client, which follows the client workflow of the TUF specification.

Slow to import (150 ms): import it only to fetch a list.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

from tuf.api import exceptions
from tuf.ngclient import FetcherInterface, Updater, UpdaterConfig

from fleetmap.errors import FleetmapError, UnreachableError, UntrustedError
from fleetmap.trust.site_list import manifest_target

CLIENT_LIMITS = UpdaterConfig(
    max_root_rotations=1024,  # since the robot was made; a restoration of the server's store takes two
    max_delegations=4,
    root_max_length=64_000,
    timestamp_max_length=4_000,
    snapshot_max_length=64_000,
    targets_max_length=256_000,
)


class ListFetcher(FetcherInterface):
    """Fetches with a function that returns the bytes of a file, None if the server reports that it is absent.

    Only such a report ends the chain of roots. A missing reply must not: it would make an old root the newest one.
    """

    def __init__(self, ask: Callable[[str], bytes | None]) -> None:
        self._ask = ask
        self.fault: FleetmapError | None = None

    def _fetch(self, url: str) -> Iterator[bytes]:
        name = url.rpartition("/")[2]
        try:
            data = self._ask(name)
        except FleetmapError as error:
            self.fault = error
            raise exceptions.DownloadError(str(error)) from error
        if data is None:
            raise exceptions.DownloadHTTPError(f"the server has no {name}", 404)
        return iter([data])


def update_lists(folder: Path, site: str, root: bytes, ask: Callable[[str], bytes | None]) -> None:
    """Update root, timestamp, snapshot, targets and the site's list in `folder`. Verified files stay if this fails.

    root: the initially trusted root; the folder's own root is not trusted without it.

    Raises UntrustedError for invalid lists, UnreachableError and other errors of `ask`, OSError of the disk.
    """
    fetcher = ListFetcher(ask)
    try:
        updater = Updater(str(folder), "bus://trust/", fetcher=fetcher, config=CLIENT_LIMITS, bootstrap=root)
        updater.refresh()
        # python-tuf loads a role only with one of its targets; version 0 never exists.
        updater.get_targetinfo(manifest_target(site, 0))
    except (exceptions.ExpiredMetadataError, exceptions.DownloadHTTPError) as error:
        raise UntrustedError("freeze", error) from error
    except exceptions.DownloadLengthMismatchError as error:
        raise UntrustedError("size", error) from error
    except exceptions.DownloadError as error:
        raise fetcher.fault or UnreachableError(str(error)) from error
    except exceptions.BadVersionNumberError as error:
        raise UntrustedError("rollback", error) from error
    except (exceptions.RepositoryError, ValueError) as error:
        raise UntrustedError("signature", error) from error
