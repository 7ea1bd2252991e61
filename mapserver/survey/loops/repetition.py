"""Steps by which a site repeats, learnt wherever in it a place is seen to look like another one."""

import numpy as np

from fleetmap.geometry import Array

_SAME_SHARE = 0.25  # of its length by which a step may differ from another one to be the same
_ENOUGH = 3  # keyframes that saw a step before it is believed: one match may be wrong


class Repetition:
    """What look-alikes of one place teach about all others, in map axes.

    Aisles are built alike at one distance. Where the first two are told apart the way between them is known; where the robot later
    knows its place to no better than that way, a view that fits an old aisle fits one beside it as well, even if that was never seen.
    """

    def __init__(self) -> None:
        self._means = np.zeros((0, 3))
        self._weights = np.zeros(0)
        self._seen_by: list[set[int]] = []

    def see(self, keyframe: int, step_m: Array, variance_m2: float) -> None:
        """A keyframe looks like a place that is step_m (3,) from where it must be, known to variance_m2 along each axis."""
        weight = 1.0 / variance_m2
        # Whoever repeats by a step repeats by its opposite.
        signs = np.where(self._means @ step_m < 0, -1.0, 1.0)
        away = np.linalg.norm(signs[:, None] * self._means - step_m, axis=1) if len(signs) else np.zeros(0)
        n = int(np.argmin(away)) if len(away) else 0
        if not len(away) or away[n] > _SAME_SHARE * np.linalg.norm(step_m):
            self._means = np.vstack([self._means, step_m])
            self._weights = np.append(self._weights, weight)
            self._seen_by.append({keyframe})
            return
        self._means[n] += weight / (self._weights[n] + weight) * (signs[n] * step_m - self._means[n])
        self._weights[n] += weight
        self._seen_by[n].add(keyframe)

    @property
    def steps_m(self) -> Array:
        """(M, 3) the steps that enough keyframes saw, and their opposites."""
        believed = self._means[[len(seen) >= _ENOUGH for seen in self._seen_by]]
        return np.concatenate([believed, -believed])
