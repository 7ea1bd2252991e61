"""The element that shows a version in three dimensions. Drawn by three.js, which comes with the page library."""

from collections.abc import Sequence
from typing import Any

import nicegui.elements.scene  # noqa: F401 -- gives the browser the library by its name
from nicegui.element import Element

from mapserver.dashboard.live import LiveRobot
from mapserver.dashboard.space.points import COARSEST_M, FINEST_M


class SpaceView(Element, component="space_view.js", default_classes="space-view"):
    """Landmarks, places and robots of a version, to be turned and walked through. label: for those who cannot see it."""

    def __init__(self, label: str, address: str, robots: Sequence[LiveRobot]) -> None:
        """address: of the version's bytes (mapserver.dashboard.space.points)."""
        super().__init__()
        exactness_mm = [1e3 * FINEST_M, 1e3 * COARSEST_M]
        self._props["scene"] = {"label": label, "address": address, "robots": shown(robots), "exactness": exactness_mm}

    def show_robots(self, robots: Sequence[LiveRobot]) -> None:
        """Robots at their new places."""
        self.run_method("showRobots", shown(robots))


def shown(robots: Sequence[LiveRobot]) -> list[dict[str, Any]]:
    """Robots that ever sent a position, as the element takes them."""
    return [
        {"name": robot.name, "words": robot.words, "tone": robot.tone, "x": x, "y": y, "heading_rad": robot.heading_rad}
        for robot in robots
        if robot.place_m is not None
        for x, y in [robot.place_m]
    ]
