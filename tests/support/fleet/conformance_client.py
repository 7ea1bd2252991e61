"""The robot's client of signed lists behind the command line that tuf-conformance drives: HTTP in the place of the bus.

`make conformance SUITE=PATH` runs it; PATH is a checkout of tuf-conformance, which is no package.
"""

import argparse
import shutil
import sys
import urllib.error
import urllib.request
from pathlib import Path

from tuf.ngclient import Updater

from fleetmap.errors import UnreachableError
from fleetmap.trust.tuf_client import CLIENT_LIMITS, ListFetcher


class HttpFetcher(ListFetcher):
    """Fetches whole addresses, where robots ask for names."""

    def __init__(self) -> None:
        super().__init__(self._get)

    def _name(self, url: str) -> str:
        return url

    @staticmethod
    def _get(url: str) -> bytes | None:
        try:
            with urllib.request.urlopen(url) as response:
                return bytes(response.read())
        except urllib.error.HTTPError as error:
            if error.code in (403, 404):
                return None
            raise UnreachableError(f"{url}: {error}") from error


def _given() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    for name in ("--metadata-url", "--metadata-dir", "--target-dir", "--target-base-url"):
        parser.add_argument(name)
    parser.add_argument("--target-name", action="append", default=[])
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("init").add_argument("root")
    for name in ("refresh", "download"):
        commands.add_parser(name)
    return parser.parse_args()


def main() -> int:
    given = _given()
    folder = given.metadata_dir
    if given.command == "init":
        shutil.copyfile(given.root, Path(folder, "root.json"))
        return 0
    where = (folder, given.metadata_url, given.target_dir, given.target_base_url)
    updater = Updater(*where, HttpFetcher(), CLIENT_LIMITS, bootstrap=None)
    updater.refresh()
    for name in given.target_name:
        target = updater.get_targetinfo(name)
        if target is None:
            return 1
        if not updater.find_cached_target(target):
            updater.download_target(target)
    return 0


if __name__ == "__main__":
    sys.exit(main())
