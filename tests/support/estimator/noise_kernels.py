"""Measurement noise by hashing: the same for a landmark and a frame whatever was asked before."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.numerics.kernel import inner_kernel, kernel
from support.estimator.landmark_kernels import mixed, uniform
from support.estimator.statistics import FeatureStatistics, FlowStatistics

Float = NDArray[np.float64]
Words = NDArray[np.uint64]
_BORDER_PX = 19.0  # without clutter


class FeatureBuffers(NamedTuple):
    """Arrays that features are written to: rows (N,) of landmarks, pixels (N, 3), octaves (N,), descriptors (N, 4)."""

    rows: NDArray[np.int32]
    pixels: Float
    octaves: NDArray[np.int8]
    words: Words


@inner_kernel
def normal(bits: np.uint64, table: Float) -> float:
    """A standard normal from a table whose length is a power of two: no library function whose last bit varies."""
    return float(table[int(bits >> np.uint64(44)) & (table.shape[0] - 1)])


@inner_kernel
def slow_normal(key: np.uint64, phase: float, table: Float) -> float:
    """A standard normal that changes smoothly: independent at whole phases, in between interpolated."""
    step = math.floor(phase)
    share = phase - step
    before = normal(mixed(key, np.uint64(int(step))), table)
    after = normal(mixed(key, np.uint64(int(step) + 1)), table)
    return (before * (1.0 - share) + after * share) / math.sqrt(share * share + (1.0 - share) * (1.0 - share))


@kernel
def flow_noise(
    ids: Words,
    exact: Float,
    begun: Float,
    is_floor: NDArray[np.bool_],
    frame: int,
    seed: int,
    model: FlowStatistics,
    table: Float,
    pixels: Float,
    kept: NDArray[np.bool_],
) -> None:
    """Fills `pixels` with the measurement by optical flow of exact pixels (N, 3), corners that began at (N, 2).

    `kept` is false where the flow loses one. The error grows with the way since the beginning, along it and across it,
    by factors of the landmark's own (`slip` for the share that slides along edges; the floor's reflections hold corners
    back), plus white noise. Disparities are unknown, rough or wrong for stretches of time.
    """
    for n in range(ids.shape[0]):
        own = mixed(ids[n], np.uint64(seed))
        now = mixed(own, np.uint64(frame + 1000))
        is_slipping = uniform(mixed(own, np.uint64(2))) < model.slip_share
        own_along = model.slip if is_slipping else model.floor_along if is_floor[n] else model.along
        gain_along = own_along * normal(mixed(own, np.uint64(10)), table) - (
            model.floor_lag if is_floor[n] else model.lag
        )
        gain_across = (0.5 * model.slip if is_slipping else model.across) * normal(mixed(own, np.uint64(11)), table)
        du, dv = exact[n, 0] - begun[n, 0], exact[n, 1] - begun[n, 1]
        white_u, white_v = normal(mixed(now, np.uint64(20)), table), normal(mixed(now, np.uint64(21)), table)
        pixels[n, 0] = exact[n, 0] + gain_along * du - gain_across * dv + model.white_px * white_u
        pixels[n, 1] = exact[n, 1] + gain_along * dv + gain_across * du + model.white_px * white_v
        kept[n] = uniform(mixed(now, np.uint64(3))) >= model.lost_share
        phase = frame / model.stretch_frames + uniform(mixed(own, np.uint64(1)))
        stretch = mixed(own, np.uint64(int(phase) + 100))
        draw = uniform(mixed(stretch, np.uint64(5)))
        disparity = exact[n, 0] - exact[n, 2]
        if draw < model.disparity_wrong_share:
            disparity += model.disparity_wrong_px * (2.0 * uniform(mixed(stretch, np.uint64(6))) - 1.0)
        elif draw < model.disparity_wrong_share + model.disparity_rough_share:
            disparity += model.disparity_rough_bias_px + model.disparity_rough_px * normal(
                mixed(stretch, np.uint64(7)), table
            )
        slow, white = slow_normal(mixed(own, np.uint64(12)), phase, table), normal(mixed(now, np.uint64(22)), table)
        disparity += model.disparity_px * 0.7071 * (slow + white)
        is_known = uniform(mixed(stretch, np.uint64(4))) < model.disparity_known_share
        pixels[n, 2] = pixels[n, 0] - disparity if is_known else np.nan


@kernel
def detect(
    keys: Words,
    exact: Float,
    exact_octaves: Float,
    directions: Float,
    frame: int,
    seed: int,
    model: FeatureStatistics,
    table: Float,
    found: FeatureBuffers,
) -> int:
    """Number of features that a detector finds at exact pixels (N, 3); so many rows of `found` are filled.

    directions (N, 2): azimuth and elevation of the view. A descriptor follows from the look, with bits changed by the
    dirt, by the direction of view (in steps), by noise.
    """
    rows, pixels, octaves, words = found
    count = 0
    for n in range(keys.shape[0]):
        own = mixed(keys[n, 2], np.uint64(seed))
        now = mixed(own, np.uint64(frame + 5000))
        if uniform(mixed(now, np.uint64(1))) >= model.found_share:
            continue
        view = mixed(keys[n, 0], np.uint64(42))
        for axis in range(2):
            offset = uniform(mixed(keys[n, 0], np.uint64(41 + 10 * axis)))
            view = mixed(view, np.uint64(math.floor(directions[n, axis] / model.view_step_rad + offset) + 1000))
        if uniform(mixed(view, keys[n, 1])) >= model.view_share:
            continue
        octave = round(exact_octaves[n] + model.octave_sigma * normal(mixed(now, np.uint64(2)), table))
        if octave < 0 or octave > 7:
            continue
        is_slipping = uniform(mixed(now, np.uint64(7))) < model.slip_share
        sigma = (model.slip_px if is_slipping else model.corner_px) * 1.2**octave
        for axis in range(2):
            pixels[count, axis] = exact[n, axis] + sigma * normal(mixed(now, np.uint64(10 + axis)), table)
        disparity = exact[n, 0] - exact[n, 2] + model.disparity_px * normal(mixed(now, np.uint64(12)), table)
        if uniform(mixed(now, np.uint64(5))) < model.disparity_wrong_share:
            disparity += model.disparity_wrong_px * (2.0 * uniform(mixed(now, np.uint64(6))) - 1.0)
        is_known = uniform(mixed(now, np.uint64(4))) < model.disparity_known_share
        pixels[count, 2] = pixels[count, 0] - disparity if is_known else np.nan
        state = mixed(keys[n, 0], np.uint64(40))
        for word in range(4):
            state = mixed(state, np.uint64(word))
            words[count, word] = state
        change_bits(words, count, mixed(keys[n, 0], keys[n, 1]), model.dirt_bits)
        change_bits(words, count, view, model.view_bits)
        noise = int(model.noise_bits * 2.0 * uniform(mixed(now, np.uint64(44))) + 0.5)
        change_bits(words, count, mixed(now, np.uint64(43)), noise)
        octaves[count] = octave
        rows[count] = n
        count += 1
    return count


@kernel
def change_bits(words: Words, row: int, key: np.uint64, bits: int) -> None:
    """Flips `bits` bits of one descriptor at places that follow from the key (some may coincide and cancel)."""
    state = key
    for number in range(bits):
        if number % 8 == 0:
            state = mixed(state, np.uint64(number))
        place = (state >> np.uint64(8 * (number % 8))) & np.uint64(255)
        words[row, int(place >> np.uint64(6))] ^= np.uint64(1) << (place & np.uint64(63))


@kernel
def add_clutter(
    first: int, total: int, key: np.uint64, size_px: tuple[float, float], known_share: float, found: FeatureBuffers
) -> None:
    """Features that no other picture will show again, spread over the picture and the octaves as a detector spreads them."""
    _, pixels, octaves, words = found
    state = key
    for n in range(first, total):
        state = mixed(state, np.uint64(n))
        pixels[n, 0] = _BORDER_PX + uniform(mixed(state, np.uint64(1))) * (size_px[0] - 2 * _BORDER_PX)
        pixels[n, 1] = _BORDER_PX + uniform(mixed(state, np.uint64(2))) * (size_px[1] - 2 * _BORDER_PX)
        depth_draw = uniform(mixed(state, np.uint64(3)))
        is_known = uniform(mixed(state, np.uint64(4))) < known_share
        pixels[n, 2] = pixels[n, 0] - (3.0 + 30.0 * depth_draw * depth_draw) if is_known else np.nan
        draw = uniform(mixed(state, np.uint64(5)))
        octave = 0
        left = 0.217  # share of octave 0 of eight with a factor of 1.2 from one to the next
        while octave < 7 and draw >= left:
            draw -= left
            left /= 1.2
            octave += 1
        octaves[n] = octave
        for word in range(4):
            words[n, word] = mixed(state, np.uint64(20 + word))


@kernel
def spread(
    pixels: Float,
    order: NDArray[np.int64],
    taken: Float,
    min_distance_px: float,
    count: int,
    size_px: tuple[float, float],
) -> NDArray[np.int64]:
    """Up to `count` of the pixels (N, 2) at `order`, first come first served, none nearer than min_distance_px to another."""
    cell = min_distance_px
    columns, rows = int(size_px[0] / cell) + 1, int(size_px[1] / cell) + 1
    grid = np.full((rows, columns, 4), -1, np.int64)
    total = taken.shape[0]
    places = np.empty((total + count, 2))
    for n in range(total):
        places[n] = taken[n]
        put(grid, taken[n, 0], taken[n, 1], cell, n)
    chosen = np.empty(count, np.int64)
    found = 0
    for n in order:
        if found == count:
            break
        u, v = pixels[n, 0], pixels[n, 1]
        column, row = int(u / cell), int(v / cell)
        is_free = True
        for r in range(max(0, row - 1), min(rows, row + 2)):
            for c in range(max(0, column - 1), min(columns, column + 2)):
                for slot in range(4):
                    other = grid[r, c, slot]
                    if other >= 0:
                        du, dv = places[other, 0] - u, places[other, 1] - v
                        is_free = is_free and du * du + dv * dv >= cell * cell
        if is_free:
            places[total + found, 0], places[total + found, 1] = u, v
            put(grid, u, v, cell, total + found)
            chosen[found] = n
            found += 1
    return chosen[:found]


@kernel
def put(grid: NDArray[np.int64], u: float, v: float, cell: float, number: int) -> None:
    """Enters a place into the grid's cell; a fifth one in a cell is left out."""
    column = min(max(int(u / cell), 0), grid.shape[1] - 1)
    row = min(max(int(v / cell), 0), grid.shape[0] - 1)
    for slot in range(4):
        if grid[row, column, slot] < 0:
            grid[row, column, slot] = number
            return
