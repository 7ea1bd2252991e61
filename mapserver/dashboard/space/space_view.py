"""The element that shows a version in three dimensions. Drawn by three.js, which comes with the page library."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import nicegui.elements.scene  # noqa: F401 -- gives the browser the library by its name
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from fleetmap.mapformat import CameraEntry
from mapserver.dashboard.live import LiveRobot
from mapserver.dashboard.space.loops import Loop
from mapserver.dashboard.space.points import COARSEST_M, FINEST_M
from mapserver.dashboard.space.robot_views import RobotView


@dataclass(frozen=True, slots=True)
class SpaceScene:
    """What is shown. label: for those who cannot see it; address: of the version's bytes (mapserver.dashboard.space.points).

    camera: of the survey, through which one walks; view_address: of pictures of what it should see, None for a version without surfels.
    robot_views: of robots that told their own camera; the others are drawn with the survey's.
    """

    label: str
    address: str
    camera: CameraEntry
    view_address: str | None
    loops: Sequence[Loop]
    robot_views: Mapping[str, RobotView]


class SpaceView(Element, component="space_view.js", default_classes="space-view"):
    """Landmarks, places, loops and robots of a version, to be turned, and walked through along the places of its surveys."""

    def __init__(self, scene: SpaceScene, robots: Sequence[LiveRobot]) -> None:
        super().__init__()
        camera = scene.camera
        self._props["scene"] = {
            "label": scene.label,
            "address": scene.address,
            "view": scene.view_address,
            "tangents": [side / 2 / camera.focal_px for side in (camera.width_px, camera.height_px)],
            "robots": shown(robots),
            "exactness": [1e3 * FINEST_M, 1e3 * COARSEST_M],
            "cameras": {name: [*view.tangents, *view.base_from_cam] for name, view in scene.robot_views.items()},
            "loops": [[*loop.start_map_m, *loop.end_map_m, int(loop.is_accepted)] for loop in scene.loops],
        }

    def show_robots(self, robots: Sequence[LiveRobot]) -> None:
        """Robots at their new places."""
        self.run_method("showRobots", shown(robots))

    def walk_to(self, x_m: float, y_m: float) -> None:
        """Stands at the place nearest to x and y in `map`."""
        self.run_method("walkTo", x_m, y_m)

    def on_walk(self, listener: Callable[[float, float, float], None]) -> None:
        """Calls `listener` with x and y in metres and the heading in radians after each step."""

        def walked(event: GenericEventArguments) -> None:
            told = [event.args.get(name) for name in ("x", "y", "heading")]
            if all(isinstance(value, int | float) and math.isfinite(value) for value in told):
                listener(*map(float, told))

        self.on("walked", walked)


def shown(robots: Sequence[LiveRobot]) -> list[dict[str, Any]]:
    """Robots that ever sent a position, as the element takes them."""
    return [
        {"name": robot.name, "words": robot.words, "tone": robot.tone, "x": x, "y": y, "heading_rad": robot.heading_rad}
        for robot in robots
        if robot.place_m is not None
        for x, y in [robot.place_m]
    ]
