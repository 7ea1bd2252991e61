"""The figures of `make demo`: what its reports say of the build and of the two robots; about three minutes."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.common.recorded_runs import Options, Results, benchmark
from support.recordings.hashes import tiles_of

REPOSITORY = Path(__file__).resolve().parents[3]


@benchmark()
def main(_: Options) -> Results:
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"BIN": str(Path(sys.executable).parent), "OUT": folder}
        subprocess.run([REPOSITORY / "deploy" / "demo.sh"], env=environment, stdin=subprocess.DEVNULL, check=True)
        found = {name: json.loads(Path(folder, f"{name}.json").read_text()) for name in ("build", "tote-1", "tote-2")}
        written = {f"{name}.tum": Path(folder, f"{name}.tum").read_text() for name in found}
        return found | {"map": tiles_of(Path(folder, "store"), "demo")} | written
