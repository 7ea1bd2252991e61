"""The compiled core, `fleetmap._core` of shared/core, with advice if it is missing."""

from fleetmap.errors import FleetmapError

try:
    from fleetmap._core import *
except ModuleNotFoundError as error:
    raise FleetmapError(
        "fleetmap's compiled core is missing; run `make core` in its source folder, or `pip install .` there"
    ) from error
except ImportError as error:  # built for another processor, Python or system, which the message names
    raise FleetmapError(f"fleetmap's compiled core cannot be used: {error}") from error
