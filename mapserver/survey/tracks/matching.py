"""Selection of keyframe pairs to match, and checks of the measured motion against the predicted one."""

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, rotation_angle_rad, se3_inverse
from fleetmap.sensors.rectification import StereoCamera
from mapserver.survey.executor import SERIAL, Executor, in_batches
from mapserver.survey.settings import PairSettings
from mapserver.survey.state import Keyframe
from mapserver.survey.tracks.pairs import MatchInputs, PairMatch, PairTask, PredictedMotion, match_task, view_overlap

_NEAR_CANDIDATES = 40
_BATCH = 32  # pairs: 0.1 s of work; sending their twenty keyframes costs a few milliseconds
_MAX_VIEW_ANGLE_DEG = 75.0
_NOBODY: list[int] = []


class PairFinder:
    """Matches keyframes that should see the same, given their poses."""

    def __init__(
        self,
        keyframes: list[Keyframe],
        camera: StereoCamera,
        body_from_cam: Array,
        settings: PairSettings,
        executor: Executor = SERIAL,
        views: int = 1,
    ) -> None:
        """views: of a rig, in turn in `keyframes`."""
        self._keyframes, self._camera, self._body_from_cam, self._settings = keyframes, camera, body_from_cam, settings
        self._executor, self._views = executor, views
        self._inputs = MatchInputs([k.without_pictures() for k in keyframes], camera, settings)
        self._shared = replace(self._inputs, keyframes={})
        self._depths_m = np.array([k.median_depth_m for k in keyframes])

    def candidates(self, map_from_body: Array, *, previous: int, only_near: int | None = None) -> list[tuple[int, int]]:
        """Return pairs (i, j), i < j: the last few in time, and the most covisible ones by predicted view.

        only_near: maximum distance in keyframes, before loops have been closed.
        """
        map_from_cam = map_from_body @ self._body_from_cam
        positions, axes = map_from_cam[:, :3, 3], map_from_cam[:, :3, 2]
        settings, reach_m = self._settings, 2.0 * self._depths_m
        around = None if only_near is not None else NearPlaces(positions, reach_m)
        found: list[tuple[int, int]] = []
        for j in range(1, len(map_from_cam)):
            first = 0 if only_near is None else max(0, j - only_near)
            until = max(j - previous * self._views, first)
            chosen = {i for i in range(until, j) if (j - i) % self._views == 0}
            earlier = np.arange(first, until) if around is None else around.before(j, until)
            distance = np.linalg.norm(positions[earlier] - positions[j], axis=1)
            near = (distance < np.maximum(reach_m[earlier], reach_m[j])) & (
                axes[earlier] @ axes[j] > np.cos(np.radians(_MAX_VIEW_ANGLE_DEG))
            )
            closest = earlier[near][np.argsort(distance[near], kind="stable")][:_NEAR_CANDIDATES]
            cam_j_from_map = se3_inverse(map_from_cam[j])
            overlap = [
                (view_overlap(self._keyframes[i], self._camera, cam_j_from_map @ map_from_cam[i]), int(i))
                for i in closest
            ]
            best = sorted(overlap, reverse=True)[: settings.covisible]
            chosen |= {i for share, i in best if share > settings.min_overlap}
            found.extend((i, j) for i in sorted(chosen))
        return found

    def match(
        self,
        candidates: list[tuple[int, int]],
        map_from_body: Array,
        allowed_m: Callable[[int, int], float],
        *,
        rotation_sigma_rad: float | None,
        is_known: bool = True,
        progress: Callable[[int], None],
    ) -> list[PairMatch]:
        """Return verified matches whose measured motion agrees with the predicted one to within allowed_m(i, j)."""
        map_from_cam = map_from_body @ self._body_from_cam
        predictions: list[_Prediction] = []
        for i, j in candidates:
            j_from_i = se3_inverse(map_from_cam[j]) @ map_from_cam[i]
            predictions.append((i, j, PredictedMotion(j_from_i, rotation_sigma_rad, is_known)))
        matches, number = [], 0
        batches: list[list[_Prediction]] = in_batches(predictions, _BATCH)
        tasks = (PairTask.of(batch, self._inputs) for batch in batches)
        for batch, found in zip(batches, self._executor.map(match_task, self._shared, tasks), strict=True):
            for (i, j, predicted), match in zip(batch, found, strict=True):
                if match is not None and _agrees(match.j_from_i, predicted.j_from_i, allowed_m(i, j)):
                    matches.append(match)
                progress(number)
                number += 1
        return matches


class NearPlaces:
    """Places (K, 3) that can reach each other, by reaches (K,): a query costs the near places, not the whole site.

    Each lies in a cell at least as wide as its reach; widths double from level to level.
    """

    def __init__(self, positions_m: Array, reach_m: Array) -> None:
        self._positions_m, self._reach_m = positions_m, reach_m
        least_m = max(float(np.median(reach_m)), 1e-3)
        self._widths_m = least_m * 2.0 ** np.ceil(np.log2(np.maximum(reach_m / least_m, 1.0)))
        # Limit of keyframes in the grid, so that later ones are not queried
        self._cells: dict[float, dict[tuple[int, int], list[int]]] = {}
        self._filled = 0

    def before(self, j: int, until: int) -> NDArray[np.int64]:
        """Return ascending numbers below `until` of all that may reach j or be reached from it. `until` must not decrease."""
        for k in range(self._filled, until):
            width_m = float(self._widths_m[k])
            x, y = np.floor(self._positions_m[k, :2] / width_m).astype(np.int64).tolist()
            self._cells.setdefault(width_m, {}).setdefault((x, y), []).append(k)
        self._filled = max(self._filled, until)
        found: list[int] = []
        for width_m, cells in self._cells.items():
            reach_m, place_m = max(float(self._reach_m[j]), width_m), self._positions_m[j, :2]
            low, high = (np.floor((place_m + side * reach_m) / width_m).astype(np.int64) for side in (-1.0, 1.0))
            (x, y), (columns, rows) = low.tolist(), (high - low + 1).tolist()
            around: Iterable[list[int]] = cells.values()
            if columns * rows < len(cells):
                around = [cells.get((x + n % columns, y + n // columns), _NOBODY) for n in range(columns * rows)]
            found += [k for cell in around for k in cell]
        return np.array(sorted(found), np.int64)


_Prediction = tuple[int, int, PredictedMotion]


def _agrees(measured: Array, predicted: Array, allowed_m: float) -> bool:
    off = se3_inverse(predicted) @ measured
    return bool(np.linalg.norm(off[:3, 3]) <= allowed_m and rotation_angle_rad(off[:3, :3]) < np.radians(10.0))


def drift_allowance_m(covariances: NDArray[np.float64], positions_m: Array) -> Callable[[int, int], float]:
    """Return the allowed difference of measured and predicted motion before loop closure: three sigmas of odometry, and a least one.

    covariances (K, 6, 6) of the keyframes' odometry; the growth between two of them is their relative uncertainty.
    """

    def allowed_m(i: int, j: int) -> float:
        gained = max(float(np.trace(covariances[j][3:, 3:] - covariances[i][3:, 3:])), 0.0)
        least = 0.05 + 0.03 * float(np.linalg.norm(positions_m[j] - positions_m[i]))
        return 3.0 * float(np.sqrt(gained + least**2))

    return allowed_m


def fixed_allowance_m(map_from_body: Array) -> Callable[[int, int], float]:
    """Return the same after bundle adjustment: the error of a well-matched pair."""
    positions = map_from_body[:, :3, 3]
    return lambda i, j: 0.15 + 0.05 * float(np.linalg.norm(positions[j] - positions[i]))
