"""Endpoints of releases: quality, differences, publishing, promoting, rolling back, canaries."""

import shlex
import time
from typing import Any, NamedTuple, cast

from fastapi import FastAPI, Request
from starlette.exceptions import HTTPException

from mapserver import releases
from mapserver.api import views
from mapserver.api.guard import GuardSettings, actor_of
from mapserver.api.parameters import Site, Version
from mapserver.fleet.alerts import AlertSettings
from mapserver.fleet.canary_controller import find
from mapserver.fleet.ingest import IngestSettings
from mapserver.fleet_statistics.canary_decision import CanarySettings, number_of
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings
from mapserver.quality.gate import GateSettings
from mapserver.releases import Difference
from mapserver.serving.night_runs import NightRuns
from mapserver.store import CanaryRow, MapStore, VersionInfo
from mapserver.trust.http_certificate import HttpCertificate


class ApiSettings(NamedTuple):
    """Settings of access, the gate, canaries, tiles, alerts and reports; the certificate of HTTP, webhook and inbox, None without one."""

    guard: GuardSettings = GuardSettings()
    gate: GateSettings = GateSettings()
    canary: CanarySettings = CanarySettings()
    resurvey: ResurveySettings = ResurveySettings()
    alerts: AlertSettings = AlertSettings()
    ingest: IngestSettings = IngestSettings()
    certificate: HttpCertificate | None = None
    webhook: Any = None
    nights: NightRuns | None = None


def install_version_routes(app: FastAPI, store: MapStore, settings: ApiSettings) -> None:
    """Add the endpoints; the guard checks the right to change versions."""

    @app.get("/v1/sites/{site}/versions/{version}/quality")
    def quality(site: Site, version: Version) -> views.QualityView:
        """Gate results of a version, and the report of its build."""
        info = store.version(site, version)
        report = store.manifest(site, version).report
        return views.QualityView(site, version, info.state, store.verdicts(site, version), store.trusted(info), report)

    @app.get("/v1/sites/{site}/versions/{before}/diff/{after}")
    def diff(site: Site, before: Version, after: Version) -> Difference:
        """Difference between two versions: tiles, landmarks, bytes to fetch, quality side by side."""
        return releases.difference(store, site, before, after)

    @app.post("/v1/sites/{site}/versions/{version}/publish")
    def publish(request: Request, site: Site, version: Version, act: views.PublishAct) -> views.VersionView:
        """Check a draft by the gate and make it current."""
        actor = actor_of(request, act.actor, act.reason)
        if act.trust_calibration:
            releases.trust_calibration(store, store.version(site, version), actor)
        releases.publish(store, site, version, actor=actor, force=act.force, gate=settings.gate)
        return views.version_view(store, store.version(site, version))

    @app.post("/v1/sites/{site}/versions/{version}/promote")
    def promote(request: Request, site: Site, version: Version, act: views.Act) -> views.VersionView:
        """Make an earlier published version current."""
        releases.promote(store, site, version, actor=actor_of(request, act.actor, act.reason))
        return views.version_view(store, store.version(site, version))

    @app.post("/v1/sites/{site}/rollback")
    def rollback(request: Request, site: Site, act: views.RollbackAct) -> views.VersionView:
        """Make the previous current version current again; the present one retires. A running canary is withdrawn instead."""
        actor = actor_of(request, act.actor, act.reason)
        releases.roll_back(store, site, to=act.to, canary=act.canary, actor=actor)
        return views.version_view(store, cast(VersionInfo, store.current(site)))

    @app.get("/v1/sites/{site}/canary")
    def canary(site: Site) -> views.CanaryView:
        """The latest canary version, with its counts beside those of the other robots."""
        store.current(site)
        found = store.canaries(site)
        if not found:
            raise HTTPException(
                404,
                f"site {site} never had a canary; `mapserver promote VERSION "
                f"--canary 5% --site {site} --store {shlex.quote(str(store.folder))}` starts one",
            )
        return _view(store, found[0], settings.canary)

    @app.post("/v1/sites/{site}/versions/{version}/canary")
    def start_canary(request: Request, site: Site, version: Version, act: views.CanaryAct) -> views.CanaryView:
        """Let a share of the robots run a version before the others; a draft goes through the gate first.

        `rollback` withdraws it, promoting it ends it early; otherwise the server decides by the failures of both groups.
        """
        share = settings.canary.share if act.share is None else act.share
        actor = actor_of(request, act.actor, act.reason)
        releases.start_canary(store, site, version, share, actor=actor, gate=settings.gate)
        return _view(store, store.canaries(site)[0], settings.canary)


def _view(store: MapStore, row: CanaryRow, settings: CanarySettings) -> views.CanaryView:
    members = [
        robot.robot for robot in store.robots(row.site) if number_of(row.site, row.version, robot.robot) < row.threshold
    ]
    return views.CanaryView(row, find(store, row, settings, time.time_ns()), members)
