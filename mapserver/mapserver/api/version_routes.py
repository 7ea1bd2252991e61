"""What operators do with versions: compare, judge, publish, promote, roll back."""

from fastapi import Depends, FastAPI

from mapserver import releases
from mapserver.api.parameters import Site, Version
from mapserver.api.views import Act, PublishAct, QualityView, VersionView
from mapserver.api.writers import Writers, checked_by
from mapserver.quality.gate import GateSettings
from mapserver.releases import Difference
from mapserver.store import MapStore


def install_version_routes(app: FastAPI, store: MapStore, writers: Writers, gate: GateSettings) -> None:
    """Adds the endpoints; those that change something ask `writers`."""
    allowed = [Depends(checked_by(writers))]

    @app.get("/v1/sites/{site}/versions/{version}/quality")
    def quality(site: Site, version: Version) -> QualityView:
        """What the gate said about a version, and the report of its build."""
        info = store.version(site, version)
        report = store.manifest(site, version).report
        return QualityView(site, version, info.state, store.verdicts(site, version), report)

    @app.get("/v1/sites/{site}/versions/{before}/diff/{after}")
    def diff(site: Site, before: Version, after: Version) -> Difference:
        """What changed between two versions: tiles, landmarks, bytes to fetch, quality side by side."""
        return releases.difference(store, site, before, after)

    @app.post("/v1/sites/{site}/versions/{version}/publish", dependencies=allowed)
    def publish(site: Site, version: Version, act: PublishAct) -> VersionView:
        """Takes a draft through the gate and makes it current."""
        releases.publish(store, site, version, actor=act.who(), force=act.force, gate=gate)
        return VersionView.of(store.version(site, version))

    @app.post("/v1/sites/{site}/versions/{version}/promote", dependencies=allowed)
    def promote(site: Site, version: Version, act: Act) -> VersionView:
        """Makes a version that was published before the current one."""
        releases.promote(store, site, version, actor=act.who())
        return VersionView.of(store.version(site, version))

    @app.post("/v1/sites/{site}/rollback", dependencies=allowed)
    def rollback(site: Site, act: Act) -> VersionView:
        """Makes the version current that was so before; the current one retires."""
        return VersionView.of(store.version(site, releases.roll_back(store, site, actor=act.who())))
