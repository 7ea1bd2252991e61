"""What the server does by itself: in turn, again and again, whatever happens to one of them; a bad version goes by itself."""

import asyncio
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from fleetmap.errors import StoreError
from fleetmap.messages import RobotHealth
from mapserver import releases
from mapserver.fleet.fleet import Fleet
from mapserver.fleet_statistics.canary_decision import CanarySettings
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings
from mapserver.serving.background_tasks import BackgroundTask, run_background_tasks, server_tasks
from mapserver.serving.bus_service import BusService
from mapserver.store import MapStore
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.fleet.reports import blindness
from support.storage.map_samples import publish_samples, save_sample_draft

NS = 1_000_000_000


def run_for(chores: list[BackgroundTask], seconds: float) -> None:
    async def run() -> None:
        task = asyncio.create_task(run_background_tasks(chores))
        await asyncio.sleep(seconds)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(run())


def test_one_that_fails_stops_no_other(caplog: pytest.LogCaptureFixture) -> None:
    acts = Mock(side_effect=StoreError("the disk is full")), Mock(side_effect=ZeroDivisionError), Mock()
    run_for([BackgroundTask(*task) for task in zip("abc", (0.01, 0.01, 60.0), acts, strict=True)], 1.0)
    assert acts[0].call_count >= 2 and acts[1].call_count >= 2
    acts[2].assert_called_once()
    assert "a failed: the disk is full" in caplog.text
    assert "ZeroDivisionError" in caplog.text


def test_the_server_takes_a_bad_version_back_by_itself(tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True) as store, MemoryBus(MemoryHub()) as bus:
        publish_samples(store, 1)
        save_sample_draft(store, seed=3)
        fleet = Fleet(store)
        service = BusService(store, fleet, bus, lambda *_: None)
        releases.start_canary(store, "lab", 2, 0.1)
        for robot, version in (("r1", 2), ("r2", 1), ("r3", 1)):
            for second in range(40):
                health = RobotHealth(
                    site="lab", robot=robot, stamp_ns=second * NS, version=version, status="TRACKING",
                    metrics={"speed_mps": 1.0},
                )  # fmt: skip
                fleet.take_health("lab", robot, health)
        for number in range(8):
            at_ns = store.canaries()[0].started_ns + NS
            fleet.take_failure("lab", "r1", blindness(f"f{number}", wall_ns=at_ns, cause="changed", version=2))
        tasks = server_tasks(store, fleet, service, CanarySettings(), ResurveySettings())
        run_for([replace(task, every_s=0.05) for task in tasks], 2.0)
        (canary,) = store.canaries("lab")
        assert canary.state == "rolled_back", canary
        assert "8 failures in" in canary.outcome
        assert fleet.wanted_version("lab", "r1").version == 1
        service.close()
