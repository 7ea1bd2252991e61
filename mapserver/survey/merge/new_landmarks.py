"""Landmarks of a new survey that the map lacks: confirmed ones, where the keyframes that see them see too little of the map."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fleetmap.relocalization.landmark_visibility import COLUMNS, ROWS, image_cells
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.merge.joint_adjustment import JointSolution
from mapserver.survey.settings import SessionSettings
from mapserver.survey.state import Keyframe, Landmarks

_CELLS = COLUMNS * ROWS
_MIN_IN_CELL = 3  # fewer confirmed landmarks do not show that the map lacks something there
_LACKING_SHARE = 0.6


def new_landmarks(
    base: BaseMap,
    keyframes: Sequence[Keyframe],
    marks: Landmarks,
    joint: JointSolution,
    free: NDArray[np.bool_],
    settings: SessionSettings,
) -> NDArray[np.bool_]:
    """(N,) of the survey's own landmarks those that the map should gain; free (M,) are observations that show none of the map's.

    A part of a picture (one of 48) is covered where landmarks of the map are seen in it, at least `covered_share` as many
    as new ones; a landmark is new where most of the parts in which it is seen are not.
    """
    counts = np.bincount(marks.obs_landmark[free], minlength=len(marks.points_map))
    confirmed = (counts >= settings.min_confirmations) & np.isfinite(joint.own_points_map).all(axis=1)
    chosen = free & confirmed[marks.obs_landmark]
    lacking = np.zeros(len(chosen), bool)
    for k, (_, sighting) in enumerate(zip(keyframes, joint.sightings, strict=True)):
        own = np.flatnonzero(chosen & (marks.obs_keyframe == k))
        cells = image_cells(marks.obs_pixels[own, :2], base.camera)
        fresh = np.bincount(cells, minlength=_CELLS)
        known = np.zeros(_CELLS, np.int64)
        if sighting is not None:
            known = np.bincount(image_cells(sighting.pixels[:, :2], base.camera), minlength=_CELLS)
        bare = (fresh >= _MIN_IN_CELL) & (known <= settings.covered_share * fresh)
        lacking[own] = bare[cells] if sighting is not None else True
    share = np.bincount(marks.obs_landmark[lacking], minlength=len(counts)) / np.maximum(counts, 1)
    return np.asarray(confirmed & (share >= _LACKING_SHARE))
