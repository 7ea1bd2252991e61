"""The page that shows a version in three dimensions, with the robots in it, and a walk through it beside the plan."""

import math

from fleetmap.errors import StateError, UsageError
from mapserver.dashboard.console import PageContext, Services, number, scene_of
from mapserver.dashboard.map_layers import Layer
from mapserver.dashboard.space.points import COARSEST_M, FINEST_M
from mapserver.dashboard.space.robot_views import robot_views


def page(services: Services, context: PageContext) -> dict[str, object]:
    """What the template needs."""
    maps, site = services.maps, context.site
    version = number(context.query.get("version"), "version")
    if version is None:
        version = maps.current_version(site)
    if version is None:
        raise StateError(f"site {site} has no published version; publish one, or name a draft")
    camera = maps.store.manifest(site, version).camera  # a version that is not there is named here
    lacks, lacks_pictures = maps.lacks_surfels(site, version), maps.lacks_pictures(site, version)
    loops, cameras = maps.loops(site, version), robot_views(services.health.cameras(site))
    return {
        "version": version,
        "scene": {
            "address": f"{context.root}/spaces/{site}/{version}.bin",
            "surfels": None if lacks else f"{context.root}/surfels/{site}/{version}.bin",
            "view": None if lacks else f"../v1/sites/{site}/versions/{version}/view.png",
            "pictures": None if lacks_pictures else f"../v1/sites/{site}/versions/{version}/pictures",
            "tangents": [side / 2 / camera.focal_px for side in (camera.width_px, camera.height_px)],
            "cameras": cameras,
            "loops": [[*loop.start_map_m, *loop.end_map_m, int(loop.is_accepted)] for loop in loops],
            "start": _start(context),
        },
        "plan": scene_of(services, context, version, [Layer("Where you stand")]),
        "lacks": lacks,
        "lacks_pictures": lacks_pictures,
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
