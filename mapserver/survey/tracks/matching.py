"""Selection of keyframe pairs to match, and checks of the measured motion against the predicted one."""

from collections.abc import Callable
from dataclasses import replace
from itertools import chain

import numpy as np
import scipy

from fleetmap.geometry import Array, Indices, rotation_angle_rad, se3_inverse
from mapserver.survey.executor import SERIAL, Executor, in_batches
from mapserver.survey.settings import PairSettings
from mapserver.survey.state import RigImages
from mapserver.survey.tracks.pairs import MatchInputs, PairMatch, PairTask, PredictedMotion, match_task, view_overlap

_NEAR_CANDIDATES = 40
_BATCH = 32  # pairs: 0.1 s of work; sending their twenty keyframes costs a few milliseconds
_MAX_VIEW_ANGLE_DEG = 75.0


class PairFinder:
    """Matches images that should see the same, given their poses."""

    def __init__(
        self,
        posed: RigImages,
        settings: PairSettings,
        executor: Executor = SERIAL,
        at: Callable[[str, int, int], None] = lambda *_: None,
    ) -> None:
        """at: called with the stage, and how many of how many candidates are matched."""
        self._posed, self._settings, self._executor, self._at = posed, settings, executor, at
        self._map_from_cam, self._keyframe, self._camera = posed.map_from_cam, posed.keyframe, posed.camera
        self._inputs = MatchInputs([k.without_pictures() for k in posed.images], posed.rig.camera, settings)
        self._shared = replace(self._inputs, keyframes={})

    def candidates(self, only_near: int | None = None) -> list[tuple[int, int]]:
        """Return pairs of images (i, j), i < j: those of a camera in the last few keyframes, and the most covisible by predicted view.

        only_near: maximum distance in keyframes, before loops have been closed.
        """
        positions, axes = self._map_from_cam[:, :3, 3], self._map_from_cam[:, :3, 2]
        settings, numbers, previous = self._settings, self._posed.numbers, self._settings.previous
        reach_m = 2.0 * np.array([image.median_depth_m for image in self._posed.images])
        around = None if only_near is not None else NearPlaces(positions, reach_m)
        found: list[tuple[int, int]] = []
        for j, (keyframe, camera) in enumerate(zip(self._keyframe.tolist(), self._camera.tolist(), strict=True)):
            last = numbers[max(keyframe - previous, 0) : keyframe, camera]
            if around is not None:
                earlier = around.before(j, int(numbers[keyframe - previous, camera]) if keyframe >= previous else 0)
            else:
                earlier = numbers[max(keyframe - only_near, 0) : max(keyframe - previous, 0)].ravel()
            distance = np.linalg.norm(positions[earlier] - positions[j], axis=1)
            near = (distance < np.maximum(reach_m[earlier], reach_m[j])) & (
                axes[earlier] @ axes[j] > np.cos(np.radians(_MAX_VIEW_ANGLE_DEG))
            )
            closest = earlier[near][np.argsort(distance[near], kind="stable")][:_NEAR_CANDIDATES]
            cam_j_from_map = se3_inverse(self._map_from_cam[j])
            overlap = [
                (view_overlap(self._posed.images[i], self._posed.rig.camera, cam_j_from_map @ self._map_from_cam[i]), i)
                for i in closest.tolist()
            ]
            best = sorted(overlap, reverse=True)[: settings.covisible]
            chosen = {*last.tolist(), *(i for share, i in best if share > settings.min_overlap)}
            found.extend((i, j) for i in sorted(chosen))
        return found

    def match(
        self,
        candidates: list[tuple[int, int]],
        allowed_m: Callable[[int, int], float],
        rotation_sigma_rad: float | None,
        stage: str = "matching",
    ) -> list[PairMatch]:
        """Return verified matches whose measured motion agrees with the predicted one to within allowed_m of their keyframes."""
        predictions: list[tuple[int, int, PredictedMotion]] = []
        for i, j in candidates:
            j_from_i = se3_inverse(self._map_from_cam[j]) @ self._map_from_cam[i]
            predictions.append((i, j, PredictedMotion(j_from_i, rotation_sigma_rad, is_known=True)))
        matches = []
        tasks = (PairTask.of(batch, self._inputs) for batch in in_batches(predictions, _BATCH))
        found = chain.from_iterable(self._executor.map(match_task, self._shared, tasks))
        for number, ((i, j, predicted), match) in enumerate(zip(predictions, found, strict=True)):
            if match is not None:
                most_m = allowed_m(int(self._keyframe[i]), int(self._keyframe[j]))
                off = se3_inverse(predicted.j_from_i) @ match.j_from_i
                if np.linalg.norm(off[:3, 3]) <= most_m and rotation_angle_rad(off[:3, :3]) < np.radians(10.0):
                    matches.append(match)
            self._at(stage, number + 1, len(candidates))
        return matches


class NearPlaces:
    """Places (K, 3) that can reach each other, by reaches (K,): a query costs the near places, not the whole site.

    Those whose reaches differ by less than a factor of two are in one tree.
    """

    def __init__(self, positions_m: Array, reach_m: Array) -> None:
        self._positions_m, self._reach_m = positions_m, reach_m
        levels = np.ceil(np.log2(np.maximum(reach_m, 1e-3)))
        numbers = [np.flatnonzero(levels == level) for level in np.unique(levels)]
        self._trees = [(own, scipy.spatial.cKDTree(positions_m[own]), float(reach_m[own].max())) for own in numbers]

    def before(self, j: int, until: int) -> Indices:
        """Return ascending numbers below `until` of all that may reach j or be reached from it."""
        place_m, reach_m = self._positions_m[j], float(self._reach_m[j])
        near = [own[tree.query_ball_point(place_m, max(reach_m, most_m))] for own, tree, most_m in self._trees]
        found = np.sort(np.concatenate(near))
        return found[: np.searchsorted(found, until)]


def drift_allowance_m(variances_m2: Array, positions_m: Array) -> Callable[[int, int], float]:
    """Return the allowed difference of measured and predicted motion before loop closure: three sigmas of odometry, and a least one.

    variances_m2 (K,): of the keyframes' positions by odometry, summed over the axes; the growth is that of their relative position.
    """

    def allowed_m(i: int, j: int) -> float:
        gained = max(float(variances_m2[j] - variances_m2[i]), 0.0)
        least = 0.05 + 0.03 * float(np.linalg.norm(positions_m[j] - positions_m[i]))
        return 3.0 * float(np.sqrt(gained + least**2))

    return allowed_m


def fixed_allowance_m(map_from_body: Array) -> Callable[[int, int], float]:
    """Return the same after bundle adjustment: the error of a well-matched pair."""
    positions = map_from_body[:, :3, 3]
    return lambda i, j: 0.15 + 0.05 * float(np.linalg.norm(positions[j] - positions[i]))
