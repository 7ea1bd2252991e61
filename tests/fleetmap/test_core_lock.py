"""Other threads of Python run while the core computes: no call that takes long keeps Python's lock."""

import operator
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import pytest

from support.core_arguments import CALLS, call_of

# Under 50 us for the points of a frame, the clones of a window, the samples of some seconds: few products of small matrices, or copies.
SHORT = """allocations compose_pose inertial_residual is_image_still linearise_track longest_gap_ns share_that_passes triangulate
    surfel_stride_px velocity_change_rows Filter.__init__ Filter.add_clone Filter.body_covariance Filter.cam_from_earlier
    Filter.correct_by_speed Filter.inflate Filter.inflate_velocity Filter.motion_between Filter.motion_since Filter.nav_state
    Filter.observe Filter.odom_from_body Filter.odom_from_clone Filter.predict_random_walk Filter.remove_clone Filter.return_to_clone
    ProtectionBank.__init__ ProtectionBank.level ProtectionBank.repeat ScenePainter.__init__ Tracker.__init__
    Tracker.add VoxelTable.__init__"""


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


@pytest.mark.parametrize("name", sorted(CALLS - set(SHORT.split())))
def test_others_run_while_the_core_computes(name: str) -> None:
    with another_thread() as count:
        for call in filter(None, map(partial(call_of, name), range(1000))):
            try:
                if any(lets_others_run(call, count) for _ in range(30)):
                    return
            except ValueError:
                pass
    pytest.fail("the lock is held, or all arguments were refused")
