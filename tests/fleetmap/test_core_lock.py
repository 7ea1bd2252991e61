"""Other threads of Python run while the core computes: no call that takes long keeps Python's lock."""

import sys
import threading
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from fleetmap import core
from fleetmap.features.settings import StereoSettings
from fleetmap.odometry.filter.msckf import InvariantFilter
from fleetmap.odometry.filter.nav_state import NavState
from fleetmap.odometry.settings import FilterSettings, TrackerSettings
from fleetmap.pnp.pnp import REFINEMENT
from fleetmap.sensors.rectification import StereoCamera

NOISE = np.random.default_rng(1).integers(0, 256, (480, 640), np.uint8)
TINY, NOWHERE, ZERO = NOISE[:8, :8].copy(), np.zeros((0, 2), np.float32), np.zeros(3)
CAMERA = StereoCamera(400.0, 320.0, 240.0, 0.1, 640, 480)
PLACES = np.random.default_rng(2).uniform(50.0, 400.0, (200, 2))
PIXELS, IDS = np.column_stack([PLACES, PLACES[:, 0] - 8.0]), np.arange(200)
IMU = np.arange(0, 10**10, 10**7), np.zeros((1000, 3)), np.zeros((1000, 3))
STEREO = 60.0, 0.75, 0.93, 5, 4, 0.25
CALLS_AT_MOST = 3000


def window() -> InvariantFilter:
    window = InvariantFilter(NavState(), np.eye(15), FilterSettings(), [(CAMERA, np.eye(4))])
    for clone in range(12):
        window.add_clone(clone, ZERO)
    return window


def tracking() -> Callable[[], object]:
    tracker = core.Tracker(CAMERA.lens, TrackerSettings(), StereoSettings(), 60.0, REFINEMENT)
    tracker.begin(NOISE)
    half = core.halvings(NOISE, 1)[0]
    return lambda: tracker.track(NOISE, (NOISE, half, half), None, np.eye(4), True, None)


def updating() -> Callable[[], object]:
    held = window()
    for frame in range(12):
        held.observe(frame, 0, IDS, PIXELS)
    return lambda: held.update(IDS, np.zeros(200, bool), 1.0)


CALLS: dict[str, Callable[[], Callable[[], object]]] = {
    "Tracker.track": tracking,
    "Filter.update": updating,
    "Filter.correct_by_rest": lambda: partial(window().correct_by_rest, ZERO, 0.1, 99.0),
    "Filter.begin_frame_anew": lambda: window().begin_frame_anew,
    "Filter.predict_inertial": lambda: partial(window().predict_inertial, *IMU, 0, 10**10, (1e-3,) * 4, (1e-3,) * 4),
    "follow_pixels": lambda: partial(core.follow_pixels, NOISE, NOISE, PLACES, PLACES, 7, 3, 0.5, 6.0),
    "spread_corners": lambda: partial(core.spread_corners, NOISE, 100, 20.0, 12, 8, NOWHERE),
    "match_rows": lambda: partial(core.match_rows, *[NOISE] * 4, PLACES, PLACES[:, 0].copy(), *STEREO),
    "halvings": lambda: partial(core.halvings, NOISE, 3),
}


@pytest.mark.parametrize("name", CALLS)
def test_others_run_while_the_core_computes(name: str) -> None:
    """Threads are never made to take turns here: another one runs only while a call has let go of the lock by itself."""
    call, steps, ended, interval_s = CALLS[name](), [0], threading.Event(), sys.getswitchinterval()

    def run() -> None:
        while not ended.is_set():
            steps[0] += 1
            core.halvings(TINY, 1)  # lets go of the lock

    other = threading.Thread(target=run)
    sys.setswitchinterval(1000.0)
    try:
        other.start()
        is_seen = False
        for _ in range(CALLS_AT_MOST):
            before = steps[0]
            call()
            is_seen = steps[0] > before
            if is_seen:
                break
        ended.set()
        other.join()
    finally:
        sys.setswitchinterval(interval_s)
    assert is_seen
