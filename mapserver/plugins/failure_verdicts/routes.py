"""Endpoints: the verdict on a failure, and how often each was given by tile or area."""

from typing import Literal

from fastapi import FastAPI

from mapserver.api import parameters as p
from mapserver.api.fleet_routes import Asked
from mapserver.hooks import OfferedFile
from mapserver.plugins.failure_verdicts.model import Verdict
from mapserver.plugins.failure_verdicts.verdicts import counted, judged
from mapserver.store import MapStore


def install(app: FastAPI, store: MapStore, _: OfferedFile) -> None:
    """Add the endpoints."""

    @app.get("/v1/failures/{number}/verdict")
    def failure_verdict(number: p.Number) -> Verdict:
        """Is the robot wrong, the building different, or does it look like another place? By what is known now."""
        return judged(store, [store.fleet.failure(number)])[0]

    @app.get("/v1/sites/{site}/verdicts")
    def site_verdicts(site: p.Site, span: Asked, by: Literal["tile", "area"] = "tile") -> dict[str, dict[str, int]]:
        """How often each verdict was given on the last 200 failures of a time, by tile or area."""
        store.current(site)  # raises for an unknown site
        return {key: dict(said) for key, said in counted(store, site, span, by).items()}
