"""A store under faults at every file-system call, and every format under 10^5 damaged inputs.

A fault at every `--every`-th call for at most `--within-s`, and `--inputs` of all formats together. tests/support/storage/store_faults.py
says what is tried and what is asked of the store afterwards.
"""

import json
import tempfile
from pathlib import Path

from benchmarks.common.recorded_runs import Options, Results, benchmark
from support.storage.fuzzed_formats import FORMATS, fuzz
from support.storage.store_faults import MODES, run


@benchmark(every=1, inputs=100_000, within_s=900)
def main(options: Options) -> Results:
    fuzzed = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in FORMATS:
            fuzzed[name] = fuzz(name, options.inputs // len(FORMATS), Path(folder))
            print(f"{name:>15}: {json.dumps(fuzzed[name])}", flush=True)
    return {"faults": run(list(MODES), options.every, within_s=options.within_s), "fuzz": fuzzed}
