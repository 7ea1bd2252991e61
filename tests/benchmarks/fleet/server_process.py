"""What a running server costs."""

import itertools
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import httpx
import psutil

from benchmarks.common.recorded_runs import resident_mb
from support.waiting import repeated

SITE = "bench"


def cpu_s(pid: int) -> float:
    """CPU time that a process has used."""
    return float(sum(psutil.Process(pid).cpu_times()[:2]))


@dataclass
class Load:
    """What a server cost while something went on: cores, memory, and times of the pages that were asked for meanwhile."""

    cores: float = 0.0
    rss_mb: list[float] = field(default_factory=list)
    page_ms: dict[str, list[float]] = field(default_factory=dict)


@contextmanager
def measured(pid: int, http: str, pages: tuple[str, ...], every_s: float) -> Iterator[Load]:
    """Measures the server until the block ends, and asks it for one page after the other as an operator does."""
    load, next_page = Load(rss_mb=[resident_mb(pid)]), itertools.cycle(pages)
    with httpx.Client(base_url=http, timeout=30) as client:

        def look() -> None:
            page, asked_s = next(next_page), time.perf_counter()
            client.get(page).raise_for_status()
            load.page_ms.setdefault(page, []).append(1e3 * (time.perf_counter() - asked_s))
            load.rss_mb.append(resident_mb(pid))

        begun_s, begun_cpu_s = time.monotonic(), cpu_s(pid)
        with repeated(look, every_s):
            yield load
            load.cores = (cpu_s(pid) - begun_cpu_s) / (time.monotonic() - begun_s)
