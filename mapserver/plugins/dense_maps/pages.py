"""The page in three dimensions, with the robots in it, and what the pages of failures and maps show of the dense maps."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from fastapi import Response
from markupsafe import Markup

from fleetmap.errors import FleetmapError, StateError, UsageError
from fleetmap.mapformat.tile import decode_tile
from fleetmap.messages import CameraNote, FailureReport
from mapserver.dashboard.console import Page, PageContext, Services, number, scene_of
from mapserver.dashboard.data import JOBS_SHOWN
from mapserver.dashboard.install import Host, file_response
from mapserver.dashboard.map_layers import Layer
from mapserver.dashboard.rendering import TEMPLATES
from mapserver.dashboard.survey_jobs import loops_of_version
from mapserver.plugins.dense_maps.expected_views import failure_camera, is_camera
from mapserver.plugins.dense_maps.space_points import COARSEST_M, FINEST_M, space_bytes, surfel_bytes
from mapserver.plugins.dense_maps.surfel_map import index_address, surfels_of
from mapserver.store import FailureRow, MapStore

_FOLDER = Path(__file__).parent
_PANELS: Any = TEMPLATES.from_string((_FOLDER / "panels.html").read_text("utf-8")).module


def install(host: Host) -> None:
    """Add the page, its files and the panels of other pages."""
    console, store = host.console, host.store
    console.files("parts/dense", _FOLDER / "static")
    template = TEMPLATES.from_string((_FOLDER / "space.html").read_text("utf-8"))
    console.page("space", Page(template, _space_page, under="map", knows=("version", "x", "y")))
    panels: dict[str, Any] = {"failure": _expected, "changes": _changes, "version": _link, "place": _link}
    for place, panel in panels.items():
        console.services.panels.setdefault(place, []).append(panel)

    @console.app.get("/spaces/{site}/{version}.bin")
    def space(site: str, version: int) -> Response:
        """Landmarks and places of a version; made at each call, since browsers keep it."""
        tiles = [decode_tile(store.blob(entry.sha256)) for entry in store.manifest(site, version).tiles]
        return file_response(space_bytes(tiles), "application/octet-stream")

    @console.app.get("/surfels/{site}/{version}.bin")
    def surfels(site: str, version: int) -> Response:
        """Surfels of a version."""
        found = surfels_of(store.manifest(site, version), store.blob)
        return file_response(surfel_bytes(found), "application/octet-stream")


def _expected(services: Services, context: PageContext, row: FailureRow, report: FailureReport) -> Markup:
    maps = services.maps.store
    lacks = _fault(lambda: index_address(maps.manifest(report.site, failure_camera(report)[0])))
    return Markup(_PANELS.expected(context.api, row.number, lacks))


def _changes(services: Services, context: PageContext, before: int, after: int) -> Markup:
    lacks = filter(None, (_lacks_surfels(services.maps.store, context.site, number) for number in (before, after)))
    return Markup(_PANELS.changes(context.api, context.site, before, after, next(lacks, None)))


def _link(_: Services, context: PageContext, version: int, *place_m: float) -> Markup:
    place = {axis: round(value, 2) for axis, value in zip("xy", place_m, strict=False)}
    return Markup(
        _PANELS.link(context.to("space", version=version, **place), f"3D view{' from there' if place else ''}")
    )


_FARTHEST_M = 20.0  # from the middle of a robot to its camera


def _space_page(services: Services, context: PageContext) -> dict[str, object]:
    """What the template needs."""
    maps, site = services.maps, context.site
    version = number(context.query.get("version"), "version")
    if version is None:
        version = maps.current_version(site)
    if version is None:
        raise StateError(f"site {site} has no published version; publish one, or name a draft")
    camera = maps.store.manifest(site, version).camera  # a version that is not there is named here
    lacks = _lacks_surfels(maps.store, site, version)
    no_pictures = _fault(lambda: maps.store.survey_pictures(site, version))
    # As far as a job that is kept tells them
    loops = loops_of_version((job.report for job in maps.store.jobs(site, limit=JOBS_SHOWN)), version)
    cameras = robot_views(services.health.cameras(site))
    return {
        "version": version,
        "scene": {
            "address": f"{context.root}/spaces/{site}/{version}.bin",
            "surfels": None if lacks else f"{context.root}/surfels/{site}/{version}.bin",
            "view": None if lacks else f"../v1/sites/{site}/versions/{version}/view.png",
            "pictures": None if no_pictures else f"../v1/sites/{site}/versions/{version}/pictures",
            "tangents": [side / 2 / camera.focal_px for side in (camera.width_px, camera.height_px)],
            "cameras": cameras,
            "loops": [[*loop.start_map_m, *loop.end_map_m, int(loop.is_accepted)] for loop in loops],
            "start": _start(context),
        },
        "plan": scene_of(services, context, version, [Layer("Where you stand")]),
        "lacks": lacks,
        "lacks_pictures": no_pictures,
        "own": len(cameras),
        "absent": {"loops", "refused loops", "surfels"}
        - {"loops" if loop.is_accepted else "refused loops" for loop in loops}
        - (set() if lacks else {"surfels"}),
        "exactness": f"{1e3 * FINEST_M:g} mm or better|{1e3 * COARSEST_M:g} mm or worse",
        "above": context.to("map", version=version),
    }


def _start(context: PageContext) -> tuple[float, float] | None:
    """Where the walk begins by the address; UsageError for what is no place."""
    given = [context.query.get(axis) for axis in "xy"]
    if given == [None, None]:
        return None
    try:
        x, y = (float(text or "") for text in given)
    except ValueError:
        x = y = math.nan
    if not math.isfinite(x) or not math.isfinite(y):
        raise UsageError(f"x={given[0]} and y={given[1]} are no place; write metres of the map")
    return x, y


def robot_views(cameras: Mapping[str, CameraNote]) -> dict[str, list[float]]:
    """By robot the tangents of the angles to the left, right, upper and lower edge in the camera's axes (x right, y down), and the upper
    three rows of base_from_cam, row by row. Robots that tell what no camera is, or one that is not on the robot, are left out."""
    found = {}
    for robot, camera in cameras.items():
        base_from_cam = camera.base_from_cam.target_from_source
        if is_camera(camera) and np.isfinite(base_from_cam).all() and np.abs(base_from_cam[:3, 3]).max() <= _FARTHEST_M:
            (width_px, height_px), (x_px, y_px), focal_px = camera.size_px, camera.centre_px, camera.focal_px
            edges_px = -x_px, width_px - x_px, -y_px, height_px - y_px
            tangents = [round(edge / focal_px, 4) for edge in edges_px]
            found[robot] = [*tangents, *base_from_cam[:3].ravel().round(4).tolist()]
    return found


def _lacks_surfels(store: MapStore, site: str, version: int) -> str | None:
    """Why a version has no map that renders."""
    return _fault(lambda: index_address(store.manifest(site, version)))


def _fault(read: Callable[[], object]) -> str | None:
    """Return why it cannot be shown what is read so, None if it can."""
    try:
        read()
    except FleetmapError as error:
        return str(error)
    return None
