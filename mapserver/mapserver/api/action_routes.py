"""What follows from the fleet's health: versions tried by some robots first, tiles to survey again."""

import time
from dataclasses import dataclass
from typing import Any

from fastapi import Depends, FastAPI
from starlette.exceptions import HTTPException

from mapserver import releases
from mapserver.api.fleet_views import CanaryAct, CanaryView
from mapserver.api.parameters import Site, Version
from mapserver.api.writers import Writers, checked_by
from mapserver.fleet.canary_controller import find
from mapserver.fleet.resurvey_list import ResurveyList, resurvey_list
from mapserver.fleet_statistics.canary_test import CanarySettings, number_of
from mapserver.fleet_statistics.resurvey_test import ResurveySettings, route_geojson
from mapserver.quality.gate import GateSettings
from mapserver.store import CanaryRow, MapStore


@dataclass(frozen=True, slots=True)
class ActionSettings:
    """How drafts, canaries and tiles are judged."""

    gate: GateSettings
    canary: CanarySettings
    resurvey: ResurveySettings


def install_action_routes(app: FastAPI, store: MapStore, writers: Writers, settings: ActionSettings) -> None:
    """Adds the endpoints; those that change something ask `writers`."""

    @app.get("/v1/sites/{site}/canary")
    def canary(site: Site) -> CanaryView:
        """The version that some robots try, or tried last, beside the others' counts."""
        store.current(site)
        found = store.canaries(site)
        if not found:
            raise HTTPException(404, f"site {site} never had a canary; `mapserver promote --canary 5%` begins one")
        return _view(store, found[0], settings.canary)

    @app.post("/v1/sites/{site}/versions/{version}/canary", dependencies=[Depends(checked_by(writers))])
    def start(site: Site, version: Version, act: CanaryAct) -> CanaryView:
        """Lets a share of the robots run a version before the others; a draft goes through the gate first.

        `rollback` takes it back, promoting it ends it early; otherwise the server decides by the failures of both sides.
        """
        share = settings.canary.share if act.share is None else act.share
        begun = releases.start_canary(store, site, version, share, actor=act.who(), gate=settings.gate)
        return _view(store, begun, settings.canary)

    @app.get("/v1/sites/{site}/resurvey")
    def resurvey(site: Site) -> ResurveyList:
        """Tiles to survey again, the worst first, each with its reasons, and a route through them."""
        return resurvey_list(store, site, settings.resurvey, time.time_ns())

    @app.get("/v1/sites/{site}/resurvey/route")
    def resurvey_route(site: Site) -> dict[str, Any]:
        """The route as GeoJSON, metres in `map` in the place of degrees."""
        found = resurvey_list(store, site, settings.resurvey, time.time_ns())
        return route_geojson(site, found.version or 0, found.route)


def _view(store: MapStore, row: CanaryRow, settings: CanarySettings) -> CanaryView:
    members = [
        robot.robot for robot in store.robots(row.site) if number_of(row.site, row.version, robot.robot) < row.threshold
    ]
    return CanaryView(row, find(store, row, settings, time.time_ns()), members)
