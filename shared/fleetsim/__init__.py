"""The warehouse simulator: writes recordings that both sides can read.

    from fleetsim import Order, record_order

    record_order(Order("small-loop", robot="tote-1", frames=100), Path("tote.mcap"))

`prepare` gives the samples and the renderer of a run without writing them. Names are imported at their first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fleetsim.commands import record_order
    from fleetsim.recorder import Order, Session, prepare
    from fleetsim.scenarios import SCENARIOS

__all__ = ["SCENARIOS", "Order", "Session", "__version__", "prepare", "record_order"]
_MODULES = {
    "SCENARIOS": "fleetsim.scenarios",
    "Order": "fleetsim.recorder",
    "Session": "fleetsim.recorder",
    "prepare": "fleetsim.recorder",
    "record_order": "fleetsim.commands",
}


def __getattr__(name: str) -> object:
    """Import a public name at its first use (PEP 562)."""
    if name == "__version__":
        return import_module("fleetmap").__version__
    if name not in _MODULES:
        raise AttributeError(f"module 'fleetsim' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return __all__
