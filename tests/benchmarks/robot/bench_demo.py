"""The figures of `make demo`: what its reports say of the build and of the two robots.

`PYTHONPATH=tests python -m benchmarks.robot.bench_demo --out FILE.json`; about three minutes.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.common.recorded_runs import Options, Results, benchmark

REPOSITORY = Path(__file__).resolve().parents[3]


@benchmark()
def main(_: Options) -> Results:
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"BIN": str(Path(sys.executable).parent), "OUT": folder}
        subprocess.run([REPOSITORY / "deploy" / "demo.sh"], env=environment, stdin=subprocess.DEVNULL, check=True)
        return {name: json.loads(Path(folder, f"{name}.json").read_text()) for name in ("build", "tote-1", "tote-2")}
