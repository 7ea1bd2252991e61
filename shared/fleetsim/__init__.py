"""The warehouse simulator: writes recordings that both sides can read.

    from fleetsim import Order, record_order

    record_order(Order("small-loop", robot="tote-1", frames=100), Path("tote.mcap"))

`prepare` gives the samples and the renderer of a run without writing them. Names are imported at their first use.
"""

from typing import TYPE_CHECKING

from fleetmap.lazy_names import lazy_names

if TYPE_CHECKING:
    from fleetmap.version import __version__
    from fleetsim.recorder import Order, Session, prepare, record_order
    from fleetsim.scenarios import SCENARIOS

__all__ = ["SCENARIOS", "Order", "Session", "__version__", "prepare", "record_order"]
_, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "fleetmap.version": "__version__",
        "fleetsim.recorder": "Order Session prepare record_order",
        "fleetsim.scenarios": "SCENARIOS",
    },
)
