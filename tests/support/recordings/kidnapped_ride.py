"""A ride during which the cameras are covered, and the robot is carried across the room, turned round and set down again."""

from functools import lru_cache

import numpy as np

from fleetmap.geometry import Array, se3, so3_exp
from support.recordings.recording_samples import START_NS, Sample
from support.worlds.box_room import Ride, ride_sample

FRAME_S = 0.1
COVERED_S = (3.6, 7.4)
# seconds, x, y, yaw: along the wall at y = 3, carried, along the wall at y = -3, a turn, along the first wall again
_STOPS = (
    (0.0, -2.0, 0.3, np.pi / 2),
    (2.6, 0.5, 0.6, np.pi / 2),
    (3.6, 0.4, 0.6, np.pi / 2),
    (7.4, 1.0, -0.3, -np.pi / 2),
    (9.6, -1.5, -0.6, -np.pi / 2),
    (12.0, -1.2, 0.2, np.pi / 2),
    (14.6, 0.8, 0.5, np.pi / 2),
)
APART_FRAMES = 96  # it has not turned yet
FRAMES = 147


def ride() -> Ride:
    """See the module; hands are never quite still."""

    def map_from_body(t_s: float) -> Array:
        times = [stop[0] for stop in _STOPS]
        k = int(np.clip(np.searchsorted(times, t_s, side="right") - 1, 0, len(_STOPS) - 2))
        a, b = np.array(_STOPS[k]), np.array(_STOPS[k + 1])
        share = float(np.clip((t_s - a[0]) / (b[0] - a[0]), 0, 1))
        share = share**3 * (10 - 15 * share + 6 * share**2)  # no jerk at either end
        x, y, yaw = a[1:] + share * (b[1:] - a[1:])
        sway = 0.03 * np.sin(2 * np.pi * share)
        return se3(so3_exp(np.array([0, 0, yaw])) @ so3_exp(np.array([sway, sway, 0])), np.array([x, y, 2 * sway]))

    return map_from_body


@lru_cache(maxsize=1)
def kidnapped() -> Sample:
    """The whole of it."""
    sample = ride_sample(ride(), FRAMES, FRAME_S)
    for n, stamp_ns in enumerate(sample.stamps_ns):
        if COVERED_S[0] < (stamp_ns - START_NS) * 1e-9 < COVERED_S[1]:
            sample.left[n], sample.right[n] = np.full_like(sample.left[n], 3), np.full_like(sample.right[n], 3)
    return sample
