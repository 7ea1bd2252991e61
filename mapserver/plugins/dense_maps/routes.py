"""Endpoints of a version's grid, expected views, pictures of the surveys, and changes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import numpy as np
from fastapi import FastAPI, Query, Request, Response
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException

from fleetmap.mapformat.names import sha256_hex
from fleetmap.version_grid import FLOOR_M, TOP_M, grid_of, map_server_files, occupancy
from mapserver.api.bytes_response import bytes_response
from mapserver.api.guard import address_of
from mapserver.api.parameters import Number, Sha256, Site, Version
from mapserver.fleet.rate_limit import RateLimit
from mapserver.hooks import OfferedFile
from mapserver.plugins.dense_maps.changes import Changes, changes_geojson, changes_png
from mapserver.plugins.dense_maps.expected_view import ExpectedView
from mapserver.plugins.dense_maps.expected_views import ExpectedViews, SurfelChanges, failure_camera, looking
from mapserver.plugins.dense_maps.survey_pictures import nearest_pictures
from mapserver.store import MapStore
from mapserver.store.survey_pictures import SurveyPicture

_VIEWS_AT_ONCE, _VIEWS_PER_S = 5, 1.0  # of one address: each costs a tenth of a second of CPU
_PAIRS_PER_S, _MOST_VIEWS = 0.2, 600  # versions compared: a twentieth of a second of CPU for each view of either
RobotHeight = Annotated[
    float, Query(gt=FLOOR_M, le=TOP_M, description="metres; higher objects are not obstacles", examples=[1.1])
]


class ViewPose(BaseModel):
    """Camera position and viewing direction in `map`."""

    x_m: float = Field(ge=-1e5, le=1e5, description="of the camera", examples=[1.5])
    y_m: float = Field(ge=-1e5, le=1e5, description="of the camera", examples=[2.0])
    z_m: float = Field(0.0, ge=-1e3, le=1e3, description="of the camera", examples=[0.5])
    yaw_deg: float = Field(ge=-360, le=360, description="counter-clockwise from x", examples=[90.0])
    pitch_deg: float = Field(0.0, ge=-90, le=90, description="downwards", examples=[0.0])
    width_px: int = Field(320, ge=16, le=640, description="of the picture", examples=[320])


class NearPlace(BaseModel):
    """A place in `map`, and the viewing direction there."""

    x_m: float = Field(ge=-1e5, le=1e5, description="of the place", examples=[1.5])
    y_m: float = Field(ge=-1e5, le=1e5, description="of the place", examples=[2.0])
    z_m: float = Field(0.0, ge=-1e3, le=1e3, description="of the place", examples=[0.5])
    yaw_deg: float | None = Field(
        None, ge=-360, le=360, description="pictures that look elsewhere come last", examples=[90.0]
    )
    limit: int = Field(1, ge=1, le=100, description="number of pictures", examples=[1])


@dataclass(frozen=True, slots=True)
class PictureView:
    """A picture of a survey: where its camera was and looked, in `map`, how far that is from the asked place, when and by which survey.

    taken_ns: of the recording's clock, which may count from another moment than 1970.
    """

    sha256: str
    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    pitch_deg: float
    distance_m: float
    taken_ns: int
    recording: str


@dataclass(frozen=True, slots=True)
class PictureList:
    """Pictures of the surveys of a version, those nearest to a place first."""

    pictures: list[PictureView]


def install(app: FastAPI, store: MapStore, _: OfferedFile) -> None:
    """Add the endpoints."""
    _install_grid(app, store)
    _install_views(app, store)
    _install_pictures(app, store)
    _install_changes(app, store)


def _install_grid(app: FastAPI, store: MapStore) -> None:
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


def _install_views(app: FastAPI, store: MapStore) -> None:
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

    @app.get("/v1/failures/{number}/expected.png", response_class=Response)
    def expected(request: Request, number: Number) -> Response:
        """Expected image of a robot's camera at its estimated pose when the failure began; transparent where the map has no data."""
        report = store.fleet.failure(number).report
        version, map_from_cam, camera = failure_camera(report)
        return answer(request, lambda: views.view(report.site, version, map_from_cam, camera))


def _install_pictures(app: FastAPI, store: MapStore) -> None:
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


def _install_changes(app: FastAPI, store: MapStore) -> None:
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


def _picture_view(one: SurveyPicture, distance_m: float) -> PictureView:
    (x, y, z), axis = one.place_map_m, np.array(one.looks_map)
    yaw_deg = float(np.degrees(np.arctan2(axis[1], axis[0])))
    pitch_deg = float(np.degrees(np.arcsin(np.clip(-axis[2], -1.0, 1.0))))
    angles = round(yaw_deg, 1), round(pitch_deg, 1)
    return PictureView(one.sha256, x, y, z, *angles, round(distance_m, 3), one.stamp_ns, one.recording)
