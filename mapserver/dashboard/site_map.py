"""The map of all pages: pan, zoom, layers and marks that move."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

from nicegui.dependencies import register_importmap_override
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from mapserver.dashboard.map_layers import Box, Item, Layer

_LEAFLET = Path(__file__).parent / "static" / "vendor" / "leaflet"
register_importmap_override("leaflet", "/dashboard/static/vendor/leaflet/leaflet.js")


class SiteMap(Element, component="site_map.js", esm={"fleetmap-map": "static/map"}, default_classes="site-map"):
    """A map of layers over a box. label: what it shows, for those who cannot see it. is_small: beside a text.

    follows: the map keeps everything in sight while its layers grow, until somebody moves it.
    """

    def __init__(
        self, label: str, box: Box, layers: Sequence[Layer], *, is_small: bool = False, follows: bool = False
    ) -> None:
        super().__init__()
        self.add_resource(_LEAFLET)
        self._props["scene"] = {"label": label, "box": box, "layers": layers, "follows": follows}
        if is_small:
            self.classes("small")

    def on_pick(self, listener: Callable[[float, float], None]) -> None:
        """Calls `listener` with x and y in metres where somebody clicks beside the marks."""

        def picked(event: GenericEventArguments) -> None:
            x, y = (event.args.get(name) for name in ("x", "y"))
            if all(isinstance(value, int | float) and math.isfinite(value) for value in (x, y)):
                listener(round(x, 2), round(y, 2))

        self.on("pick", picked)

    def show(self, layer: str, items: Sequence[Item]) -> None:
        """Shows other items in a layer; marks with the same name move to their new places."""
        self.run_method("show", layer, items)
