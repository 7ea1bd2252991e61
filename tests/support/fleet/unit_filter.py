"""A program under the filters of system calls of a systemd unit, without systemd: by Debian's python3-seccomp, on the system's Python.

`python unit_filter.py UNIT PROGRAM...` installs them as systemd 252 does, and becomes the program.
"""

import errno
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

PYTHON = "/usr/bin/python3"
_NAMESPACES = (0x20000, 0x2000000, 0x4000000, 0x8000000, 0x10000000, 0x20000000, 0x40000000)  # CLONE_NEW*
_EXEC = 4  # PROT_EXEC; with PROT_WRITE, 2, in mmap


def filtered(unit: Path, command: list[str]) -> list[str]:
    """The command line that runs a command under a unit's filters; skips the test where they cannot be had."""
    import pytest

    asked = subprocess.run([PYTHON, "-c", "import seccomp"], capture_output=True, check=False)
    if asked.returncode or shutil.which("systemd-analyze") is None:
        pytest.skip(
            "NO SECCOMP: the units' filters are not tried; install Debian's python3-seccomp and systemd to do it"
        )
    return [PYTHON, __file__, str(unit), *command]


def _groups() -> dict[str, set[str]]:
    """System calls of systemd's groups such as @system-service."""
    command = ["systemd-analyze", "--no-pager", "syscall-filter"]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    words: dict[str, list[str]] = {}
    for line in listed.splitlines():
        if line.startswith("@"):
            words[line] = []
        elif line.startswith("    ") and not line.strip().startswith("#"):
            words[next(reversed(words))].append(line.strip())

    def calls(name: str) -> set[str]:
        return set().union(*(calls(word) if word.startswith("@") else {word} for word in words[name]))

    return {name: calls(name) for name in words}


def _install(unit: Path) -> None:
    import seccomp

    values: dict[str, list[str]] = {}
    for line in unit.read_text("utf-8").splitlines():
        name, _, value = line.partition("=")
        values.setdefault(name, []).append(value)
    groups = _groups()
    allowed = groups["@default"]
    for value in values["SystemCallFilter"]:
        calls = set().union(*(groups[name] for name in value.lstrip("~").split()))
        allowed = allowed - calls if value.startswith("~") else allowed | calls
    assert [values[name] for name in ("RestrictNamespaces", "MemoryDenyWriteExecute")] == [["yes"], ["yes"]]
    families = {getattr(socket, name) for name in values["RestrictAddressFamilies"][0].split()}
    more = seccomp.SyscallFilter(seccomp.ALLOW)
    for family in set(range(64)) - families:
        more.add_rule(seccomp.ERRNO(errno.EAFNOSUPPORT), "socket", seccomp.Arg(0, seccomp.EQ, family))
    more.add_rule(seccomp.ERRNO(errno.ENOSYS), "clone3")
    for call, argument, bits in (
        *((call, 0, flag) for call in ("clone", "unshare") for flag in _NAMESPACES),
        ("mmap", 2, _EXEC | 2), ("mprotect", 2, _EXEC), ("pkey_mprotect", 2, _EXEC), ("shmat", 2, 0o100000),
    ):  # fmt: skip
        more.add_rule(seccomp.ERRNO(errno.EPERM), call, seccomp.Arg(argument, seccomp.MASKED_EQ, bits, bits))
    more.load()
    main = seccomp.SyscallFilter(seccomp.ERRNO(getattr(errno, values["SystemCallErrorNumber"][0])))
    for call in sorted(allowed):
        if seccomp.resolve_syscall(seccomp.Arch(), call) != -1:  # unknown on this machine
            main.add_rule(seccomp.ALLOW, call)
    main.load()  # the last: it denies further ones


if __name__ == "__main__":
    _install(Path(sys.argv[1]))
    os.execv(sys.argv[2], sys.argv[2:])
