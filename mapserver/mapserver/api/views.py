"""What the API shows, as its own types: the store may change its rows without changing an answer."""

from dataclasses import dataclass

from mapserver.fleet import RobotStatus
from mapserver.store import SiteInfo, VersionInfo


@dataclass(frozen=True, slots=True)
class SiteView:
    """A site and its current version, null before the first publication."""

    site: str
    current_version: int | None
    versions: int
    vocabulary_sha256: str | None

    @classmethod
    def of(cls, info: SiteInfo) -> "SiteView":
        """The view of a row."""
        return cls(info.site, info.current_version, info.versions, info.vocabulary_sha256)


@dataclass(frozen=True, slots=True)
class VersionView:
    """A version; map_bytes is what a robot downloads for the whole site, vocabulary apart."""

    site: str
    version: int
    state: str
    parent: int | None
    created: str
    manifest_sha256: str
    tiles: int
    landmarks: int
    map_bytes: int
    vocabulary_sha256: str
    vocabulary_bytes: int

    @classmethod
    def of(cls, info: VersionInfo) -> "VersionView":
        """The view of a row."""
        return cls(
            site=info.site,
            version=info.version,
            state=info.state,
            parent=info.parent,
            created=info.created,
            manifest_sha256=info.manifest_sha256,
            tiles=info.tiles,
            landmarks=info.landmarks,
            map_bytes=info.map_bytes,
            vocabulary_sha256=info.vocabulary_sha256,
            vocabulary_bytes=info.vocabulary_bytes,
        )


@dataclass(frozen=True, slots=True)
class SiteList:
    """All sites."""

    sites: list[SiteView]


@dataclass(frozen=True, slots=True)
class VersionList:
    """All versions of a site, oldest first."""

    versions: list[VersionView]


@dataclass(frozen=True, slots=True)
class RobotList:
    """All robots that ever reported."""

    robots: list[RobotStatus]


@dataclass(frozen=True, slots=True)
class ServerVersion:
    """What runs here, and the newest formats that it reads and writes."""

    fleetmap: str
    tile_format: int
    manifest_format: int


@dataclass(frozen=True, slots=True)
class State:
    """`ok`, or what is missing."""

    status: str
