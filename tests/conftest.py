"""What all tests share: the same examples on every run, two tiers, and no trace in the user's own folders."""

import os
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from hypothesis import settings

# Before numpy and OpenCV are loaded. Tests run one process a core; threads that wait for each other would take most of them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

# Folders of tests lie in memory, if there is room: stores sync what they write, ten thousand times in all, and a disk takes 7 ms for it.
_MEMORY = Path("/dev/shm")
if _MEMORY.is_dir() and min(shutil.disk_usage(_MEMORY).free, psutil.virtual_memory().available) > 8 << 30:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(_MEMORY))

TESTS = Path(__file__).parent
# No test of `make test` may take longer; those that did are named at its end.
_MOST_S = 5.0

settings.register_profile("same every time", derandomize=True, deadline=None)
settings.load_profile("same every time")


@pytest.fixture(scope="session", autouse=True)
def own_cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Programs that tests start keep their caches here, not in the user's cache folder."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder


def pytest_xdist_auto_num_workers() -> int:
    """Three processes for two cores: half of the time tests wait, for servers, for browsers and for clocks."""
    return max(2, 3 * len(os.sched_getaffinity(0)) // 2)


def entries_of_tier(tier: str) -> list[str]:
    """Paths and tests of tiers.toml that are `long` or `ci`."""
    tiers = tomllib.loads((TESTS / "tiers.toml").read_text("utf-8"))
    return [entry for entries in tiers[tier].values() for entry in entries]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks the tiers and puts files with long tests first, so that no process is left with one of them at the end."""
    entries = {tier: entries_of_tier(tier) for tier in ("long", "ci")}
    long_files = set()
    for item in items:
        name = f"{item.path.relative_to(TESTS).as_posix()}::{item.nodeid.partition('::')[2].partition('[')[0]}"
        for tier, named in entries.items():
            if any(name == entry or name.startswith((f"{entry}/", f"{entry}::")) for entry in named):
                item.add_marker(tier)
                long_files.add(item.path)
    items.sort(key=lambda item: item.path not in long_files)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Names the tests that are too slow for `make test`; a figure to act on, no failure, because times depend on the machine."""
    if "not long" not in config.option.markexpr:
        return
    reports = [r for reports in terminalreporter.stats.values() for r in reports if isinstance(r, pytest.TestReport)]
    slow = sorted(((r.duration, r.nodeid, r.when) for r in reports if r.duration > _MOST_S), reverse=True)
    if slow:
        terminalreporter.section(f"above {_MOST_S:.0f} s: shorten them, or add them to tests/tiers.toml")
        for seconds, name, when in slow:
            terminalreporter.line(f"{seconds:6.1f} s {when:8} {name}")
