"""Why a version cannot show what its dense maps are for; None where it can."""

from collections.abc import Callable

from fleetmap.errors import FleetmapError
from fleetmap.messages import FailureReport
from mapserver.plugins.dense_maps.expected_views import failure_camera
from mapserver.plugins.dense_maps.surfel_map import index_address
from mapserver.store import MapStore


def lacks_view(store: MapStore, report: FailureReport) -> str | None:
    """Why it cannot be drawn what a robot should have seen when its failure began."""
    return _fault(lambda: index_address(store.manifest(report.site, failure_camera(report)[0])))


def lacks_surfels(store: MapStore, site: str, version: int) -> str | None:
    """Why a version has no map that renders."""
    return _fault(lambda: index_address(store.manifest(site, version)))


def lacks_pictures(store: MapStore, site: str, version: int) -> str | None:
    """Why a version keeps no pictures of its surveys."""
    return _fault(lambda: store.survey_pictures(site, version))


def _fault(read: Callable[[], object]) -> str | None:
    try:
        read()
    except FleetmapError as error:
        return str(error)
    return None
