"""Replays as MCAP files for viewers."""

from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from fleetmap.plugins.viewer_channels import require_foxglove

if TYPE_CHECKING:
    from locclient.plugins.viewer_files.run_export import RunExport


def open_export(path: Path) -> "AbstractContextManager[RunExport]":
    """Open the file at `path` within a block. Raises UsageError without the extra `foxglove`."""
    require_foxglove("--mcap")
    from locclient.plugins.viewer_files.run_export import run_export

    return run_export(path)
