"""Scale and alignment of a survey of unknown scale by the docks and tags along its path.

Surveys in metres are brought to `map` by pose_graph/position_priors.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array, se3, skew, so3_exp, so3_log
from fleetmap.sensors.samples import PositionPrior
from mapserver.survey.survey_map import SurveyMap

_MAX_SCALE_SIGMA_SHARE = 0.01  # limit for the scale by priors: beyond it the scale stays unknown
_MAX_GAP_NS = 2_000_000_000


@dataclass(frozen=True, slots=True)
class DockAlignment:
    """map_from_survey (4, 4) without the scale, metres per unit of the survey, and its relative standard deviation."""

    map_from_survey: Array
    scale: float
    scale_sigma_share: float


def aligned_by_priors(
    survey_map: SurveyMap, priors: Sequence[PositionPrior], base_from_body: Array
) -> DockAlignment | None:
    """Return pose and scale of a survey of unknown scale, by priors with position and direction.

    None with fewer than two such priors, or with a scale less accurate than 1 %. Gauss-Newton on seven unknowns.
    """
    usable = []
    for prior in priors:
        survey_from_body = survey_map.trajectory.at(prior.stamp_ns, _MAX_GAP_NS)
        if survey_from_body is not None and np.isfinite(np.diag(prior.cov_rot_trans)).all():
            usable.append((survey_from_body, prior))
    if len(usable) < 2:
        return None
    body_in_base_m = base_from_body[:3, 3]
    turn = usable[0][1].map_from_base[:3, :3] @ base_from_body[:3, :3] @ usable[0][0][:3, :3].T
    places = np.array([there[:3, 3] for there, _ in usable])
    targets = np.array([p.map_from_base[:3, :3] @ body_in_base_m + p.map_from_base[:3, 3] for _, p in usable])
    spread = float(np.linalg.norm(places - places.mean(axis=0)))
    if spread < 1e-6:
        return None
    scale = float(np.linalg.norm(targets - targets.mean(axis=0))) / spread
    shift = targets.mean(axis=0) - scale * turn @ places.mean(axis=0)
    for _ in range(15):
        hessian, gradient = 1e-12 * np.eye(7), np.zeros(7)
        for place, target, (survey_from_body, prior) in zip(places, targets, usable, strict=True):
            arm = scale * turn @ place
            by_place = np.hstack([-skew(arm), np.eye(3), arm[:, None]])
            map_from_body = prior.map_from_base[:3, :3] @ base_from_body[:3, :3]
            off_turn = so3_log(map_from_body @ (turn @ survey_from_body[:3, :3]).T)
            jacobian = np.vstack([np.hstack([np.eye(3), np.zeros((3, 4))]), by_place])
            residual = np.concatenate([off_turn, target - arm - shift])
            weight = np.linalg.inv(prior.cov_rot_trans)
            hessian += jacobian.T @ weight @ jacobian
            gradient += jacobian.T @ weight @ residual
        step = np.linalg.solve(hessian, gradient)
        turn, scale = so3_exp(np.asarray(step[:3], np.float64)) @ turn, scale * float(np.exp(step[6]))
        shift = shift + step[3:6]
    sigma = float(np.sqrt(np.linalg.inv(hessian)[6, 6]))
    return DockAlignment(se3(turn, shift), scale, sigma) if sigma <= _MAX_SCALE_SIGMA_SHARE else None
