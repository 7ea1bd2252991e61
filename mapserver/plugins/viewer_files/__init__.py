"""Failures as MCAP in the channels of viewers: log, positions, pictures and reports, of one site with its current map."""

from pathlib import Path

import numpy as np

from fleetmap.files import appearing_file
from fleetmap.mapformat.tile import decode_tile
from fleetmap.plugins.viewer_channels import require_foxglove
from mapserver.fleet.exports import failures_oldest_first
from mapserver.store import FailureFilter, MapStore


def write_failures(store: MapStore, wanted: FailureFilter, path: Path) -> int:
    """Write the failures and return their number; as `write_json_lines`. Raises UsageError without the extra `foxglove`."""
    require_foxglove("MCAP")
    from fleetmap.plugins.viewer_channels import channels

    count = 0
    with appearing_file(path) as file, channels.ChannelWriter(file) as writer:
        for found in failures_oldest_first(store, wanted):
            failure = found.failure
            if not count and wanted.site is not None and (current := store.current(wanted.site)) is not None:
                tiles = store.manifest(wanted.site, current.version).tiles
                parts = [decode_tile(store.blob(tile.sha256)).points_map for tile in tiles]
                points = np.concatenate([np.zeros((0, 3)), *parts])
                writer.write(channels.points(failure.happened_ns, points))
            count += 1
            pictures = [(each.kind, store.fleet.picture(failure.number, each.place)) for each in found.pictures]
            where = failure.where or "outside"
            for message in channels.failure(failure.happened_ns, found.report, pictures, where):
                writer.write(message)
    return count
