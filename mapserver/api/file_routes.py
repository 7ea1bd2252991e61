"""Endpoint of a version as one file under a permanent address; those of plug-ins."""

import base64
import hashlib
from functools import lru_cache

from fastapi import FastAPI, Request, Response
from starlette.responses import StreamingResponse

from fleetmap.errors import StateError
from fleetmap.mapformat.version_file import ExportHead
from mapserver.api.parameters import Site, Version
from mapserver.hooks import route_hooks
from mapserver.store import MapStore

_DIGESTS_KEPT = 256


def install_file_routes(app: FastAPI, store: MapStore) -> None:
    """Add the endpoints."""

    @lru_cache(maxsize=_DIGESTS_KEPT)
    def digest(_manifest_sha256: str, site: str, version: int) -> bytes:
        """SHA-256 of the file. Cached: the manifest's hash determines it."""
        whole = hashlib.sha256()
        for chunk in store.version_file(site, version)[1]():
            whole.update(chunk)
        return whole.digest()

    def offered(site: str, version: int) -> tuple[ExportHead, bytes]:
        info = store.version(site, version)
        if info.state == "draft":
            raise StateError(f"version {version} of site {site} is a draft; publish it before robots may have it")
        return store.version_file(site, version)[0], digest(info.manifest_sha256, site, version)

    @app.head("/v1/sites/{site}/versions/{version}/file", response_class=Response, include_in_schema=False)
    @app.get("/v1/sites/{site}/versions/{version}/file", response_class=Response)
    def file(request: Request, site: Site, version: Version) -> Response:
        """A published version as one file, byte by byte the same every time; its SHA-256 is the ETag."""
        head, sha256 = offered(site, version)
        headers = {
            "ETag": f'"{sha256.hex()}"',
            "Repr-Digest": f"sha-256=:{base64.b64encode(sha256).decode()}:",
            "Cache-Control": "public, max-age=31536000, immutable",
            "Content-Disposition": f'attachment; filename="{site}-{version}.fmex"',
        }
        if request.headers.get("if-none-match") == headers["ETag"]:
            return Response(status_code=304, headers=headers)
        headers["Content-Length"] = str(head.file_bytes())
        if request.method == "HEAD":
            return Response(headers=headers, media_type="application/octet-stream")
        chunks = store.version_file(site, version)[1]()
        return StreamingResponse(chunks, headers=headers, media_type="application/octet-stream")

    for install in route_hooks().values():
        install(app, store, offered)
