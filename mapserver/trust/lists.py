"""The store's signed lists as files, in the robots' format.

STORE/trust/1.root.json 2.root.json ...        keys of each role; never removed, because robots follow them one by one
STORE/trust/N.targets.json                     keys of each site's list
STORE/trust/N.site-SITE.json                   the versions of a site allowed on robots
STORE/trust/N.snapshot.json timestamp.json     the present files of these
"""

import re
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fleetmap.errors import StoreError, UntrustedError, disk_errors
from fleetmap.messages import WantedVersion
from fleetmap.trust.site_list import SiteList, read_site_list, site_role
from mapserver.store.files import file_mark, is_plain_file

if TYPE_CHECKING:
    from tuf.api.metadata import DelegatedRole, Metadata

TIMESTAMP = "timestamp"
DAYS = {"root": 730, "targets": 365, "site": 14, "snapshot": 7, TIMESTAMP: 1}
_RENEWED_DAYS_BEFORE = {"site": 13, "snapshot": 3, TIMESTAMP: 0.75}  # every night, every four days, every six hours
_NAME = re.compile(r"(?:(timestamp)|[0-9]{1,10}\.(root|targets|snapshot|site-[a-z0-9_-]{1,64}))\.json")
_NUMBERED = re.compile(r"([0-9]{1,10})\.([a-z0-9_-]+)\.json")


def is_fresh(role: str, expires: datetime, now: datetime) -> bool:
    """True if a list (of `site`, `snapshot` or `timestamp`) need not be signed again.

    An expiry too far in the future was signed by a clock ahead: the list would be valid until then, even from an attacker.
    """
    return now + timedelta(days=_RENEWED_DAYS_BEFORE[role]) <= expires <= now + timedelta(days=DAYS[role], hours=1)


class SignedLists:
    """The folder of one store. Thread-safe; sees writes of other processes at once."""

    def __init__(self, store: Path) -> None:
        self.folder = store / "trust"
        self._known: tuple[object, dict[str, SiteList]] = (None, {})

    @property
    def are_there(self) -> bool:
        """True for signed maps; StoreError if the disk does not answer."""
        with disk_errors(f"{self.folder} cannot be looked at", "check the disk"):
            return (self.folder / "1.root.json").is_file()

    def file(self, site: str, name: str) -> bytes:
        """Return a file for the robots of a site; empty if absent."""
        named = _NAME.fullmatch(name)
        if named is None or ((named[2] or "").startswith("site-") and named[2] != site_role(site)):
            return b""
        path = self.folder / name
        try:
            return path.read_bytes() if is_plain_file(path) else b""
        except OSError:
            return b""

    def newest(self, role: str) -> int:
        return max(self.numbers(role), default=0)

    def numbers(self, role: str) -> list[int]:
        found = (_NUMBERED.fullmatch(path.name) for path in self.folder.glob(f"*.{role}.json"))
        return sorted(int(name[1]) for name in found if name is not None and name[2] == role)

    def metadata(self, role: str, number: int | None = None) -> "Metadata[Any]":
        """Return the newest file of a role, or that of this number; StoreError if unreadable. Signatures are not verified."""
        from tuf.api.exceptions import RepositoryError  # imported late: listing versions does not need it
        from tuf.api.metadata import Metadata

        path = self.path(role, self.newest(role) if number is None else number)
        try:
            return Metadata.from_bytes(path.read_bytes())
        except (OSError, RepositoryError) as error:
            raise StoreError(f"{path} cannot be read ({error}); restore the store's folder trust") from error

    def read(self, role: str, number: int | None = None) -> Any:
        """Return the content of that file: a Root, Targets, Snapshot or Timestamp of tuf. Errors as of `metadata`."""
        return self.metadata(role, number).signed

    def site_roles(self) -> "dict[str, DelegatedRole]":
        """Return the signing key role of each site, by the role's name, from the newest targets; errors as of `metadata`."""
        delegations = self.read("targets").delegations
        return {} if delegations is None else dict(delegations.roles)

    def is_signed(self, role: "DelegatedRole") -> bool:
        """True if a site's newest list has a signature of its present key, which is not verified."""
        try:
            signatures = self.metadata(role.name).signatures
        except StoreError:
            return False
        return any(keyid in role.keyids for keyid in signatures)

    def path(self, role: str, number: int) -> Path:
        return self.folder / (f"{TIMESTAMP}.json" if role == TIMESTAMP else f"{number}.{role}.json")

    def site_list(self, site: str, number: int) -> SiteList:
        """Return the list of this number; errors as of `read`."""
        path = self.path(site_role(site), number)
        try:
            return read_site_list(path.read_bytes(), site)
        except (OSError, UntrustedError) as error:
            raise StoreError(f"{path} cannot be read ({error}); restore the store's folder trust") from error

    def served(self, site: str) -> SiteList | None:
        """Return the present list for robots of a site; None before the first."""
        if (mark := file_mark(self.path(TIMESTAMP, 0))) is None:
            return None
        if self._known[0] != mark:
            self._known = (mark, {})
        known = self._known[1]
        if site not in known:
            snapshot = self.read("snapshot", self.read(TIMESTAMP).snapshot_meta.version)
            entry = snapshot.meta.get(f"{site_role(site)}.json")
            if entry is None:
                return None
            known[site] = self.site_list(site, entry.version)
        return known[site]

    def admitted_or_current(self, wanted: WantedVersion) -> WantedVersion:
        """Return the version sent to a robot: the wanted one if the list admits it, else the list's current one."""
        if not self.are_there or wanted.version is None:
            return wanted
        found = self.served(wanted.site)
        chosen = None if found is None else found.state("current")
        if found is None or chosen is None:
            return WantedVersion(site=wanted.site, version=None, manifest_sha256=None)
        if any(wanted.manifest_sha256 == entry.sha256 for entry in found.admitted):
            return wanted
        return WantedVersion(site=wanted.site, version=chosen.about.version, manifest_sha256=chosen.sha256)
