"""Where the CPU seconds of a build and of a robot's frame go: by stage, compiled code apart from Python, decoding apart from both.

    PYTHONPATH=tests python -m benchmarks.profiled [RECORDING]     (`make profile`; without a RECORDING into docs/performance.md)

Each thread's CPU clock is read where a stage, a function of the core or of OpenCV, or a pool's task begins and ends; what passed since the
thread's last look belongs to what it did until then. A task belongs to the stage that submitted it. Nothing is sampled, so that other
processes on the machine change the seconds and not the shares. The looks cost some percent.
"""

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextvars import ContextVar, copy_context
from functools import partial, wraps
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from benchmarks.common.recorded_runs import kept_folder, played, recorded, surveyed
from fleetmap import _core
from fleetmap.recordings import Recording, open_recording
from fleetmap.recordings.images import decode_depth, decode_grey
from fleetmap.sensors.rectification import Rectifier
from locclient.localization.map_query import MapQuery
from locclient.localization.perception import Perception
from locclient.robot.robot import Robot
from mapserver import build_map
from mapserver.calibration.recordings import estimate_calibration
from mapserver.drafting.admission import checked
from mapserver.drafting.draft_evidence import TileChooser, examine_draft, probed_frames
from mapserver.plugins.dense_maps.stage import make_dense_maps
from mapserver.survey.finish.frame_adjustment import place_frames
from mapserver.survey.finish.map_assembly import assemble
from mapserver.survey.stages import adjust_chain, close_loops, follow, match_again, refine
from studies.study import between_marks

Function = Callable[..., Any]
PAGE = Path(__file__).parents[2] / "docs" / "performance.md"
DECODING, COMPILED, PYTHON = KINDS = "decoding", "compiled", "Python, numpy"
OTHER = "other"
# What each begins; one inside another is taken from it. A generator's work is not its call's.
STAGES: dict[str, dict[str, list[Function]]] = {
    "build": {
        "opening, hashing": [open_recording, Recording.readable, Recording.content_hash],
        "examination": [checked],
        "self-calibration": [estimate_calibration],
        "rectification": [Rectifier.rectify],
        "odometry, keyframes": [follow],
        "neighbours, local adjustment": [adjust_chain],
        "loops": [close_loops],
        "global adjustment": [match_again, refine],
        "frames, assembly": [place_frames, assemble],
        "features of held-out frames": [probed_frames],
        "tiles": [TileChooser.choose],
        "grid, surfels": [make_dense_maps],
        "examining the draft": [examine_draft],
    },
    "frame": {
        "rectification": [Rectifier.rectify],
        "image quality": [Perception._judge],
        "odometry": [Perception.perceive],
        "map query": [MapQuery.step],
        "robot": [Robot.handle],
    },
}


class Doing(NamedTuple):
    """What a thread does."""

    stage: str = OTHER
    kind: str = PYTHON


_NOTHING = Doing()


class Account:
    """CPU seconds of all threads by what they did."""

    def __init__(self) -> None:
        self.spent_s: defaultdict[Doing, float] = defaultdict(float)
        self._doing = ContextVar("doing", default=_NOTHING)
        self._thread, self._lock = threading.local(), threading.Lock()

    def look(self) -> None:
        """Charges what the thread spent since its last look to what it does."""
        last_s, now_s = getattr(self._thread, "last_s", 0.0), time.thread_time()
        with self._lock:
            self.spent_s[self._doing.get()] += now_s - last_s
        self._thread.last_s = now_s

    def measured(self, function: Function, stage: str = "", kind: str = "") -> Function:
        """The function, charged to a stage, to a kind, or both. All of a decoder is decoding."""

        @wraps(function)
        def run(*args: Any, **options: Any) -> Any:
            before = self._doing.get()
            if before.kind == DECODING:
                return function(*args, **options)
            self.look()
            token = self._doing.set(Doing(stage or before.stage, kind or PYTHON))
            try:
                return function(*args, **options)
            finally:
                self.look()
                self._doing.reset(token)

        return run

    def submitting(self, submit: Function) -> Function:
        """A pool's `submit` that hands on what the submitting thread does."""

        def task(function: Function, *args: Any, **options: Any) -> Any:
            self._thread.last_s = time.thread_time()
            try:
                return function(*args, **options)
            finally:
                self.look()

        return lambda pool, *task_args, **options: submit(pool, copy_context().run, task, *task_args, **options)


def measure(account: Account, stages: dict[str, list[Function]]) -> None:
    """Puts measured functions in the place of the stages', of decoders, and of all of the core and of OpenCV but constructors.

    A method goes into its class, a function into all modules that hold it by a name.
    """
    wrapped: dict[int, Function] = {}
    for held in [*vars(_core).values(), *vars(cv2).values()]:
        if isinstance(held, type):
            for name, method in list(vars(held).items()):
                if type(method).__name__ in {"nb_method", "method_descriptor"} and not name.startswith("__"):
                    setattr(held, name, account.measured(method, kind=COMPILED))
        elif type(held).__name__ in {"nb_func", "builtin_function_or_method"}:
            wrapped[id(held)] = account.measured(held, kind=COMPILED)
    for function in (decode_grey, decode_depth):
        wrapped[id(function)] = account.measured(function, kind=DECODING)
    for stage, functions in stages.items():
        for function in functions:
            *owners, name = function.__qualname__.split(".")
            if owners:
                setattr(getattr(sys.modules[function.__module__], owners[0]), name, account.measured(function, stage))
            else:
                wrapped[id(function)] = account.measured(function, stage)
    for module in list(sys.modules.values()):
        for name, held in list(getattr(module, "__dict__", {}).items()):
            if id(held) in wrapped:
                setattr(module, name, wrapped[id(held)])
    ThreadPoolExecutor.submit = account.submitting(ThreadPoolExecutor.submit)


def table(what: str, run: Callable[[], int]) -> str:
    """The stages of `run`, which gives how many of them there were, in Markdown: seconds of a build, milliseconds of a frame."""
    account, stages = Account(), STAGES[what]
    measure(account, stages)
    begun_s = time.process_time()
    account.look()
    account.spent_s.clear()
    scale = (1.0 if what == "build" else 1e3) / run()
    account.look()
    whole_s = time.process_time() - begun_s
    account.spent_s[_NOTHING] += whole_s - sum(account.spent_s.values())  # threads of libraries
    rows = [
        f"| stage | {' | '.join(KINDS)} | {'s' if what == 'build' else 'ms'} | share |",
        "|---" * (len(KINDS) + 3) + "|",
    ]
    for name, counted in {**{stage: [stage] for stage in (*stages, OTHER)}, "**all**": [*stages, OTHER]}.items():
        spent_s = [sum(account.spent_s[Doing(stage, kind)] for stage in counted) for kind in KINDS]
        cells = " | ".join(f"{scale * value:.2f}" for value in (*spent_s, sum(spent_s)))
        rows.append(f"| {name} | {cells} | {sum(spent_s) / whole_s:.0%} |")
    return "\n".join(rows)


def build(recording: Path) -> int:
    """One build into a new store."""
    with tempfile.TemporaryDirectory() as scratch:
        build_map(recording, Path(scratch) / "store", "profiled")
    return 1


def frames(recording: Path, store: Path) -> int:
    """The frames of a robot in a store's map."""
    return len(played(recording, store).frames)


def imports_s(statement: str) -> float:
    """CPU seconds of an interpreter that imports something."""
    begun_s = sum(os.times()[2:4])
    subprocess.run([sys.executable, "-c", statement], check=True)
    return sum(os.times()[2:4]) - begun_s


def main() -> None:
    """Tables of a recording's build and of a robot's frames; of a given recording the build's alone, printed."""
    given, work = [Path(word) for word in sys.argv[1:]], kept_folder()
    work.mkdir(parents=True, exist_ok=True)
    runs = [("build", partial(build, given[0] if given else recorded(work, ("--seed", "1"), "five-aisles")))]
    if not given:
        runs.append(("frame", partial(frames, recorded(work, ("--robot", "tote-1", "--day", "1")), surveyed(work))))
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        made = [f"## A {what}\n\n{pool.submit(table, what, run).result()}" for what, run in runs]
    begins = {"build": "from mapserver import build_map", "run": "import locclient.daemon.daemon"}
    made += [f"Interpreter and imports of `{what}`: {imports_s(each):.2f} s." for what, each in begins.items()]
    print("\n\n".join(made))
    if not given:
        PAGE.write_text(between_marks(PAGE.read_text(), "\n\n".join(made), PAGE))


if __name__ == "__main__":
    main()
