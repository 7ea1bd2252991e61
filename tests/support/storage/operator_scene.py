"""A hall as an operator finds it: two weeks of driving in four named aisles, one of which got worse, and what failed yesterday at 14:03."""

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import numpy as np

from fleetmap.failure_summary import Moment
from fleetmap.geometry import se3
from fleetmap.messages import CameraNote, FailureReport, Placement
from mapserver import releases
from mapserver.fleet.fleet import Fleet
from mapserver.fleet_statistics.kpis import Counters, hour_of
from mapserver.store import Actor, DraftContent, MapStore
from mapserver.store.fleet_queries import FleetBatch
from mapserver.store.rows import TraceRow
from support.drawn_areas import geojson
from support.fleet.dashboard_scene import AISLE_M, LENGTH_M, SITE, WIDTH_M, build_report, failure, hall_tiles, picture
from support.fleet.failed_robot import send_replay, small_file
from support.storage.map_samples import draft_details

BEGAN_NS = 50_000_000_000
WORSE = "aisle 2"
_HOUR_MS = 3_600_000


def yesterday(hour: int, minute: int) -> int:
    """A moment of yesterday, UTC, in nanoseconds since 1970."""
    day = datetime.now(UTC).replace(hour=hour, minute=minute, second=7, microsecond=0) - timedelta(days=1)
    return round(day.timestamp()) * 1_000_000_000


def aisles() -> bytes:
    """Three aisles and the dock as GeoJSON; the rest of the hall has no name."""
    aisles = [
        {"name": f"aisle {n + 1}", "box": (8.0, 2.0 + AISLE_M * n, LENGTH_M - 3, 2.0 + AISLE_M * (n + 1) - 0.1)}
        for n in range(int(WIDTH_M / AISLE_M) - 1)
    ]
    return geojson(*aisles, {"name": "dock", "box": (0.0, 0.0, 7.9, WIDTH_M)})


def fill_shift(folder: Path, extras: Sequence[tuple[str, bytes]] = (), **said: object) -> None:
    """Version 1 (used before), 2 (current, with these bytes beside the tiles and what is reported of them) and draft 3;
    areas, two weeks of counts, a day of traces, failures, jobs."""
    ada = Actor("ada", "the nightly map")
    with MapStore.open(folder, create=True) as store:
        for number in (1, 2, 3):
            report: dict[str, object] = {
                "path_m": 410.0 + number, "duration_s": 600.0, "keyframes": 400 + number, "landmarks": 3600,
                "loops": {"candidates": 40, "accepted": 12},
                "findings": {"monday": []},
            }  # fmt: skip
            report |= said if number == 2 else {}
            content = DraftContent(
                tiles=hall_tiles(shifted_m=0.2 * (number - 1)), vocabulary=b"words" * 50,
                details=draft_details(**report), extras=extras if number == 2 else (),
            )  # fmt: skip
            store.save(SITE, content, actor=ada)
            if number < 3:
                releases.publish(store, SITE, number, actor=ada)
        store.keep_site_files(SITE, {"areas": aisles()}, "areas", actor=ada)
        job = store.begin_job(SITE, "nightly")
        store.update_job(job, "done", "version 2 of 402 keyframes", {"builds": [build_report() | {"version": 2}]})
        store.fleet.add(_weeks(store.now_ns()))
        _failures(store, folder)


def _weeks(now_ns: int) -> FleetBatch:
    """Every hour of two weeks four robots drive for 20 minutes in each aisle. One aisle fails eight times as often since a week, and the
    dock is hardly driven in."""
    batch, hour = FleetBatch(), hour_of(now_ns)
    for back in range(14 * 24):
        for name in ("aisle 1", "aisle 2", "aisle 3", "dock"):
            driven_ms = _HOUR_MS // 3 if name != "dock" else (_HOUR_MS // 3 if back in (3, 200) else 0)
            every = {"aisle 2": 8 if back < 7 * 24 else 64}.get(name, 48)
            failures = int(driven_ms > 0 and back % every == 5)
            counts = Counters(
                reports=1200, observed_ms=driven_ms, driving_ms=driven_ms, judged_ms=driven_ms, usable_ms=driven_ms,
                found_ms=driven_ms - failures * 20_000, failures=failures, blind_failures=failures, blind_seen=failures,
                frames=72_000, frames_dropped=1440 * (back % 8 == 3),
            )  # fmt: skip
            for axis, key in (("area", name), ("site", ""), ("robot", f"tug-{back % 8}"), ("version", "2")):
                batch.add(SITE, axis, key, hour - back, counts)
    for robot in range(8):
        for step in range(0, 20 * 3600, 10):
            heard_ns = now_ns - (20 * 3600 - step) * 1_000_000_000
            status = "LOST" if step % 7200 in range(3600 + 60 * robot, 3640 + 60 * robot) else "TRACKING"
            x_m = 5.0 + abs((step * 0.8 + 17 * robot) % 108 - 54)
            row = TraceRow(
                SITE, f"tug-{robot}", hour_of(heard_ns), heard_ns, status, 2, x_m, 6.0 + AISLE_M * (robot % 3), 0.05,
                heard_ns, "" if status == "TRACKING" else "no_match", 5.1, 0.4, 0.9,
            )  # fmt: skip
            batch.traces.append(row)
    return batch


def failed_at(robot: str, name: str, at_ns: int, place_m: tuple[float, float], **changes: object) -> FailureReport:
    """A failure that began then, and there."""
    made = failure(robot, name, wall_ns=at_ns)
    at = Placement.of(se3(np.eye(3), np.array([*place_m, 0.0])))
    tile = (int(place_m[0] // 16), int(place_m[1] // 16))
    return msgspec.structs.replace(made, map_from_base=at, tile=tile, **changes)


def _failures(store: MapStore, folder: Path) -> None:
    fleet = Fleet(store)
    optical = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.2, 0.0, 0.8]))
    camera = CameraNote(
        size_px=(320, 240), focal_px=160.0, centre_px=(160.0, 120.0), base_from_cam=Placement.of(optical)
    )
    rng = np.random.default_rng(4)
    for n in range(14):
        at_ns = store.now_ns() - int(rng.uniform(1, 160) * 3600) * 1_000_000_000
        place = (float(rng.uniform(20, 40)), 14.0) if n % 3 else (float(rng.uniform(10, 55)), 6.0 + 16.0 * (n % 2))
        report = failed_at(f"tug-{n % 8}", f"some-{n}", at_ns, place, cause="no_match")
        assert not fleet.take_failure(SITE, report.robot, report).refused
    carried = failed_at(
        "tug-7", "carried", yesterday(14, 3), (20.0, 14.0), cause="carried", wrong_by_m=5.0, camera=camera
    )
    assert not fleet.take_failure(SITE, "tug-7", carried).refused
    moments = [
        Moment(
            BEGAN_NS + tenth * 10**8,
            "LOST" if 0 <= tenth < 19 else "TRACKING",
            "odometry lost" if 0 <= tenth < 19 else "",
            None if 0 <= tenth < 19 else (20.0 + 0.05 * tenth + (5.0 if tenth >= 19 else 0.0), 14.0, 0.0),
            0.0,
            None if 0 <= tenth < 19 else 0.05,
        )
        for tenth in range(-50, 50)
    ]
    jpegs = [picture(f"{n}", 320) for n in range(20)]
    stamps_ns = tuple(BEGAN_NS + k * 5 * 10**8 for k in range(-10, 10))
    given = {"site": SITE, "robot": "tug-7", "id": "carried", "began_ns": BEGAN_NS, "stamps_ns": stamps_ns}
    send_replay(
        fleet, SITE, "tug-7", "carried", small_file(folder / "failure.mcap", jpegs=jpegs, moments=moments, **given)
    )
    fleet.flush()
