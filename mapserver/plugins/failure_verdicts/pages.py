"""What the page of a failure and the page of trends show of verdicts."""

import time
from pathlib import Path
from typing import Any

from markupsafe import Markup

from fleetmap.messages import FailureReport
from mapserver.api.moments import hours_within
from mapserver.dashboard.console import PageContext, Services
from mapserver.dashboard.fleet_health import WEEK_H
from mapserver.dashboard.install import Host
from mapserver.dashboard.map_layers import Layer, Mark, Square
from mapserver.dashboard.rendering import TEMPLATES
from mapserver.floor_plan.areas import OUTSIDE
from mapserver.plugins.failure_verdicts.model import SAYS
from mapserver.plugins.failure_verdicts.verdicts import counted, judged
from mapserver.store import FailureDetail, FailureRow

_PANELS: Any = TEMPLATES.from_string((Path(__file__).parent / "panels.html").read_text("utf-8")).module


def install(host: Host) -> None:
    """Add the panels."""
    panels: dict[str, Any] = {"answer": _verdict, "failure_map": _layers, "trends": _trends}
    for place, panel in panels.items():
        host.console.services.panels.setdefault(place, []).append(panel)


def _verdict(services: Services, _: PageContext, row: FailureRow, report: FailureReport) -> Markup:
    return Markup(_PANELS.verdict(judged(services.maps.store, [FailureDetail(row, report, [])])[0]))


def _layers(services: Services, _: PageContext, row: FailureRow, report: FailureReport) -> list[Layer]:
    """Cells without their landmarks, and the places that it looks like."""
    (said,) = judged(services.maps.store, [FailureDetail(row, report, [])])
    missing = [
        Square((x, y, x + 1.0, y + 1.0), "removed", "landmarks are missing here", 0.5) for x, y in said.missing_m
    ]
    alike = [Mark(*place, "warn", "triangle", "it looks like this place") for place in said.places_m]
    return [Layer(name, items) for name, items in (("Missing landmarks", missing), ("Look-alikes", alike)) if items]


def _trends(services: Services, context: PageContext) -> Markup:
    store, axis = services.maps.store, "area" if services.maps.store.areas(context.site) else "tile"
    hours = hours_within(*context.time_range(), time.time_ns(), WEEK_H)
    return Markup(_PANELS.trends(context, axis, counted(store, context.site, hours, axis), SAYS, OUTSIDE))
