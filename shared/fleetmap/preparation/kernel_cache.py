"""Kernels compiled ahead of time: steps that run the real code, what each compiled, and a note of it that later calls find."""

import hashlib
import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path

import fleetmap
from fleetmap.errors import FleetmapError, disk_errors

_LIBRARIES = ("numba", "llvmlite", "numpy")
Steps = Callable[[], Mapping[str, Callable[[], None]]]


def prepare_kernels(program: str, packages: Sequence[Path], steps: Steps, say: Callable[[str], None]) -> None:
    """Runs the steps, unless an earlier call did so for the same code, libraries, processor and settings of numba.

    packages: folders of all source that the kernels depend on. steps: called only if there is something to do, because what it imports
    takes a second. Raises FleetmapError where NUMBA_CACHE_DIR, or every folder that numba would choose, cannot be written.
    """
    folder = _writable(os.environ.get("NUMBA_CACHE_DIR"))
    note = (folder or Path(fleetmap.__file__).parent / "__pycache__") / f"prepared-{program}.json"
    print_of = _fingerprint(packages)
    if _is_done(note, print_of):
        say(f"nothing to compile: {note} holds for this code and processor")
        return
    started_s, before = time.perf_counter(), _compiled()
    todo = steps()
    from fleetmap.numerics.kernel import KERNELS

    with disk_errors("the compiled kernels cannot be kept", "make space, or set NUMBA_CACHE_DIR", FleetmapError):
        for number, (name, run) in enumerate(todo.items(), 1):
            step_s, had = time.perf_counter(), _compiled()
            run()
            say(f"[{number}/{len(todo)}] {name}: {_compiled() - had} compiled, {time.perf_counter() - step_s:.1f} s")
    folders = sorted({kernel.stats.cache_path for kernel in KERNELS})
    files = [str(file) for name in folders for file in sorted(Path(name).glob("*.nb[ci]"))]
    with suppress(
        OSError
    ):  # beside read-only source there is no note: the next call runs the steps again, from the cache
        note.parent.mkdir(exist_ok=True)
        note.write_text(json.dumps({"fingerprint": print_of, "files": files}), encoding="utf-8")
    kept = folder or f"{len(folders)} folders, one of them {folders[-1]}"
    say(f"{_compiled() - before} kernels compiled in {time.perf_counter() - started_s:.1f} s, kept in {kept}")


def _compiled() -> int:
    """Kernels that this process compiled, and did not find in the cache."""
    if "fleetmap.numerics.kernel" not in sys.modules:
        return 0
    from fleetmap.numerics.kernel import KERNELS

    return sum(sum(kernel.stats.cache_misses.values()) for kernel in KERNELS)


def _writable(named: str | None) -> Path | None:
    """The folder of NUMBA_CACHE_DIR; numba would silently take another one where it cannot write this."""
    if not named:
        return None
    folder = Path(named)
    advice = "give it to this user, or set NUMBA_CACHE_DIR to a folder that this user may write"
    with disk_errors(f"NUMBA_CACHE_DIR={folder} cannot be written", advice, FleetmapError):
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    return folder


def _is_done(note: Path, print_of: str) -> bool:
    try:
        noted = json.loads(note.read_text(encoding="utf-8"))
        return noted["fingerprint"] == print_of and all(Path(file).exists() for file in noted["files"])
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _fingerprint(packages: Sequence[Path]) -> str:
    """What numba's cache depends on: source files by size and time, versions, processor, settings."""
    digest = hashlib.sha256()
    for file in sorted(file for package in packages for file in package.rglob("*.py")):
        status = file.stat()
        digest.update(f"{file} {status.st_size} {status.st_mtime_ns}\n".encode())
    settings = {key: value for key, value in sorted(os.environ.items()) if key.startswith("NUMBA_")}
    versions = {name: metadata.version(name) for name in _LIBRARIES}
    digest.update(f"{sys.version} {versions} {_processor()} {settings}".encode())
    return digest.hexdigest()


def _processor() -> str:
    """Name and features of the processor, as far as the system tells them."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return " ".join(dict.fromkeys(line for line in lines if line.startswith(("model name", "flags", "Features"))))
    return platform.processor()
