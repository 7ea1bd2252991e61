"""Replays as MCAP files for viewers."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from fleetmap.files import appearing_file
from fleetmap.plugins.viewer_channels import require_foxglove

if TYPE_CHECKING:
    from locclient.plugins.viewer_files.run_export import RunExport


@contextmanager
def open_export(path: Path) -> "Iterator[RunExport]":
    """Write the file at `path`, which appears when the block succeeds.

    Raises StoreError on a disk error, UsageError without the extra `foxglove`.
    """
    require_foxglove("--mcap")
    from fleetmap.plugins.viewer_channels.channels import ChannelWriter
    from locclient.plugins.viewer_files.run_export import RunExport

    with appearing_file(path) as file, ChannelWriter(file) as writer:
        yield RunExport(writer)
