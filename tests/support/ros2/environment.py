"""ROS 2 of `make ros2-env`: the other side of what speaks ROS 2 here. Programs with it run in processes of their own."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from support.fleet.contracts_documents import REPOSITORY

ROS = REPOSITORY / ".ros2"
needs_ros = pytest.mark.skipif(
    not ROS.exists(), reason="NO ROS 2: nothing is tried with ROS itself; make ros2-env installs it"
)


# A domain of its own for every process of tests: of a run certainly, of several runs at once most likely.
_DOMAIN = 1 + (16 * os.getppid() + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])) % 100


def ros_environment() -> dict[str, str]:
    """Environment of a process in which Python of .venv has rclpy beside its own libraries, and nodes of this test process alone."""
    assert (ROS / ".complete").exists(), "make ros2-env did not end well; run it again"
    packages = next((ROS / "lib").glob("python3*/site-packages"))
    return {
        **os.environ,
        "LD_LIBRARY_PATH": str(ROS / "lib"),
        "PYTHONPATH": os.pathsep.join(map(str, (packages, REPOSITORY / "tests"))),
        "AMENT_PREFIX_PATH": str(ROS),
        "ROS_DOMAIN_ID": str(_DOMAIN),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(ROS / "log"),
    }


@contextmanager
def ros_program(*words: str) -> Iterator[subprocess.Popen[str]]:
    """A program of .venv's Python with ROS, such as ("-m", "locclient", ...), its output as a pipe of text. Interrupted at the end."""
    command = [sys.executable, *words]
    with subprocess.Popen(
        command, env=ros_environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as program:
        try:
            yield program
        finally:
            program.send_signal(signal.SIGINT)
            try:
                program.wait(10)
            except subprocess.TimeoutExpired:
                program.kill()
