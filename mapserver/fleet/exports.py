"""Failures for other programs: JSON lines, and MCAP in the channels of viewers."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np

from fleetmap.encoding import to_json
from fleetmap.files import appearing_file
from fleetmap.foxglove import require_foxglove
from fleetmap.mapformat import decode_tile
from fleetmap.messages import report_dict
from mapserver.store import FailureDetail, FailureFilter, MapStore

_PAGE = 200


def failures_oldest_first(store: MapStore, wanted: FailureFilter) -> Iterator[FailureDetail]:
    """Return failures with their context, in the order of their times."""
    rows, before = [], None
    while page := store.fleet.failures(wanted, before=before, limit=_PAGE):
        rows += [(row.happened_ns, row.number) for row in page]
        before = page[-1].number
    for _, number in sorted(rows):
        yield store.fleet.failure(number)


def write_json_lines(store: MapStore, wanted: FailureFilter, path: Path) -> int:
    """Write one failure a line and return their number; the file is replaced atomically."""
    count = 0
    with appearing_file(path) as file:
        for found in failures_oldest_first(store, wanted):
            report = report_dict(found.report)
            report.pop("thumbnails")
            pictures = [asdict(picture) for picture in found.pictures]  # by kind and place, without their bytes
            plain = {**asdict(found.failure), "report": report, "pictures": pictures}
            file.write(to_json(plain, order="sorted") + b"\n")
            count += 1
    return count


def write_mcap(store: MapStore, wanted: FailureFilter, path: Path) -> int:
    """Write failures as MCAP in the channels of viewers, of one site with its current map; return their number.

    Raises UsageError without the extra `foxglove`.
    """
    require_foxglove("MCAP")
    from fleetmap.foxglove import channels

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
