"""Endpoints of the server itself: its state, active alerts, a test of the webhook."""

import time

from fastapi import FastAPI, Request
from starlette.exceptions import HTTPException

from fleetmap.errors import StateError
from mapserver.api import parameters as p
from mapserver.api import views
from mapserver.api.guard import actor_of
from mapserver.api.version_routes import ApiSettings
from mapserver.fleet.alerts import active_alerts
from mapserver.fleet.fleet import Fleet
from mapserver.serving.server_health import ServerHealth, server_health
from mapserver.store import MapStore


def install_server_routes(app: FastAPI, store: MapStore, fleet: Fleet, settings: ApiSettings) -> None:
    """Add the endpoints."""

    @app.get("/v1/server")
    def server() -> ServerHealth:
        """State of the server: version, disk, store, memory, days until certificates and signed lists expire, retention."""
        return server_health(store, fleet, settings.ingest, settings.certificate)

    @app.get("/v1/alerts")
    def alerts(limit: p.Limit = 100, cursor: p.NameCursor = None) -> views.AlertList:
        """Active alerts, by site, name and subject."""
        found = active_alerts(store, fleet, settings.alerts, time.time_ns())
        keyed = sorted((f"{alert.site}/{alert.name}/{alert.about}", alert) for alert in found)
        chosen = [(key, alert) for key, alert in keyed if cursor is None or key > cursor]
        shown, following = p.page(chosen, limit, lambda item: item[0])
        return views.AlertList([alert for _, alert in shown], following)

    @app.post("/v1/alerts/test")
    def test(request: Request, act: views.Act) -> views.AlertTest:
        """Send a test alert to the webhook and wait for its answer; 502 if it is not accepted, 409 without a webhook."""
        actor = actor_of(request, act.actor, act.reason)
        if settings.webhook is None:
            raise StateError(
                "no webhook is set: name its address as `webhook` in [alerts] of the server's configuration file, and restart the server"
            )
        is_accepted, answer = settings.webhook.test(time.time_ns())
        store.audit("alert_test", answer, actor=actor)
        if not is_accepted:
            raise HTTPException(502, f"{answer}; check `webhook` and `token_file` in [alerts], and the receiver")
        return views.AlertTest(answer)
