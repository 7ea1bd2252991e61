"""A made-up map with known truth, and what keyframes of a later survey see of it. No pictures."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3_inverse, transform_points
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.merge.guided_matching import Sighting, Sightings
from mapserver.survey.survey_map import History
from support.storage.map_samples import plain_survey
from support.worlds.bundle_scene import BODY_FROM_CAM, CAMERA, make_scene

SIGMA_PX = 0.4


@dataclass(frozen=True)
class SessionScene:
    """The map as BaseMap, the true places of a later survey's cameras (K, 4, 4), and which landmarks each sees."""

    base: BaseMap
    map_from_cam: Array
    visible: list[NDArray[np.int64]]

    def sightings(self, points_map: Array, seed: int) -> Sightings:
        """Noisy observations by the later survey of landmarks now at points_map (N, 3)."""
        rng = np.random.default_rng(seed)
        found: list[Sighting | None] = []
        for place, rows in zip(self.map_from_cam, self.visible, strict=True):
            pixels = CAMERA.pixel_from_point(transform_points(se3_inverse(place), points_map[rows]))
            noise = rng.normal(0, SIGMA_PX, pixels.shape)
            noise[:, 2] = noise[:, 0] - noise[:, 2]
            found.append(Sighting(rows, np.arange(len(rows)), pixels + noise, np.full((len(rows), 2), SIGMA_PX)))
        return Sightings.of(found)


def session_scene(seed: int, *, landmarks: int = 300, history: History | None = None) -> SessionScene:
    """Keyframes 0 and 2, 4... of a ride made the map, those between them are the later survey."""
    problem = make_scene(keyframes=12, landmarks=landmarks, step_s=0.3, seed=seed, noise_px=0.5, mono_share=0.0).problem
    rows = np.flatnonzero(problem.obs_keyframe % 2 == 0)
    old = problem.observed(rows[np.lexsort((problem.obs_keyframe[rows], problem.obs_landmark[rows]))])
    old = replace(old, obs_keyframe=old.obs_keyframe // 2)
    survey_map = plain_survey(CAMERA, BODY_FROM_CAM, problem.map_from_body[::2], old, history)
    in_map = np.unique(old.obs_landmark)
    visible = [
        np.intersect1d(problem.obs_landmark[problem.obs_keyframe == k], in_map).astype(np.int64)
        for k in range(1, 12, 2)
    ]
    return SessionScene(
        BaseMap(survey_map, CAMERA, BODY_FROM_CAM), problem.map_from_body[1::2] @ BODY_FROM_CAM, visible
    )
