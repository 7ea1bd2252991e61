"""The report as a page that prints as a document to sign."""

from base64 import b64encode
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fleetmap.geometry import Array
from mapserver.dashboard import rendering
from mapserver.dashboard.plan import Plan
from mapserver.floor_plan.areas import Areas
from mapserver.plugins.acceptance.figures import Report
from mapserver.plugins.acceptance.verdict import ONE_WAY
from mapserver.quality.directions import HEADINGS

_WIDTH, _HEIGHT = 660.0, 560.0  # of the drawing; text is 11 high
_BARS_M = (1, 2, 5, 10, 20, 50, 100, 200)


class SitePlan(NamedTuple):
    """What is drawn: the map from above, areas, starts without a guess (x, y in `map`) by outcome, drives to add by place and heading."""

    seen: Plan
    areas: Areas
    starts: dict[str, Array]
    to_drive: list[tuple[Array, str]]


def html_page(report: Report, plan: SitePlan) -> str:
    """Return the report as one HTML file without links; equal reports give equal bytes."""
    template = rendering.TEMPLATES.from_string((Path(__file__).parent / "acceptance.html").read_text("utf-8"))
    return template.render(report=report, plan=_drawn(plan, has_drives=ONE_WAY not in report.promises))


def _drawn(plan: SitePlan, *, has_drives: bool) -> dict[str, Any]:
    """Return the plan's parts in units of the drawing, y down."""
    low, high = np.array(plan.seen.box[:2]), np.array(plan.seen.box[2:])
    per_m = float(min((_WIDTH, _HEIGHT) / (high - low)))

    def placed(points_m: Any) -> list[tuple[float, float]]:
        known = (point for point in np.reshape(points_m, (-1, 2)) if np.isfinite(point).all())
        return [(round((x - low[0]) * per_m, 1), round((high[1] - y) * per_m, 1)) for x, y in known]

    def path(rings: list[Array]) -> str:
        return "".join(f"M{' '.join(f'{x} {y}' for x, y in placed(ring))}Z" for ring in rings)

    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    tiles = [(corners + np.array([tile.x, tile.y])) * plan.seen.tile_size_m for tile in plan.seen.tiles]
    width, height = ((high - low) * per_m).tolist()
    bar_m = max((length for length in _BARS_M if length * per_m < width / 3), default=_BARS_M[0])
    return {
        "width": round(width, 1),
        "height": round(height, 1),
        "png": b64encode(plan.seen.png).decode(),
        "tiles": path(tiles),
        "areas": [
            (area.name, path(area.outlines), *placed([ring[:, 0].min(), ring[:, 1].max()]))
            for area in plan.areas.areas
            for ring in area.outlines[:1]
        ],
        "starts": {outcome: placed(places) for outcome, places in plan.starts.items()},
        "drives": [(*placed(place)[0], -45 * HEADINGS.index(facing)) for place, facing in plan.to_drive if has_drives],
        "bar_m": bar_m,
        "bar": round(bar_m * per_m, 1),
    }
