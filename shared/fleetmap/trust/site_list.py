"""The signed list of one site as values: versions that robots may run. Does not verify signatures. Pure."""

from datetime import datetime
from typing import Annotated, Literal

import msgspec

from fleetmap.errors import UntrustedError
from fleetmap.mapformat.manifest import Positive, Sha256
from fleetmap.mapformat.names import check_name


class VersionState(msgspec.Struct, frozen=True, kw_only=True):
    """The `custom` field of a target. state: of the version in its site; archive: the whole survey, for the next build.

    files: addresses of the site's further files, by kind (`fleetmap.mapformat.building`): they may change while the
    version stays.
    """

    version: Positive
    state: Literal["current", "previous", "trial"]
    vocabulary: Sha256
    archive: Sha256 | None = None
    files: dict[Annotated[str, msgspec.Meta(max_length=32)], Sha256] = {}


class _Hashes(msgspec.Struct, frozen=True):
    sha256: Sha256


class _Target(msgspec.Struct, frozen=True):
    length: Positive
    hashes: _Hashes
    custom: VersionState


class AdmittedVersion(msgspec.Struct, frozen=True):
    """A version that robots may run: its manifest's address and size, and its state in the site."""

    sha256: str
    length: int
    about: VersionState


class Signed(msgspec.Struct, frozen=True):
    """What is signed in every list."""

    version: Positive
    expires: datetime


class _SignedTargets(Signed, frozen=True):
    targets: dict[Annotated[str, msgspec.Meta(max_length=256)], _Target]


class _File(msgspec.Struct, frozen=True):
    signed: _SignedTargets


class SiteList(msgspec.Struct, frozen=True):
    """Content signed by the site's role. serial: counts its lists."""

    serial: int
    expires: datetime
    admitted: tuple[AdmittedVersion, ...]

    def state(self, name: str) -> AdmittedVersion | None:
        """The version that is `current`, `previous` or on `trial`; None if none is."""
        return next((entry for entry in self.admitted if entry.about.state == name), None)


def site_role(site: str) -> str:
    """Name of the role that signs a site's list. Prefixed, because a site may be named `root` or `snapshot`."""
    return f"site-{check_name(site, 'site')}"


def manifest_target(site: str, version: int | str) -> str:
    """Path of a version's manifest among the signed targets; '*' for any version."""
    return f"{site}/{version}/manifest.json"


def read_site_list(data: bytes, site: str) -> SiteList:
    """Read the list in the bytes of `N.site-SITE.json`; UntrustedError for a list with invalid targets."""
    try:
        signed = msgspec.json.decode(data, type=_File).signed
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise UntrustedError("signature", f"the list of site {site} cannot be read ({error})") from error
    for path, target in signed.targets.items():
        if path != manifest_target(site, target.custom.version):
            raise UntrustedError("signature", f"the list of site {site} names {path[:80]!r} as {target.custom}")
    entries = (AdmittedVersion(t.hashes.sha256, t.length, t.custom) for t in signed.targets.values())
    return SiteList(signed.version, signed.expires, tuple(sorted(entries, key=lambda entry: entry.about.version)))
