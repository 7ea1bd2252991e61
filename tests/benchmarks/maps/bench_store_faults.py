"""A store under faults at every file-system call, and every format under 10^5 damaged inputs.

`PYTHONPATH=tests python -m benchmarks.maps.bench_store_faults [--every N] [--inputs N] [--out FILE.json]`;
`tests/support/storage/store_faults.py` says what is tried and what is asked of the store afterwards. Exits with 1 on a fault.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

from support.storage.fuzzed_formats import FORMATS, fuzz
from support.storage.store_faults import MODES, run


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--every", type=int, default=1, help="only every N-th call")
    parser.add_argument("--inputs", type=int, default=100_000, help="damaged inputs of all formats together")
    parser.add_argument("--within-s", type=float, default=900.0, help="stop injecting after so many seconds")
    parser.add_argument("--out", type=Path, default=None)
    arguments = parser.parse_args()
    fuzzed = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in FORMATS:
            fuzzed[name] = fuzz(name, arguments.inputs // len(FORMATS), Path(folder))
            print(f"{name:>15}: {json.dumps(fuzzed[name])}", flush=True)
    found = run(list(MODES), arguments.every, within_s=arguments.within_s)
    print(json.dumps(found, indent=1))
    if arguments.out is not None:
        arguments.out.write_text(json.dumps({"faults": found, "fuzz": fuzzed}, indent=1) + "\n", encoding="utf-8")
    return int(bool(found["wrong"]))


if __name__ == "__main__":
    sys.exit(main())
