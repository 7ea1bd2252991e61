"""The seconds around a failure, to be stepped through: picture, state and place of every moment. All of it runs in the browser."""

from collections.abc import Sequence

from nicegui.element import Element

from mapserver.dashboard.failure.story import Instant
from mapserver.dashboard.map_layers import Mark
from mapserver.dashboard.site_map import SiteMap

LAYER = "Chosen moment"


class FailurePlayer(Element, component="player.js"):
    """A picture, what the robot said, and a slider over all moments; the map's layer LAYER shows where it believed to be then."""

    def __init__(
        self, instants: Sequence[Instant], pictures: Sequence[tuple[str, str]], begin: int, site_map: SiteMap | None
    ) -> None:
        """pictures: address and time of each; begin: number of the moment that is shown first."""
        super().__init__()
        self._props["scene"] = {
            "instants": instants,
            "pictures": [{"url": url, "clock": clock} for url, clock in pictures],
            "begin": begin,
            "map": None if site_map is None else site_map.id,
            "layer": LAYER,
        }


def mark_of(instant: Instant) -> list[Mark]:
    """Where the robot believed to be, as the player draws it."""
    if instant.x is None or instant.y is None:
        return []
    words = f"{instant.clock}: {instant.words}"
    return [Mark(instant.x, instant.y, instant.tone, "circle", words, heading_rad=instant.heading_rad)]
