"""A store at every file-system call that can fail, and every format under 10^5 damaged inputs; prints the tables."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).with_name("maps") / "bench_store_faults.py"


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_store_survives_every_fault(tmp_path: Path) -> None:
    command = [sys.executable, str(BENCH), "--out", str(tmp_path / "figures.json")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=3500)
    print(f"\n{done.stdout}")
    assert done.returncode == 0, done.stderr[-3000:]
    figures = json.loads((tmp_path / "figures.json").read_text("utf-8"))
    assert figures["faults"]["points"] >= 2000
    assert sum(fuzzed["inputs"] for fuzzed in figures["fuzz"].values()) >= 99_000
