"""What all tests share: the same examples on every run, and no trace in the user's own folders."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# Before numpy and OpenCV are loaded. Tests run one process a core; threads that wait for each other would take most of them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

# Folders whose files take long: they begin first, so that no process is left with one of them at the end.
_LONG = ("scenarios", "end_to_end", "examples", "mapserver/dashboard", "mapserver/live", "mapserver/fleet")

settings.register_profile("same every time", derandomize=True, deadline=None)
settings.load_profile("same every time")


@pytest.fixture(scope="session", autouse=True)
def own_cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Programs that tests start keep their caches here, not in the user's cache folder."""
    folder = tmp_path_factory.mktemp("cache")
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = str(folder)
    yield folder
    if before is None:
        del os.environ["XDG_CACHE_HOME"]
    else:
        os.environ["XDG_CACHE_HOME"] = before


def pytest_xdist_auto_num_workers() -> int:
    """Three processes for two cores: half of the time tests wait, for servers, for browsers and for clocks."""
    return max(2, 3 * len(os.sched_getaffinity(0)) // 2)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first; the order within a file stays."""
    root = Path(__file__).parent
    long = [root / folder for folder in _LONG]
    items.sort(key=lambda item: not any(folder in item.path.parents for folder in long))
