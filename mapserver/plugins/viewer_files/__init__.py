"""Failures as MCAP in the channels of viewers, of one site with its current map."""

from pathlib import Path

from fleetmap.plugins.viewer_channels import require_foxglove
from mapserver.store import FailureFilter, MapStore


def write_failures(store: MapStore, wanted: FailureFilter, path: Path) -> int:
    """See `FailureExport`. Raises UsageError without the extra `foxglove`."""
    require_foxglove("MCAP")
    from mapserver.plugins.viewer_files.failures import write_mcap

    return write_mcap(store, wanted, path)
