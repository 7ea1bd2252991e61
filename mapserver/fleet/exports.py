"""Failures for other programs: JSON lines, and MCAP in the channels of viewers."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fleetmap.encoding import to_json
from fleetmap.files import appearing_file
from fleetmap.foxglove import require_foxglove
from fleetmap.mapformat import decode_tile
from fleetmap.messages import report_dict
from mapserver.store import FailureDetail, FailureFilter, MapStore

if TYPE_CHECKING:
    from fleetmap.foxglove.channels import ChannelMessage

_PAGE = 200


def failures_oldest_first(store: MapStore, wanted: FailureFilter) -> Iterator[FailureDetail]:
    """Return failures with their context, in the order of their times."""
    rows, before = [], None
    while page := store.fleet.failures(wanted, before=before, limit=_PAGE):
        rows += [(row.happened_ns, row.number) for row in page]
        before = page[-1].number
    for _, number in sorted(rows):
        yield store.fleet.failure(number)


def as_plain(found: FailureDetail) -> dict[str, Any]:
    """Return a failure as plain values; pictures by kind and place, without their bytes."""
    report = report_dict(found.report)
    report.pop("thumbnails")
    pictures = [asdict(picture) for picture in found.pictures]
    return {**asdict(found.failure), "report": report, "pictures": pictures}


def write_json_lines(store: MapStore, wanted: FailureFilter, path: Path) -> int:
    """Write one failure a line and return their number; the file is replaced atomically."""
    count = 0
    with appearing_file(path) as file:
        for found in failures_oldest_first(store, wanted):
            file.write(to_json(as_plain(found), order="sorted") + b"\n")
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
            if not count and wanted.site is not None and (current := store.current(wanted.site)) is not None:
                writer.write(map_message(store, wanted.site, current.version, found.failure.happened_ns))
            count += 1
            for message in failure_messages(store, found):
                writer.write(message)
    return count


def map_message(store: MapStore, site: str, version: int, stamp_ns: int) -> "ChannelMessage":
    """Return a version's landmarks for viewers; errors as of `MapStore.manifest` and `blob`."""
    from fleetmap.foxglove import channels

    manifest = store.manifest(site, version)
    parts = [decode_tile(store.blob(tile.sha256)).points_map for tile in manifest.tiles]
    return channels.points(stamp_ns, np.concatenate([np.zeros((0, 3)), *parts]))


def failure_messages(store: MapStore, found: FailureDetail) -> "list[ChannelMessage]":
    """Return a failure for viewers, with its pictures."""
    from fleetmap.foxglove import channels

    pictures = [(each.kind, store.fleet.picture(found.failure.number, each.place)) for each in found.pictures]
    return channels.failure(found.failure.happened_ns, found.report, pictures, found.failure.where or "outside")
