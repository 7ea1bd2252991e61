"""What a robot does before its first frame so that no later one has to wait."""

import gc
import os
import pickle
import subprocess
import sys
import weakref
from pathlib import Path

import pytest

from locclient.robot.jit_warmup import drop_compiler_code, gc_frozen
from mapserver.store import MapStore
from support.worlds import robot_world

DRIVE = """
import pickle, sys, time
from pathlib import Path
from fleetmap.numerics.kernel import KERNELS
from fleetmap.sensors.rectification import Rectifier
from locclient.cli import warm_up_steps
from locclient.localization.settings import LocalizerSettings
from locclient.robot.robot import Robot
from locclient.robot.version_trial import TrialSettings

def compiled():
    return {(kernel.py_func.__module__, kernel.py_func.__name__, str(s)) for kernel in KERNELS for s in kernel.signatures}

for run in warm_up_steps().values():
    run()
prepared = compiled()
rig, loaded, bundles = pickle.loads(Path(sys.argv[1]).read_bytes())
robot = Robot(rig, Rectifier(rig), LocalizerSettings(), TrialSettings(), time.process_time)
robot.use(loaded)
print(sum(robot.handle(bundle).estimate.fix is not None for bundle in bundles) > 3, len(prepared) > 20, compiled() - prepared)
print({"correct", "is_steady"} <= {name for _, name, _ in prepared}, "wheels and rest, which this drive lacks")
"""


class Ring:
    """Refers to itself: only the collector can end it."""

    def __init__(self) -> None:
        self.me = self


def test_what_lived_before_is_left_alone_and_what_comes_later_is_not() -> None:
    before = Ring()
    of_before = weakref.ref(before)
    with gc_frozen():
        del before
        of_later = weakref.ref(Ring())
        gc.collect()
        assert of_before() is not None
        assert of_later() is None
        assert gc.get_freeze_count() > 0
    gc.collect()
    assert of_before() is None
    assert gc.get_freeze_count() == 0


def test_a_robot_that_drives_uses_no_kernel_that_prepare_left_out(tmp_path: Path) -> None:
    """In a process of its own, where no other test has compiled anything."""
    with MapStore.open(tmp_path / "store", create=True) as store:
        robot_world.save(store)
        world = robot_world.calibration(), robot_world.loaded(store), list(robot_world.bundles(40))
    (tmp_path / "world").write_bytes(pickle.dumps(world))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-c", DRIVE, str(tmp_path / "world")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-2:] == ["True True set()", "True wheels and rest, which this drive lacks"]


COMPILER = """
import re
from pathlib import Path
import numba
from locclient.robot.jit_warmup import drop_compiler_code

def resident_kb():
    found = re.findall(r"r-xp .*libllvmlite[^\\n]*\\n(?:.*\\n){0,4}?Rss: +([0-9]+) kB", Path("/proc/self/smaps").read_text())
    return sum(map(int, found))

numba.njit(lambda x: x + 1)(1)
before, dropped, after = resident_kb(), drop_compiler_code(), resident_kb()
print(before > 5000, dropped > 5_000_000, after < before / 20, numba.njit(lambda x: x + 2)(1))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process of its mappings")
def test_the_compiler_leaves_memory_and_comes_back_when_it_is_needed() -> None:
    done = subprocess.run([sys.executable, "-c", COMPILER], check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["True", "True", "True", "3"]


def test_code_that_differs_from_its_file_is_kept(tmp_path: Path) -> None:
    changed = tmp_path / "smaps"
    changed.write_text(
        "10000-20000 r-xp 00000000 fe:01 1  /lib/libllvmlite.so\nRss: 64 kB\nPrivate_Dirty:  4 kB\nAnonymous:  4 kB\n"
    )
    assert drop_compiler_code(changed) == 0
    assert drop_compiler_code(tmp_path / "missing") == 0
