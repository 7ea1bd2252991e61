"""Inner loop of the table of observations: selection of tracks to use, and the start of their triangulation."""

import math

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel

Ids = NDArray[np.int64]


@kernel
def take(
    ids: Ids,
    frames: Ids,
    pixels: Array,
    order: Ids,
    alive: Ids,
    due: NDArray[np.bool_],
    held: Ids,
    camera: Array,
    far_px: float,
    stays: NDArray[np.bool_],
    rows: Ids,
    starts: Ids,
    anchors: Ids,
    points_cam: Array,
) -> int:
    """Number T of tracks with two observations or more in the clones `held` that are due, or ended: not among `alive`.

    ids (M,), frames (M,), pixels (M, 3) u_left v u_right; order (M,): rows by id, earlier ones first; alive (A,) ascending,
    due (A,). camera: focal, cx, cy, focal * baseline. Filled: stays (M,), all False before, of what is used later; rows (M,)
    in the order of the tracks, starts (T + 1,) delimiting each one's, anchors (T,) and points_cam (T, 3) as in `tracks.TrackBatch`:
    the stereo point of the nearest view; as far as a disparity of far_px along the last ray where no view has a disparity.
    """
    tracks, taken, lives = 0, 0, 0
    starts[0] = 0
    at = 0
    while at < len(order):
        number, first = ids[order[at]], taken
        while at < len(order) and ids[order[at]] == number:
            for clone in held:
                if clone == frames[order[at]]:
                    rows[taken] = order[at]
                    taken += 1
                    break
            at += 1
        while lives < len(alive) and alive[lives] < number:
            lives += 1
        ended = lives == len(alive) or alive[lives] != number
        if taken - first < 2 or not (ended or due[lives]):
            for k in range(first, taken):
                stays[rows[k]] = not ended
            taken = first
            continue
        best, largest = rows[taken - 1], -math.inf
        for k in range(first, taken):
            disparity = pixels[rows[k], 0] - pixels[rows[k], 2]
            if math.isfinite(pixels[rows[k], 2]) and disparity > largest:
                best, largest = rows[k], disparity
        anchors[tracks] = frames[best]
        depth = camera[3] / (largest if largest > -math.inf else far_px)
        points_cam[tracks, 0] = (pixels[best, 0] - camera[1]) * depth / camera[0]
        points_cam[tracks, 1] = (pixels[best, 1] - camera[2]) * depth / camera[0]
        points_cam[tracks, 2] = depth
        tracks += 1
        starts[tracks] = taken
    return tracks
