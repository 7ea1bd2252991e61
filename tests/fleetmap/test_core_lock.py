"""Other threads of Python run while the core computes: no call that takes long keeps Python's lock."""

import operator
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import pytest

from fleetmap import _core  # type: ignore[attr-defined]
from fleetmap.features.settings import StereoSettings
from fleetmap.pnp.pnp import REFINEMENT
from fleetmap.relocalization.settings import FixSettings
from support.core_arguments import Arguments

# Under 50 us for the points of a frame, the clones of a window, the samples of some seconds: few products of small matrices, or copies.
SHORT = """allocations common_ways_px compose_pose inertial_residual linearise_track longest_gap_ns share_that_passes triangulate
    surfel_stride_px
    Filter.__init__ Filter.add_clone Filter.body_covariance Filter.body_since Filter.cam_from_earlier Filter.inflate Filter.inflate_velocity
    Filter.motion_between Filter.motion_since Filter.nav_state Filter.observe Filter.odom_from_body Filter.odom_from_clone
    Filter.predict_random_walk Filter.remove_clone Filter.return_to_clone ScenePainter.__init__ Tracker.__init__ Tracker.add
    VoxelTable.__init__"""
MEMBERS = {
    name: getattr(_core, name) for name in dir(_core) if not name.startswith("_") and callable(getattr(_core, name))
}
CALLS = {name for name, member in MEMBERS.items() if not isinstance(member, type)} | {
    f"{name}.{method}"
    for name, member in MEMBERS.items()
    if isinstance(member, type)
    for method in dir(member)
    if (method == "__init__" or not method.startswith("_")) and callable(getattr(member, method))
}
NUMBER, SINGLES = np.zeros(1, np.int32), np.ones((5, 3), np.float32)
CONES, WORDS = (np.ones((5, 3)), SINGLES, SINGLES[:, 0].copy(), SINGLES[:, 0].copy()), np.zeros((5, 4), np.uint64)
QUADS, SIXES, FACES = np.ones((0, 9)), np.zeros((0, 6)), np.zeros((0, 6), np.int32)
TEXTURES = np.zeros(1 << 18, np.uint8), np.zeros((1, 14), np.int32), np.zeros((1, 1), np.int32), np.zeros(2, np.int32)
PICTURE = np.zeros((4, 4)), np.zeros((4, 4), np.float32), np.zeros((4, 4), np.int32)
# Arguments that hold together where those from signatures do not, of the object that a method belongs to.
GIVEN: dict[str, Callable[[Any], tuple[object, ...]]] = {
    "BlockCholesky.factorise": lambda pattern: (np.ones(pattern.size),),
    "BlockCholesky.solve": lambda pattern: (np.ones(pattern.size), np.ones(len(pattern.order()))),
    "BoxGrid.bake": lambda _: (
        QUADS,
        FACES,
        FACES[:, :2].copy(),
        0,
        np.ones((0, 5)),
        1.0,
        True,
        np.zeros((1, 4), np.float32),
    ),
    "BundleSolver.factorise_sparsely": lambda solver: (np.arange(len(solver.nodes()[0])),),
    "Filter.begin_frame_anew": lambda window: tuple(filter(None, [window.add_clone(0, np.zeros(3))])),
    "FixFinder": lambda _: (
        *(CONES, CONES[2], WORDS, np.eye(4)[None], np.arange(2), np.array([0, 2]), np.ones(6), 1.0, 1.2),
        *(FixSettings(), StereoSettings(), 0.35, REFINEMENT),
    ),
    "FixFinder.by_projection": lambda _: (
        (np.ones((5, 3)), np.ones((5, 2)), np.zeros(5, np.int8), WORDS),
        None,
        np.eye(4),
        9.0,
    ),
    "ScenePainter": lambda _: (np.full(6, 4.0), np.zeros((0, 0, 4), np.float32)),
    "ScenePainter.add": lambda _: (
        *(
            (QUADS, SIXES, FACES, SINGLES[0], np.ones(1)),
            (FACES[:, :2].copy(), SIXES),
            TEXTURES,
            np.eye(3),
            np.zeros(3),
        ),
        *(1, (0.0, 0.0), 1.0, 1, 1.0, np.zeros((0, 3)), False, *PICTURE),
    ),
    "descend": lambda _: (WORDS, WORDS[:1], NUMBER, NUMBER, NUMBER),
    "draw_discs": lambda _: (
        *(NUMBER[:0], np.zeros((0, 3)), np.zeros((0, 2)), np.eye(4), SINGLES[:0], TEXTURES[0][:0], TEXTURES[0][:0]),
        *(1.0, 1.0, np.zeros((4, 4, 3)), PICTURE[1]),
    ),
    "register_depth": lambda _: (PICTURE[1], np.ones((16, 3)), np.eye(4), np.ones(4), np.zeros(8), 1.0, 9, 9),
}


@contextmanager
def another_thread() -> Iterator[Callable[[], int]]:
    """A thread that counts, and how far it has come."""
    steps, ended, interval_s = [0], threading.Event(), sys.getswitchinterval()

    def run() -> None:
        while not ended.is_set():
            steps[0] += 1

    other = threading.Thread(target=run)
    sys.setswitchinterval(1e-6)
    other.start()
    try:
        yield partial(operator.getitem, steps, 0)
    finally:
        ended.set()
        sys.setswitchinterval(interval_s)
        other.join()


def lets_others_run(call: Callable[[], object], count: Callable[[], int]) -> bool:
    """Whether the other thread counts during a call.

    During the sum, which holds the lock, it asks for its turn: who lets go of the lock then waits until it had one. The interpreter
    itself, which would make room for it between two instructions, has none to execute before the last of the calls.
    """
    before, _, _, after = map(operator.call, (count, partial(sum, range(20_000)), call, count))
    return before != after


def given(name: str, arguments: Arguments, function: object, held: object = None) -> tuple[object, ...]:
    """Arguments for a function, or a method of an object that is held."""
    return GIVEN[name](held) if name in GIVEN else tuple(arguments.of(function))


def calls(name: str) -> Iterator[Callable[[], object]]:
    """A function or method with plain arguments of many kinds, of which it refuses some."""
    owner, _, method = name.rpartition(".")
    made = MEMBERS[owner or name]
    for seed in range(1000):
        arguments = Arguments(seed, plain_size=8)
        call = partial(made, *given(owner or name, arguments, made.__init__ if owner else made))
        if owner and method != "__init__":
            try:
                held = call()
            except ValueError:
                continue
            function = getattr(held, method)
            call = partial(function, *given(name, arguments, function, held))
        yield call


@pytest.mark.parametrize("name", sorted(CALLS - set(SHORT.split())))
def test_others_run_while_the_core_computes(name: str) -> None:
    with another_thread() as count:
        for call in calls(name):
            try:
                if any(lets_others_run(call, count) for _ in range(30)):
                    return
            except ValueError:
                pass
    pytest.fail("the lock is held, or all arguments were refused")
