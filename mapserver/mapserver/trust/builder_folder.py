"""The builder's own record of what it built, in the folder of its keys: whoever can write into the database decides nothing by it.

KEYS/site-SITE.pem                   signs the lists of a site
KEYS/built/SITE-VERSION.json         addresses of a version that this account built, and whether the gate let it pass here
"""

from collections.abc import Sequence
from pathlib import Path

import msgspec

from fleetmap.encoding import to_json
from fleetmap.errors import StateError, StoreError, disk_errors
from fleetmap.trust import AdmittedVersion, SiteList
from mapserver.store import VersionInfo
from mapserver.store.files import make_folder, write_atomically
from mapserver.trust.keys import KeyFolder


class BuiltVersion(msgspec.Struct, frozen=True, kw_only=True):
    """What the builder knows of a version. archive: the survey that the next map is built on."""

    manifest: str
    manifest_bytes: int
    vocabulary: str
    archive: str | None
    passed: bool = False


class BuilderFolder:
    """The folder of one builder's account."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.keys = folder, KeyFolder(folder)

    def record(self, info: VersionInfo) -> None:
        """Keeps what was built; StoreError where the disk refuses."""
        self._write(
            info.site,
            info.version,
            BuiltVersion(
                manifest=info.manifest_sha256,
                manifest_bytes=info.manifest_bytes,
                vocabulary=info.vocabulary_sha256,
                archive=info.archive_sha256,
            ),
        )

    def note_passed(self, site: str, version: int) -> None:
        """Notes that the gate let a version pass, or a person of this account forced it; StateError for one built elsewhere."""
        self._write(site, version, msgspec.structs.replace(self.built(site, version), passed=True))

    def adopt(self, signed: SiteList, site: str) -> None:
        """Takes the versions of a signed list for own ones, where another account built them before."""
        for entry in signed.admitted:
            known = BuiltVersion(
                manifest=entry.sha256,
                manifest_bytes=entry.length,
                vocabulary=entry.about.vocabulary,
                archive=entry.about.archive,
                passed=True,
            )
            self._write(site, entry.about.version, known)

    def built(self, site: str, version: int) -> BuiltVersion:
        """What is known of a version; StateError for one that this account did not build, StoreError for a damaged record."""
        path = self._path(site, version)
        try:
            return msgspec.json.decode(path.read_bytes(), type=BuiltVersion)
        except FileNotFoundError as error:
            raise StateError(
                f"version {version} of site {site} was not built by this account ({self.folder}); build it here, or take "
                f"what was signed before with `mapserver signer --adopt {site} --keys {self.folder}`"
            ) from error
        except (OSError, msgspec.MsgspecError) as error:
            raise StoreError(f"{path} cannot be read ({error}); restore the builder's folder") from error

    def check(self, info: VersionInfo, *, to_release: bool = False) -> None:
        """Raises StateError where the database names other bytes for a version than were built here.

        to_release: also where the gate did not let it pass here.
        """
        built = self.built(info.site, info.version)
        told = (info.manifest_sha256, info.manifest_bytes, info.vocabulary_sha256)
        is_same = told == (built.manifest, built.manifest_bytes, built.vocabulary)
        if not is_same or info.archive_sha256 not in (built.archive, None):
            raise StateError(
                f"the database names other bytes for version {info.version} of site {info.site} than were built; "
                "restore the database, or find out who wrote into it"
            )
        if to_release and not built.passed:
            raise StateError(
                f"the gate did not let version {info.version} of site {info.site} pass when it was built; "
                f"`mapserver publish --site {info.site} --version {info.version} --keys KEYS` on the builder's account decides about it"
            )

    def check_entries(self, site: str, entries: Sequence[AdmittedVersion]) -> None:
        """Raises StateError unless everything that is about to be signed was built here and passed."""
        for entry in entries:
            built, about = self.built(site, entry.about.version), entry.about
            is_same = (entry.sha256, entry.length, about.vocabulary) == (
                built.manifest,
                built.manifest_bytes,
                built.vocabulary,
            )
            if not is_same or about.archive not in (built.archive, None) or not built.passed:
                raise StateError(
                    f"version {about.version} of site {site} is not signed: it is not what was built here, or did not pass"
                )

    def _path(self, site: str, version: int) -> Path:
        return self.folder / "built" / f"{site}-{version}.json"

    def _write(self, site: str, version: int, built: BuiltVersion) -> None:
        path = self._path(site, version)
        with disk_errors(f"{path} cannot be written", "check whose account this is, and the space"):
            make_folder(path.parent)
            write_atomically(path, [to_json(built)])
