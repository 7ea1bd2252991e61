"""What a VDA 5050 fleet manager needs to order a version: the parameters of its action `downloadMap`."""

from fastapi import FastAPI, Request

from mapserver.api.parameters import Site, Version
from mapserver.hooks import OfferedFile
from mapserver.store import MapStore


def install(app: FastAPI, _: MapStore, offered: OfferedFile) -> None:
    """Add the endpoint."""

    @app.get("/v1/sites/{site}/versions/{version}/vda5050")
    def vda5050(request: Request, site: Site, version: Version) -> dict[str, str]:
        """The parameters of VDA 5050's `downloadMap` for this version."""
        sha256 = offered(site, version)[1].hex()
        link = str(request.url.replace(path=f"/v1/sites/{site}/versions/{version}/file", query=""))
        return {"mapId": site, "mapVersion": str(version), "mapDownloadLink": link, "mapHash": sha256}
