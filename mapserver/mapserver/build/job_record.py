"""Records of jobs in the store, from begin to end, so that people see what runs, what was built and what failed."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from mapserver.build.job_lock import end_interrupted, held
from mapserver.store import MapStore


@dataclass(slots=True)
class Job:
    """What a job says at its end."""

    message: str = ""
    report: dict[str, Any] = field(default_factory=dict)


@contextmanager
def recorded_job(maps: MapStore, site: str, kind: str) -> Iterator[Job]:
    """Notes a job as running, then as done, or as failed with the error that ended it.

    One that is killed stands as running until the server, or the next job, finds that nobody holds its lock.
    """
    end_interrupted(maps, time.time_ns())
    job, number = Job(), maps.begin_job(site, kind)
    try:
        with held(maps.folder, number):
            yield job
    except BaseException as error:
        maps.update_job(number, "failed", str(error) or type(error).__name__, job.report)
        raise
    maps.update_job(number, "done", job.message, job.report)
