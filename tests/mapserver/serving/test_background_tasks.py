"""What the server does by itself: in turn, again and again, whatever happens to one of them."""

import asyncio
from unittest.mock import Mock

from fleetmap.errors import StoreError
from mapserver.serving.background_tasks import BackgroundTask, run_background_tasks

NS = 1_000_000_000


def run_for(chores: list[BackgroundTask], seconds: float) -> None:
    async def run() -> None:
        task = asyncio.create_task(run_background_tasks(chores))
        await asyncio.sleep(seconds)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(run())


def test_one_that_fails_stops_no_other(caplog) -> None:
    acts = Mock(side_effect=StoreError("the disk is full")), Mock(side_effect=ZeroDivisionError), Mock()
    run_for([BackgroundTask(*task) for task in zip("abc", (0.01, 0.01, 60.0), acts, strict=True)], 1.0)
    assert acts[0].call_count >= 2 and acts[1].call_count >= 2
    acts[2].assert_called_once()
    assert "a failed: the disk is full" in caplog.text
    assert "ZeroDivisionError" in caplog.text
