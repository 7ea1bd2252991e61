"""A few hundred of the faults that `make bench` tries at every file-system call: killed, full, broken, without power."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from support.storage.store_faults import MODES

TESTS = Path(__file__).resolve().parents[2]
PROGRAM = """
import json, sys
from support.storage import faulty_disk, store_faults
note = faulty_disk.Disk.note
faulty_disk.Disk.note = lambda disk, kind, *rest: None if kind == sys.argv[1] else note(disk, kind, *rest)
print(json.dumps(store_faults.run(*json.loads(sys.argv[2]))))
"""


def tried(forgotten: str, *what: object) -> dict[str, object]:
    """In a process of its own, because what a try does to `os` and SQLite cannot be undone."""
    command = [sys.executable, "-c", PROGRAM, forgotten, json.dumps(what)]
    done = subprocess.run(command, cwd=TESTS, capture_output=True, text=True, check=False, timeout=280)
    assert done.stdout, done.stderr[-3000:]
    return json.loads(done.stdout)  # type: ignore[no-any-return]


def test_a_store_survives_whatever_happens_to_its_process_or_disk() -> None:
    found = tried("", MODES, 53)
    assert found["wrong"] == []
    assert found["points"] >= 90
    for mode in MODES:
        assert sum(counts[mode] for counts in found["tries"].values()) >= 3, mode


@pytest.mark.parametrize("forgotten", ["sync", "sync_folder"])
def test_without_syncing_files_or_folders_it_would_not(forgotten: str) -> None:
    """The test above can fail: a disk that forgets one kind of sync loses what was said to be done."""
    assert tried(forgotten, ["power cut"], 9, ["import"])["wrong"]
