"""Measurement noise by hashing."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from support.estimator.hashing import Words, mixed, normal, uniform
from support.estimator.statistics import FeatureStatistics, FlowStatistics

_BORDER_PX = 19.0  # without clutter
_POWERS = np.cumprod([1.0] + [1.2] * 7)  # of the octaves; a library function's last bit varies
Features = tuple[NDArray[np.int64], Array, NDArray[np.int8], Words]
"""Rows (N,) of landmarks, pixels (N, 3), the third NaN where the disparity is unknown, octaves (N,), descriptors (N, 4)."""


def slow_normal(key: Words, phase: Array, table: Array) -> Array:
    """Standard normals that change smoothly: independent at whole phases, in between interpolated."""
    step = np.floor(phase).astype(np.int64)
    share = phase - step
    before, after = normal(mixed(key, step), table), normal(mixed(key, step + 1), table)
    return (before * (1.0 - share) + after * share) / np.sqrt(share * share + (1.0 - share) * (1.0 - share))


def flow_noise(
    ids: Words, exact: Array, begun: Array, is_floor: NDArray[np.bool_], frame: int, seed: int, model: FlowStatistics, table: Array
) -> tuple[Array, NDArray[np.bool_]]:  # fmt: skip
    """Measurements by optical flow of exact pixels (N, 3), corners that began at (N, 2); False where the flow loses one.

    The error grows with the way since the beginning, along it and across it, by factors of the landmark's own (`slip` for the share
    that slides along edges; the floor's reflections hold corners back), plus white noise. Disparities are unknown, rough or wrong for
    stretches of time.
    """
    own = mixed(ids, seed)
    now = mixed(own, frame + 1000)
    is_slipping = uniform(mixed(own, 2)) < model.slip_share
    own_along = np.where(is_slipping, model.slip, np.where(is_floor, model.floor_along, model.along))
    along = own_along * normal(mixed(own, 10), table) - np.where(is_floor, model.floor_lag, model.lag)
    across = np.where(is_slipping, 0.5 * model.slip, model.across) * normal(mixed(own, 11), table)
    du, dv = (exact[:, :2] - begun).T
    u = exact[:, 0] + along * du - across * dv + model.white_px * normal(mixed(now, 20), table)
    v = exact[:, 1] + along * dv + across * du + model.white_px * normal(mixed(now, 21), table)
    phase = frame / model.stretch_frames + uniform(mixed(own, 1))
    stretch = mixed(own, phase.astype(np.int64) + 100)
    draw, disparity = uniform(mixed(stretch, 5)), exact[:, 0] - exact[:, 2]
    wrong = model.disparity_wrong_px * (2.0 * uniform(mixed(stretch, 6)) - 1.0)
    rough = model.disparity_rough_bias_px + model.disparity_rough_px * normal(mixed(stretch, 7), table)
    is_wrong, is_fine = (
        draw < model.disparity_wrong_share,
        draw >= model.disparity_wrong_share + model.disparity_rough_share,
    )
    disparity = disparity + np.where(is_wrong, wrong, np.where(is_fine, 0.0, rough))
    slow, white = slow_normal(mixed(own, 12), phase, table), normal(mixed(now, 22), table)
    disparity += model.disparity_px * 0.7071 * (slow + white)
    is_known = uniform(mixed(stretch, 4)) < model.disparity_known_share
    kept = uniform(mixed(now, 3)) >= model.lost_share
    return np.stack([u, v, np.where(is_known, u - disparity, np.nan)], axis=1), kept


def detect(
    keys: Words, exact: Array, exact_octaves: Array, directions: Array, frame: int, seed: int, model: FeatureStatistics, table: Array
) -> Features:  # fmt: skip
    """Detections at exact pixels (N, 3).

    directions (N, 2): azimuth and elevation of the view. A descriptor follows from the look, with bits changed by the
    dirt, by the direction of view (in steps), by noise.
    """
    now = mixed(mixed(keys[:, 2], seed), frame + 5000)
    view = mixed(keys[:, 0], 42)
    for axis in range(2):
        offset = uniform(mixed(keys[:, 0], 41 + 10 * axis))
        view = mixed(view, np.floor(directions[:, axis] / model.view_step_rad + offset).astype(np.int64) + 1000)
    octaves = np.rint(exact_octaves + model.octave_sigma * normal(mixed(now, 2), table)).astype(np.int64)
    is_found = (uniform(mixed(now, 1)) < model.found_share) & (uniform(mixed(view, keys[:, 1])) < model.view_share)
    rows = np.flatnonzero(is_found & (octaves >= 0) & (octaves <= 7))
    keys, now, view, octaves, exact = keys[rows], now[rows], view[rows], octaves[rows], exact[rows]
    is_slipping = uniform(mixed(now, 7)) < model.slip_share
    sigma = np.where(is_slipping, model.slip_px, model.corner_px) * _POWERS[octaves]
    u, v = (exact[:, axis] + sigma * normal(mixed(now, 10 + axis), table) for axis in range(2))
    disparity = exact[:, 0] - exact[:, 2] + model.disparity_px * normal(mixed(now, 12), table)
    wrong = model.disparity_wrong_px * (2.0 * uniform(mixed(now, 6)) - 1.0)
    disparity += np.where(uniform(mixed(now, 5)) < model.disparity_wrong_share, wrong, 0.0)
    is_known = uniform(mixed(now, 4)) < model.disparity_known_share
    pixels = np.stack([u, v, np.where(is_known, u - disparity, np.nan)], axis=1)
    state, words = mixed(keys[:, 0], 40), np.empty((len(rows), 4), np.uint64)
    for word in range(4):
        state = words[:, word] = mixed(state, word)
    _change_bits(words, mixed(keys[:, 0], keys[:, 1]), np.full(len(rows), model.dirt_bits))
    _change_bits(words, view, np.full(len(rows), model.view_bits))
    noise = (model.noise_bits * 2.0 * uniform(mixed(now, 44)) + 0.5).astype(np.int64)
    _change_bits(words, mixed(now, 43), noise)
    return rows, pixels, octaves.astype(np.int8), words


def _change_bits(words: Words, keys: Words, counts: NDArray[np.int64]) -> None:
    """Flip a number of bits of descriptors (N, 4) at places that follow from keys (N,) (some may coincide and cancel)."""
    states = [keys]
    for first in range(0, int(counts.max(initial=0)), 8):
        states.append(mixed(states[-1], first))
    if len(states) == 1:
        return
    places = np.stack(states[1:], axis=1).astype("<u8").view(np.uint8).reshape(len(keys), -1)
    flips = np.uint64(1) << (places & 63).astype(np.uint64)
    flips[np.arange(places.shape[1]) >= counts[:, None]] = 0
    for word in range(4):
        words[:, word] ^= np.bitwise_xor.reduce(np.where(places >> 6 == word, flips, np.uint64(0)), axis=1)


def clutter(first: int, total: int, key: int, size_px: tuple[float, float], known_share: float) -> Features:
    """Features `first` to `total` of a picture that no other will show again, spread over it and the octaves as a detector spreads them."""
    numbers = np.arange(first, total)
    state = mixed(np.full(len(numbers), key, np.uint64), numbers)
    u, v = (_BORDER_PX + uniform(mixed(state, 1 + axis)) * (size_px[axis] - 2 * _BORDER_PX) for axis in range(2))
    depth_draw = uniform(mixed(state, 3))
    is_known = uniform(mixed(state, 4)) < known_share
    pixels = np.stack([u, v, np.where(is_known, u - (3.0 + 30.0 * depth_draw * depth_draw), np.nan)], axis=1)
    draw, octaves = uniform(mixed(state, 5)), np.zeros(len(state), np.int8)
    # share of octave 0 of eight with a factor of 1.2 from one to the next
    left, goes_on = 0.217, np.ones(len(state), bool)
    for _ in range(7):
        goes_on &= draw >= left
        draw = np.where(goes_on, draw - left, draw)
        octaves += goes_on
        left /= 1.2
    words = np.stack([mixed(state, 20 + word) for word in range(4)], axis=1)
    return np.full(len(state), -1), pixels, octaves, words
