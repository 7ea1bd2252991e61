"""Observations of points from frame to frame, kept as one table until the filter uses them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.rectification import StereoCamera

_FAR_DEPTH_M = 20.0
Ids = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Track:
    """Observations of one point: which clones (n,), pixels (n, 3) u_left v u_right.

    A first guess of the point as clone `anchor` sees it is in camera axes (3,), so that it follows the clone when an
    iterated update moves it.
    """

    clone_ids: Ids
    pixels: Array
    anchor: int
    point_cam: Array


@dataclass(frozen=True, slots=True)
class TrackBatch:
    """T tracks: starts (T + 1,) delimits each one's rows of clone_ids (n,) and pixels (n, 3).

    anchors (T,) and points_cam (T, 3) are as in Track.
    """

    starts: Ids
    clone_ids: Ids
    pixels: Array
    anchors: Ids
    points_cam: Array

    def __len__(self) -> int:
        return len(self.anchors)

    @classmethod
    def of(cls, tracks: Sequence[Track]) -> "TrackBatch":
        """The same tracks as arrays."""
        sizes = [len(track.clone_ids) for track in tracks]
        return cls(
            np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
            np.concatenate([np.zeros(0, np.int64), *(track.clone_ids for track in tracks)]),
            np.concatenate([np.zeros((0, 3)), *(track.pixels for track in tracks)]),
            np.array([track.anchor for track in tracks], np.int64),
            np.array([track.point_cam for track in tracks]).reshape(-1, 3),
        )


class Observations:
    """Every observation that no update has used yet, in order of arrival."""

    def __init__(self) -> None:
        self._ids, self._frames, self._pixels = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3))

    def add(self, frame_index: int, ids: Ids, pixels: Array) -> None:
        """What one frame saw: ids (N,), pixels (N, 3)."""
        self._ids = np.concatenate([self._ids, ids])
        self._frames = np.concatenate([self._frames, np.full(len(ids), frame_index)])
        self._pixels = np.concatenate([self._pixels, pixels])

    def clear(self) -> None:
        """Forgets all."""
        self._keep(np.zeros(len(self._ids), bool))

    def take(self, alive: Ids, held: Ids, due: NDArray[np.bool_], camera: StereoCamera) -> TrackBatch:
        """Removes and returns the tracks that ended, or are due, with two observations or more in the clones `held`.

        alive (N,): ids that the newest frame saw, due (N,) which of them are to be used now. What is due but seen once
        stays; what ended so is forgotten.
        """
        self._keep(_are_among(self._frames, held))
        order = np.argsort(self._ids, kind="stable")
        starts = np.flatnonzero(np.diff(self._ids[order], prepend=np.int64(-1)))
        ids, counts = self._ids[order[starts]], np.diff(starts, append=len(order))
        ended = ~_are_among(ids, alive)
        taken = (ended | _are_among(ids, alive[due])) & (counts >= 2)
        rows = order[np.repeat(taken, counts)]
        batch = _batch(self._ids[rows], self._frames[rows], self._pixels[rows], camera)
        staying = np.zeros(len(order), bool)
        staying[order] = np.repeat(~taken & ~ended, counts)
        self._keep(staying)
        return batch

    def _keep(self, keep: NDArray[np.bool_]) -> None:
        self._ids, self._frames, self._pixels = self._ids[keep], self._frames[keep], self._pixels[keep]


def _are_among(values: Ids, among: Ids) -> NDArray[np.bool_]:
    """As np.isin, at a third of its cost for so few."""
    if not len(among):
        return np.zeros(len(values), bool)
    held = np.sort(among)
    at = np.minimum(np.searchsorted(held, values), len(held) - 1)
    return np.asarray(held[at] == values)


def _batch(ids: Ids, frames: Ids, pixels: Array, camera: StereoCamera) -> TrackBatch:
    """Rows sorted by id. First guesses of points: stereo from the nearest view, else far along the newest ray."""
    if not len(ids):
        return TrackBatch.of([])
    starts = np.concatenate([[0], np.flatnonzero(np.diff(ids)) + 1, [len(ids)]])
    disparities = np.where(np.isfinite(pixels[:, 2]), pixels[:, 0] - pixels[:, 2], -np.inf)
    largest = np.maximum.reduceat(disparities, starts[:-1])
    is_largest = disparities == np.repeat(largest, np.diff(starts))
    best = np.minimum.reduceat(np.where(is_largest, np.arange(len(ids)), len(ids)), starts[:-1])
    known = np.isfinite(largest)
    best[~known] = starts[1:][~known] - 1
    far = camera.focal_px * max(camera.baseline_m, 0.01) / _FAR_DEPTH_M
    points_cam = camera.point_from_pixel(pixels[best, :2], np.where(known, largest, far))
    return TrackBatch(starts, frames, pixels, frames[best], points_cam)
