"""A few hundred of the faults that `make bench` tries at every file-system call: killed, full, broken, without power."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from support.storage.store_faults import MODES

TESTS = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("every", [53])
def test_a_store_survives_whatever_happens_to_its_process_or_disk(every: int) -> None:
    """A process of its own, because what it does to `os` and SQLite cannot be undone."""
    command = [sys.executable, str(TESTS / "support" / "storage" / "store_faults.py"), "--every", str(every)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=280)
    assert done.stdout, done.stderr[-3000:]
    found = json.loads(done.stdout)
    assert found["wrong"] == [], done.stderr[-3000:]
    assert found["points"] >= 90
    for mode in MODES:
        assert sum(counts[mode] for counts in found["tries"].values()) >= 3, mode


@pytest.mark.parametrize("forgotten", ["sync", "sync_folder"])
def test_without_syncing_files_or_folders_it_would_not(forgotten: str) -> None:
    """The test above can fail: a disk that forgets one kind of sync loses what was said to be done."""
    program = (
        "import sys\nsys.path.insert(0, sys.argv[1])\nfrom support.storage import faulty_disk, store_faults\n"
        "note = faulty_disk.Disk.note\n"
        "faulty_disk.Disk.note = lambda disk, kind, *rest: None if kind == sys.argv[2] else note(disk, kind, *rest)\n"
        "found = store_faults.run(['power cut'], 9, ['import'])\n"
        "sys.exit(0 if found['wrong'] else 1)\n"
    )
    command = [sys.executable, "-c", program, str(TESTS), forgotten]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
