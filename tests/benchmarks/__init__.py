"""Accuracy and speed, each a program: `PYTHONPATH=tests python -m benchmarks.robot.bench_demo`; `--help` names its options.

Linear algebra has one thread, as in robots and servers: others would burn a second core on small matrices. numpy is not loaded yet.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
