"""ROS 2 of `make ros2-env`: the other side of what speaks ROS 2 here. Programs with it run in processes of their own."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import pytest

from support.fleet.contracts_documents import REPOSITORY

ROS = REPOSITORY / ".ros2"
needs_ros = pytest.mark.skipif(
    not ROS.exists(), reason="NO ROS 2: nothing is tried with ROS itself; make ros2-env installs it"
)


@cache
def _domain() -> tuple[int, socket.socket]:
    """A domain of ROS for this process, held by a bound port: tests of other processes neither hear nor disturb its nodes."""
    for number in range(1, 101):
        held = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            held.bind(("127.0.0.1", 17400 + number))
        except OSError:
            held.close()
            continue
        return number, held
    raise AssertionError("a hundred processes hold a domain of ROS 2 each")


def ros_environment() -> dict[str, str]:
    """Environment of a process in which Python of .venv has rclpy beside its own libraries, and nodes of this test process alone."""
    assert (ROS / ".complete").exists(), "make ros2-env did not end well; run it again"
    packages = next((ROS / "lib").glob("python3*/site-packages"))
    return {
        **os.environ,
        "LD_LIBRARY_PATH": str(ROS / "lib"),
        "PYTHONPATH": os.pathsep.join(map(str, (packages, REPOSITORY / "tests"))),
        "AMENT_PREFIX_PATH": str(ROS),
        "ROS_DOMAIN_ID": str(_domain()[0]),
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
