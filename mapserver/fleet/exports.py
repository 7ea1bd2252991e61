"""Failures for other programs, as JSON lines. Plug-ins write other formats."""

from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

from fleetmap.encoding import to_json, to_plain
from fleetmap.files import appearing_file
from mapserver.store import FailureDetail, FailureFilter, MapStore

_PAGE = 200
More = Callable[[FailureDetail], dict[str, object]]


def failures_oldest_first(store: MapStore, wanted: FailureFilter) -> Iterator[FailureDetail]:
    """Return failures with their context, in the order of their times."""
    rows, before = [], None
    while page := store.fleet.failures(wanted, before=before, limit=_PAGE):
        rows += [(row.happened_ns, row.number) for row in page]
        before = page[-1].number
    for _, number in sorted(rows):
        yield store.fleet.failure(number)


def write_json_lines(store: MapStore, wanted: FailureFilter, path: Path, more: More = lambda _: {}) -> int:
    """Write one failure a line, with more of each, and return their number; the file is replaced atomically."""
    count = 0
    with appearing_file(path) as file:
        for found in failures_oldest_first(store, wanted):
            report = to_plain(found.report)
            report.pop("thumbnails")
            pictures = [asdict(picture) for picture in found.pictures]  # by kind and place, without their bytes
            plain = {**asdict(found.failure), "report": report, "pictures": pictures, **more(found)}
            file.write(to_json(plain, order="sorted") + b"\n")
            count += 1
    return count
