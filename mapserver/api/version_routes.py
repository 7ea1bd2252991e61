"""Endpoints of sites, versions and their bytes, of their quality and of canaries."""

import base64
import hashlib
import shlex
from functools import lru_cache

from fastapi import APIRouter, Request, Response
from starlette.exceptions import HTTPException
from starlette.responses import StreamingResponse

from fleetmap.errors import StateError
from fleetmap.mapformat.version_file import ExportHead
from mapserver import releases
from mapserver.api import parameters as p
from mapserver.api import views
from mapserver.api.bytes_response import bytes_response, is_held
from mapserver.releases.version_diff import Difference
from mapserver.store import Event, MapStore, SiteInfo

_DIGESTS_KEPT = 256
router = APIRouter()


@router.get("/v1/sites")
def sites(store: p.Store, page: p.NamePage) -> views.Page[SiteInfo]:
    """Sites by name."""
    return page.of(store.sites(), lambda info: info.site)


@router.get("/v1/sites/{site}/versions")
def versions(service: p.Service, site: p.Site, page: p.NumberPage) -> views.Page[views.VersionView]:
    """Versions of a site, oldest first, drafts too."""
    found = service.store.versions(site, after=page.cursor or 0, limit=page.limit + 1)
    shown = [views.VersionView.of(service, info) for info in found]
    return page.of(shown, lambda info: info.version)


@router.get("/v1/sites/{site}/events")
def events(store: p.Store, site: p.Site, within: p.TimeRange, page: p.NumberPage) -> views.Page[Event]:
    """Events of a site, oldest first: actor, action, time and reason."""
    store.current(site)  # raises for an unknown site
    found = store.events(site, within, after=page.cursor or 0, limit=page.limit + 1)
    return page.of(found, lambda event: event.id)


@router.get("/v1/sites/{site}/versions/{version}", response_class=Response)
def manifest(request: Request, store: p.Store, site: p.Site, version: p.Version) -> Response:
    """The manifest of a version, byte by byte as robots verify it."""
    sha256 = store.version(site, version).manifest_sha256
    return bytes_response(request, store.blob(sha256), sha256, "application/json", immutable=True)


@router.get("/v1/sites/{site}/current")
def current(service: p.Service, site: p.Site) -> views.VersionView:
    """The current version of a site."""
    info = service.store.current(site)
    if info is None:
        raise HTTPException(
            404,
            f"site {site} has no published version; "
            f"publish one with `mapserver publish --site {site} --store {shlex.quote(str(service.store.folder))}`",
        )
    return views.VersionView.of(service, info)


@router.head("/v1/tiles/{sha256}", response_class=Response, include_in_schema=False)
@router.get("/v1/tiles/{sha256}", response_class=Response)
def tile(request: Request, store: p.Store, sha256: p.Sha256) -> Response:
    """The bytes of a tile."""
    return _blob(request, store, sha256, "tile")


@router.head("/v1/vocabularies/{sha256}", response_class=Response, include_in_schema=False)
@router.get("/v1/vocabularies/{sha256}", response_class=Response)
def vocabulary(request: Request, store: p.Store, sha256: p.Sha256) -> Response:
    """The bytes of a vocabulary."""
    return _blob(request, store, sha256, "vocabulary")


def _blob(request: Request, store: MapStore, sha256: str, kind: str) -> Response:
    if store.served_kind(sha256) != kind:
        raise HTTPException(404, f"no published {kind} has SHA-256 {sha256}")
    return bytes_response(request, store.blob(sha256), sha256, "application/octet-stream", immutable=True)


@lru_cache(maxsize=_DIGESTS_KEPT)
def _digest(store: MapStore, _manifest_sha256: str, site: str, version: int) -> bytes:
    """SHA-256 of the file of a version. Cached: the manifest's hash determines it."""
    whole = hashlib.sha256()
    for chunk in store.version_file(site, version)[1]():
        whole.update(chunk)
    return whole.digest()


def offered_file(store: MapStore, site: str, version: int) -> tuple[ExportHead, bytes]:
    """Return head and SHA-256 of the file of a version; StateError for a draft."""
    info = store.version(site, version)
    if info.state == "draft":
        raise StateError(f"version {version} of site {site} is a draft; publish it before robots may have it")
    return store.version_file(site, version)[0], _digest(store, info.manifest_sha256, site, version)


@router.head("/v1/sites/{site}/versions/{version}/file", response_class=Response, include_in_schema=False)
@router.get("/v1/sites/{site}/versions/{version}/file", response_class=Response)
def version_file(request: Request, store: p.Store, site: p.Site, version: p.Version) -> Response:
    """A published version as one file, byte by byte the same every time; its SHA-256 is the ETag."""
    head, sha256 = offered_file(store, site, version)
    headers = {
        "ETag": f'"{sha256.hex()}"',
        "Repr-Digest": f"sha-256=:{base64.b64encode(sha256).decode()}:",
        "Cache-Control": "public, max-age=31536000, immutable",
        "Content-Disposition": f'attachment; filename="{site}-{version}.fmex"',
    }
    if is_held(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    headers["Content-Length"] = str(head.file_bytes())
    if request.method == "HEAD":
        return Response(headers=headers, media_type="application/octet-stream")
    chunks = store.version_file(site, version)[1]()
    return StreamingResponse(chunks, headers=headers, media_type="application/octet-stream")


@router.get("/v1/sites/{site}/versions/{version}/quality")
def quality(store: p.Store, site: p.Site, version: p.Version) -> views.QualityView:
    """Gate results of a version, and the report of its build."""
    info = store.version(site, version)
    return views.QualityView(
        site=site,
        version=version,
        state=info.state,
        verdicts=store.verdicts(site, version),
        trusted_calibrations=store.trusted(info),
        report=store.manifest(site, version).report,
    )


@router.get("/v1/sites/{site}/versions/{before}/diff/{after}")
def difference(store: p.Store, site: p.Site, before: p.Version, after: p.Version) -> Difference:
    """Difference between two versions: tiles, landmarks, bytes to fetch, quality side by side."""
    return releases.difference(store, site, before, after)


@router.get("/v1/sites/{site}/canary")
def canary(service: p.Service, site: p.Site) -> views.CanaryView:
    """The latest canary version, with its counts beside those of the other robots."""
    store = service.store
    store.current(site)
    found = store.canaries(site)
    if not found:
        raise HTTPException(
            404,
            f"site {site} never had a canary; `mapserver promote VERSION "
            f"--canary 5% --site {site} --store {shlex.quote(str(store.folder))}` starts one",
        )
    return views.CanaryView.of(service, found[0])
