"""How near a drive comes to a failure: for each way to fail a figure that is 1 where the failure begins."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.failure_definition import (
    BLIND_S,
    CHI2_3_0999,
    ERROR_LIMIT_DEG,
    ERROR_LIMIT_M,
    RADIUS_LIMIT_M,
    SILENT_S,
    radius_95_m,
)
from fleetmap.geometry import Array
from fleetmap.messages import Status
from locclient.replay.run_metrics import FrameRecord

KINDS = ("wrong", "outside its bound", "blind")
_BLOCK_S, _RATE_HZ = 10.0, 15.0
_WITHOUT = (Status.LOST, Status.AMBIGUOUS)


class Blocks(NamedTuple):
    """Largest figures of each ten seconds of a drive, one array (B,) for each of KINDS."""

    wrong: Array
    outside: Array
    blind: Array


def closeness(frames: list[FrameRecord]) -> Blocks:
    """The figures of a drive, from its first fix on.

    wrong: the smallest error of any second in which a position was claimed, as a share of the limit. outside: the same of the error
    over its 99.9 % bound. blind: the smallest 95 % radius of any two seconds over its limit, or the time without any position
    over those two seconds, whichever is more.
    """
    first = next((k for k, frame in enumerate(frames) if frame.has_fix), len(frames))
    frames = frames[first:]
    wrong, outside, blind = (np.zeros(len(frames)) for _ in KINDS)
    for k, frame in enumerate(frames):
        radius = radius_95_m(frame.cov_rot_trans) / RADIUS_LIMIT_M
        blind[k] = 1.0 if frame.status in _WITHOUT else min(radius, 1.0)
        if frame.error_map_m is None or frame.cov_rot_trans is None or frame.error_m is None:
            continue
        turned = 0.0 if frame.error_rad is None else np.degrees(frame.error_rad) / ERROR_LIMIT_DEG
        wrong[k] = max(frame.error_m / ERROR_LIMIT_M, turned) if frame.status is Status.TRACKING else 0.0
        squared = frame.error_map_m @ np.linalg.solve(frame.cov_rot_trans[3:, 3:], frame.error_map_m)
        outside[k] = np.sqrt(squared / CHI2_3_0999)
    lasted = _lasted_s(np.array([frame.status in _WITHOUT for frame in frames], bool)) / BLIND_S
    return Blocks(
        _blocks(_held(wrong, SILENT_S)), _blocks(_held(outside, SILENT_S)),
        _blocks(np.maximum(_held(blind, BLIND_S), np.minimum(lasted, 1.0))),
    )  # fmt: skip


def _held(values: Array, duration_s: float) -> Array:
    """(N,) smallest value of the frames of the last so many seconds; 0 where there are not so many yet."""
    size = int(duration_s * _RATE_HZ) + 1
    if len(values) < size:
        return np.zeros(len(values))
    smallest = np.lib.stride_tricks.sliding_window_view(values, size).min(axis=1)
    return np.concatenate([np.zeros(size - 1), smallest])


def _lasted_s(is_without: NDArray[np.bool_]) -> Array:
    """(N,) for how long it has lasted."""
    numbers = np.arange(len(is_without))
    last_with = np.maximum.accumulate(np.where(is_without, -1, numbers)) if len(numbers) else numbers
    return np.asarray((numbers - last_with) / _RATE_HZ)


def _blocks(values: Array) -> Array:
    """Largest value of each block; a last block of less than half its length is left out."""
    size = int(_BLOCK_S * _RATE_HZ)
    starts = [start for start in range(0, len(values), size) if len(values) - start >= size // 2]
    return np.array([values[start : start + size].max() for start in starts])
