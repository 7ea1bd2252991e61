"""Endpoints of a version as one file under a permanent address, its grid, expected views and changes; those of plug-ins."""

import base64
import hashlib
from collections.abc import Callable
from functools import lru_cache
from typing import Annotated, Any

import cv2
import numpy as np
from fastapi import FastAPI, Query, Request, Response
from starlette.exceptions import HTTPException
from starlette.responses import StreamingResponse

from fleetmap.errors import StateError
from fleetmap.mapformat import sha256_hex
from fleetmap.mapformat.version_file import ExportHead
from fleetmap.occupancy_grid import map_server_files
from fleetmap.version_grid import grid_of, occupancy
from mapserver.api.bytes_response import bytes_response
from mapserver.api.guard import address_of
from mapserver.api.parameters import NearPlace, Number, RobotHeight, Sha256, Site, Version, ViewPose
from mapserver.api.views import PictureList, PictureView
from mapserver.fleet.rate_limit import RateLimit
from mapserver.hooks import route_hooks
from mapserver.serving.expected_views import ExpectedViews, SurfelChanges, failure_camera, looking
from mapserver.store import MapStore
from mapserver.surfels.changes import Changes, changes_geojson, changes_png
from mapserver.surfels.expected_view import ExpectedView
from mapserver.surfels.survey_pictures import SurveyPicture, nearest_pictures

_DIGESTS_KEPT = 256
_VIEWS_AT_ONCE, _VIEWS_PER_S = 5, 1.0  # of one address: each costs a tenth of a second of CPU
_PAIRS_PER_S, _MOST_VIEWS = 0.2, 600  # versions compared: a twentieth of a second of CPU for each view of either


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

    def grid_file(request: Request, version: tuple[str, int], height_m: float, which: int) -> Response:
        grid = occupancy(grid_of(store.manifest(*version), store.blob), height_m)
        data = map_server_files(grid, "grid.pgm")[which]
        kind = ("application/yaml", "image/x-portable-graymap")[which]
        return bytes_response(request, data, sha256_hex(data), kind, immutable=True)

    @app.get("/v1/sites/{site}/versions/{version}/grid.yaml", response_class=Response)
    def grid_yaml(request: Request, site: Site, version: Version, robot_height_m: RobotHeight = 1.1) -> Response:
        """The planner grid in the format of nav2's map_server, for robots up to this height; its image is `grid.pgm`."""
        return grid_file(request, (site, version), robot_height_m, 0)

    @app.get("/v1/sites/{site}/versions/{version}/grid.pgm", response_class=Response)
    def grid_pgm(request: Request, site: Site, version: Version, robot_height_m: RobotHeight = 1.1) -> Response:
        """The image of `grid.yaml`."""
        return grid_file(request, (site, version), robot_height_m, 1)

    views, drawn = ExpectedViews(store), RateLimit(_VIEWS_AT_ONCE, _VIEWS_PER_S, store.now_ns)

    def answer(request: Request, draw: Callable[[], ExpectedView]) -> Response:
        if not drawn.admits(address_of(request.scope)):
            raise HTTPException(429, "too many requests for views; wait a second", {"Retry-After": "1"})
        view = draw()
        alpha = np.where(view.unknown, np.uint8(0), np.uint8(255))
        png = cv2.imencode(".png", np.dstack([view.picture] * 3 + [alpha]))[1].tobytes()
        return bytes_response(request, png, sha256_hex(png), "image/png", immutable=False)

    @app.get("/v1/sites/{site}/versions/{version}/view.png", response_class=Response)
    def view_png(request: Request, site: Site, version: Version, camera: Annotated[ViewPose, Query()]) -> Response:
        """Expected image of the survey's camera at a pose, drawn from the version's surfels; transparent where the map has no data."""
        store.version(site, version)
        place = looking((camera.x_m, camera.y_m, camera.z_m), camera.yaw_deg, camera.pitch_deg)
        return answer(request, lambda: views.view(site, version, place, width_px=camera.width_px))

    @app.get("/v1/sites/{site}/versions/{version}/pictures")
    def pictures(site: Site, version: Version, near: Annotated[NearPlace, Query()]) -> PictureList:
        """Pictures of the surveys, nearest to a place first; 409 for a version that keeps none."""
        looks = None if near.yaw_deg is None else looking((0, 0, 0), near.yaw_deg, 0)[:3, 2]
        found = nearest_pictures(store.survey_pictures(site, version), np.array([near.x_m, near.y_m, near.z_m]), looks)
        return PictureList([_picture_view(*one) for one in found[: near.limit]])

    @app.get("/v1/sites/{site}/versions/{version}/pictures/{sha256}", response_class=Response)
    def picture(request: Request, site: Site, version: Version, sha256: Sha256) -> Response:
        """One of these pictures, a grey JPEG of at most 320 pixels."""
        if not any(one.sha256 == sha256 for one in store.survey_pictures(site, version)):
            raise HTTPException(404, f"version {version} of site {site} has no picture {sha256}")
        return bytes_response(request, store.blob(sha256), sha256, "image/jpeg", immutable=True)

    changes, compared = SurfelChanges(store, _MOST_VIEWS), RateLimit(_VIEWS_AT_ONCE, _PAIRS_PER_S, store.now_ns)

    def changed(request: Request, site: str, before: int, after: int) -> Changes:
        if not compared.admits(address_of(request.scope)):
            raise HTTPException(429, "too many comparisons of versions; wait 5 seconds", {"Retry-After": "5"})
        return changes.between(site, before, after)

    @app.get("/v1/sites/{site}/versions/{before}/diff/{after}/changes.png", response_class=Response)
    def changes_plan(request: Request, site: Site, before: Version, after: Version) -> Response:
        """Plan of appeared (blue) and vanished (orange) surfels, 0.1 m a pixel, y up; places seen by only one version are pale."""
        png = changes_png(changed(request, site, before, after))
        return bytes_response(request, png, sha256_hex(png), "image/png", immutable=False)

    @app.get("/v1/sites/{site}/versions/{before}/diff/{after}/changes.geojson")
    def changes_patches(request: Request, site: Site, before: Version, after: Version) -> dict[str, Any]:
        """The same changes as GeoJSON with metres in `map` instead of degrees: boxes with height and area."""
        return changes_geojson(changed(request, site, before, after))

    @app.get("/v1/failures/{number}/expected.png", response_class=Response)
    def expected(request: Request, number: Number) -> Response:
        """Expected image of a robot's camera at its estimated pose when the failure began; transparent where the map has no data."""
        report = store.fleet.failure(number).report
        version, map_from_cam, camera = failure_camera(report)
        return answer(request, lambda: views.view(report.site, version, map_from_cam, camera))

    for install in route_hooks().values():
        install(app, offered)


def _picture_view(one: SurveyPicture, distance_m: float) -> PictureView:
    (x, y, z), axis = one.place_map_m, np.array(one.looks_map)
    yaw_deg = float(np.degrees(np.arctan2(axis[1], axis[0])))
    pitch_deg = float(np.degrees(np.arcsin(np.clip(-axis[2], -1.0, 1.0))))
    angles = round(yaw_deg, 1), round(pitch_deg, 1)
    return PictureView(one.sha256, x, y, z, *angles, round(distance_m, 3), one.stamp_ns, one.recording)
