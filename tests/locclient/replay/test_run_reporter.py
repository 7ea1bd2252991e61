"""A replay is a robot: the server hears of its failures, once each, and keeps what it cannot deliver."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from fleetmap.bus import Bus
from fleetmap.recordings import FrameSelection, open_recording
from fleetmap.sources.replay_source import ReplaySource
from locclient.delivery.failure_file import read_failure_file
from locclient.delivery.outbox import Outbox
from locclient.identity import MapAddress
from locclient.maps import connection
from locclient.maps.connection import connected
from locclient.maps.map_client import MapClient
from locclient.maps.map_source import LocalMapSource
from locclient.replay import run_reporter
from locclient.replay.failure_replay import compare_failure
from locclient.replay.replay import ReplayOptions, replay
from mapserver.fleet.fleet import Fleet
from mapserver.serving.bus_service import BusService
from mapserver.store import FailureFilter, MapStore
from mapserver.trust import init_here
from support.recordings.recording_samples import Sample, write_euroc
from support.worlds import robot_world


@dataclass
class Server:
    """A server on the loopback interface."""

    endpoint: str
    store: MapStore
    fleet: Fleet
    service: BusService


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with MapStore.open(tmp_path / "store", create=True) as store, Bus.listen("tcp/127.0.0.1:0") as bus:
        robot_world.save(store)
        fleet = Fleet(store)
        init_here(store)
        service = BusService(store, fleet, bus, lambda *_: None)
        yield Server(bus.endpoint, store, fleet, service)
        service.close()


@pytest.fixture(scope="module")
def carried(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a robot that is put down 2.4 m away."""
    bundles = list(robot_world.carried(110, 75))
    imu = [bundle.imu for bundle in bundles]
    sample = Sample(
        np.array([bundle.frame.stamp_ns for bundle in bundles]), [bundle.frame.left for bundle in bundles],
        [bundle.frame.right for bundle in bundles], np.concatenate([part.stamps_ns for part in imu]),
        np.concatenate([part.gyro_radps for part in imu]), np.concatenate([part.accel_mps2 for part in imu]),
        [robot_world.truth(number) for number in range(110)],
    )  # fmt: skip
    return write_euroc(tmp_path_factory.mktemp("recordings") / "carried", sample)


def played(path: Path, endpoint: str, folder: Path, *, close: Server | None = None) -> dict[str, object]:
    """The report of a replay; close: the server whose service ends before the first failure."""
    address = MapAddress(site="room", robot="r1", server=endpoint)

    def progress(number: int) -> None:
        if close is not None and number == 70:
            close.service.close()

    with open_recording(path) as recording, connected(address, folder / "cache", 10**8) as link:
        source = ReplaySource.of(recording, FrameSelection.parse(":"), reverse=False)
        return replay(source, link, ReplayOptions(robot_world.SETTINGS, progress=progress)).report


def test_a_carried_robot_is_on_the_server(server: Server, carried: Path, tmp_path: Path) -> None:
    report = played(carried, server.endpoint, tmp_path)
    assert report["failure_reports"] == {"detected": 1, "delivered": 1, "waiting": 0}
    (row,) = server.store.fleet.failures(FailureFilter(site="room"))
    assert (row.robot, row.cause) == ("r1", "carried")
    found = server.store.fleet.failure(row.number)
    assert found.report.wrong_by_m == pytest.approx(2.4, abs=0.1)
    kinds = [picture.kind for picture in found.pictures]
    assert kinds[:4] == ["frame", "frame", "frame", "matches"]
    assert set(kinds[4:]) == {"replay"}
    (tmp_path / "failure.mcap").write_bytes(server.store.fleet.replay(row.number))
    summary, record = read_failure_file(tmp_path / "failure.mcap")
    assert summary.id == found.report.id
    assert compare_failure((summary, record), LocalMapSource(server.store.folder, "room")).first_difference_ns is None
    server.fleet.flush()
    total = server.store.fleet.counters("room", "site")["room", ""]
    assert total.position_failures + total.suspected == 1, "counted once, by report and statuses together"
    share = report["localised_share_of_all"]
    assert isinstance(share, float)
    assert share < 1.0


def test_reports_of_a_server_that_went_away_wait(
    server: Server, carried: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The replay ends in a bounded time and says so; the robot's next run delivers."""
    monkeypatch.setattr(run_reporter, "_DELIVERY_S", 0.5)
    monkeypatch.setattr(connection, "MapClient", partial(MapClient, timeout_s=0.5))
    report = played(carried, server.endpoint, tmp_path, close=server)
    assert report["failure_reports"] == {"detected": 1, "delivered": 0, "waiting": 1}
    assert "wait in" in str(report["notes"])
    waiting = Outbox(tmp_path / "spool" / "room.r1.sqlite3", max_bytes=10**8).waiting()
    assert len(waiting) == 1
    assert server.fleet.take_failure_bytes("room", "r1", waiting[0].payload).refused == ""
