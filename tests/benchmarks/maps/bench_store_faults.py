"""A store under faults at every file-system call, and every format under 10^5 damaged inputs.

`PYTHONPATH=tests python tests/benchmarks/maps/bench_store_faults.py [--every N] [--inputs N] [--out FILE.json]`
prints the tables; with `--out` also writes
them as JSON. `tests/support/storage/store_faults.py` says what is tried and what is asked of the store afterwards.
"""

import argparse
import json
import platform
import resource
import shutil
import sqlite3
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(TESTS), *(str(TESTS.parent / part) for part in ("shared", ""))]

from support.storage.fuzzed_formats import FORMATS, fuzz  # noqa: E402
from support.storage.store_faults import MODES, TRACED, run  # noqa: E402


def machine() -> dict[str, str]:
    """What the figures were taken on."""
    return {"system": platform.platform(), "python": platform.python_version(), "sqlite": sqlite3.sqlite_version}


def fuzz_all(inputs: int) -> dict[str, dict[str, float]]:
    """All formats with `inputs` between them; what was refused and the slowest, by format."""
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in FORMATS:
            begun_s = time.monotonic()
            figures[name] = fuzz(name, inputs // len(FORMATS), Path(folder))
            figures[name]["seconds"] = time.monotonic() - begun_s
    return figures


def show_faults(found: dict[str, Any]) -> None:
    """The table of tries."""
    print(f"{found['points']} injection points in {found['seconds']} s, {len(found['wrong'])} of them with a fault")
    names = list(found["tries"])
    print(f"{'':>22}" + "".join(f"{name:>20}" for name in names))
    for mode in found["tries"][names[0]]:
        print(f"{mode:>22}" + "".join(f"{found['tries'][name][mode]:>20}" for name in names))
    for fault in found["wrong"][:20]:
        print(fault)


def main() -> int:
    """The command; ends with 1 where something was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--every", type=int, default=1, help="only every N-th call")
    parser.add_argument("--inputs", type=int, default=100_000, help="damaged inputs of all formats together")
    parser.add_argument("--within-s", type=float, default=900.0, help="stop injecting after so many seconds")
    parser.add_argument("--out", type=Path, default=None)
    arguments = parser.parse_args()
    fuzzed = fuzz_all(arguments.inputs)
    for name, figures in fuzzed.items():
        print(f"{name:>10}: " + ", ".join(f"{key} {value:.4g}" for key, value in figures.items()))
    modes = [*MODES, *TRACED] if shutil.which("strace") else list(MODES)
    if modes == list(MODES):
        print("NO STRACE HERE: the kernel's own calls are not struck, only those that the store and SQLite's VFS make")
    found = run(modes, arguments.every, within_s=arguments.within_s)
    show_faults(found)
    if arguments.out is not None:
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        figures = {"machine": machine(), "command": sys.argv, "faults": found, "fuzz": fuzzed, "peak_rss_mb": peak_mb}
        arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    return int(bool(found["wrong"]))


if __name__ == "__main__":
    sys.exit(main())
