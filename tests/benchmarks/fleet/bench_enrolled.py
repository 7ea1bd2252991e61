"""Enrolled robots: the bus of a thousand, and a revocation."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.common.recorded_runs import Options, Results, benchmark, resident_mb
from fleetmap.access import Holder
from fleetmap.bus.endpoints import TlsFiles
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import UnreachableError
from fleetmap.messages import robot_key
from mapserver.serving.bus_access import BusGuard
from mapserver.store import MapStore
from mapserver.trust import init_here
from mapserver.trust.enrolment import RobotRegister
from support.storage.map_samples import save_sample_draft
from support.waiting import eventually, repeated

SITE, ENDPOINT = "lab", "tls/127.0.0.1:7447"


def _until(condition: Callable[[], bool], within_s: float = 20.0) -> float:
    begun_s = time.perf_counter()
    return time.perf_counter() - begun_s if eventually(condition, within_s) else float("nan")


def opening_and_revoking(folder: Path, count: int, connected: int) -> dict[str, float]:
    """With `count` enrolled robots: seconds to open, memory (MB); seconds until a revoked one is out and all others are answered."""
    store = MapStore.open(folder / "store", create=True)
    save_sample_draft(store)
    init_here(store)
    register = RobotRegister(store)
    register.authorities.init(["127.0.0.1"], None, None)
    register.enrol(SITE, [f"r{number}" for number in range(count)], ENDPOINT)
    holders = [Holder(entry.certificate, SITE, entry.robot) for entry in register.robots()[:connected]]
    before_mb = resident_mb()
    bus = Bus("tls/127.0.0.1:0", is_server=True, tls=register.tls, access=register.access())
    bus.queryable(robot_key("*", "*", "wanted"), lambda *_: b"1")
    begun_s = time.perf_counter()
    bus.open()
    found = {"open_s": time.perf_counter() - begun_s, "mb": resident_mb() - before_mb}
    robots = []
    for holder in holders:
        own = folder / f"{holder.certificate}.pem"
        own.write_bytes(register.authorities.make_own(holder.certificate, "robot"))
        robots.append(Bus(bus.endpoint, tls=TlsFiles(folder / "store" / "keys" / "servers-ca.crt", own)).open())

    def answered(number: int) -> bool:
        try:
            return robots[number].get(robot_key(SITE, holders[number].robot, "wanted"), timeout_s=0.2) == b"1"
        except UnreachableError:
            return False

    with repeated(BusGuard(register, bus).follow, 1.0):  # as the server's background task
        _until(lambda: all(answered(number) for number in range(connected)))
        register.revoke(SITE, [holders[0].robot])
        found["revoked_is_out_s"] = _until(lambda: not answered(0))
        found["others_again_s"] = _until(lambda: all(answered(number) for number in range(1, connected)))
        found["revoked_stays_out"] = float(not answered(0))
    for robot in robots:
        robot.close()
    bus.close()
    store.close()
    return found


@benchmark()
def main(_: Options) -> Results:
    with tempfile.TemporaryDirectory() as name:
        return {"thousand": opening_and_revoking(Path(name) / "many", 1000, 12)}
