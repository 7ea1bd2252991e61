"""History of landmarks and keyframes that a first survey begins with."""

import numpy as np

from mapserver.survey.survey_map import History, SurveyMap


def history_of(survey_map: SurveyMap) -> History:
    """Its history; for a survey without one, that of a map nobody has come back to."""
    if survey_map.history is not None:
        return survey_map.history
    keyframes, landmarks = len(survey_map.map_from_body), len(survey_map.landmark_ids)
    never = np.zeros(landmarks, np.uint32)
    return History(
        keyframe_ids=np.arange(keyframes, dtype=np.uint32),
        is_place=np.ones(keyframes, np.bool_),
        landmark_expected=never,
        landmark_seen=never.copy(),
        landmark_missed=never.copy(),
        next_keyframe_id=keyframes,
        next_landmark_id=int(survey_map.landmark_ids.max(initial=0)) + 1 if landmarks else 0,
    )
