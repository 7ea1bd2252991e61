"""The figures of `make demo`: what its reports say of the build and of the two robots.

`python tests/benchmarks/robot/bench_demo.py --out FILE.json`; about three minutes.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[3]


def main() -> None:
    """Runs the demo in a temporary folder; writes its reports as one table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"BIN": str(Path(sys.executable).parent), "OUT": folder}
        subprocess.run([REPOSITORY / "deploy" / "demo.sh"], env=environment, stdin=subprocess.DEVNULL, check=True)
        reports = {name: json.loads(Path(folder, f"{name}.json").read_text()) for name in ("build", "tote-1", "tote-2")}
    options.out.write_text(json.dumps(reports, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
