"""Where a site's first survey lies in `map`: at the docks and tags that it passed, where it passed any."""

from collections.abc import Sequence

import numpy as np

from fleetmap.geometry import Array, rotation_angle_rad, se3, se3_inverse, so3_exp
from fleetmap.samples import PositionPrior
from mapserver.survey.result import SurveyMap

_MAX_GAP_NS = 2_000_000_000
_YAW_KNOWN_RAD = 0.2


def map_from_survey(survey_map: SurveyMap, priors: Sequence[PositionPrior], base_from_body: Array) -> Array | None:
    """The turn about z and the shift (4, 4) that bring a survey nearest to its position priors, weighted by their covariances.

    None without usable priors. One prior suffices where it knows its heading. Source: Gauss-Newton on yaw and position.
    """
    usable = []
    for prior in priors:
        if not np.isfinite(np.diag(prior.cov_rot_trans)[3:5]).all():
            continue
        survey_from_body = survey_map.trajectory.at(prior.stamp_ns, _MAX_GAP_NS)
        if survey_from_body is not None:
            usable.append((survey_from_body @ se3_inverse(base_from_body), prior))
    if not usable or (len(usable) < 2 and np.sqrt(usable[0][1].cov_rot_trans[2, 2]) > _YAW_KNOWN_RAD):
        return None
    first_survey, first = usable[0]
    start = first.map_from_base @ se3_inverse(first_survey)
    yaw, shift = float(np.arctan2(start[1, 0], start[0, 0])), np.zeros(3)
    shift = first.map_from_base[:3, 3] - so3_exp(np.array([0.0, 0.0, yaw])) @ first_survey[:3, 3]
    for _ in range(10):
        hessian, gradient = np.zeros((4, 4)), np.zeros(4)
        turn = so3_exp(np.array([0.0, 0.0, yaw]))
        for survey_from_base, prior in usable:
            jacobian, residual = _row(turn, shift, survey_from_base, prior)
            variances = np.append(np.diag(prior.cov_rot_trans)[3:], prior.cov_rot_trans[2, 2])
            weights = np.where(np.isfinite(variances), 1.0 / np.maximum(variances, 1e-8), 0.0)
            hessian += jacobian.T @ (weights[:, None] * jacobian)
            gradient += jacobian.T @ (weights * residual)
        step = np.linalg.solve(hessian + 1e-9 * np.eye(4), gradient)
        yaw, shift = yaw + float(step[0]), shift + step[1:]
    return se3(so3_exp(np.array([0.0, 0.0, yaw])), shift)


def _row(turn: Array, shift: Array, survey_from_base: Array, prior: PositionPrior) -> tuple[Array, Array]:
    """Jacobian (4, 4) and residual (4,) of position and heading with respect to yaw and shift."""
    place = turn @ survey_from_base[:3, 3]
    off_turn = prior.map_from_base[:3, :3] @ (turn @ survey_from_base[:3, :3]).T
    heading = np.sign(off_turn[1, 0]) * rotation_angle_rad(off_turn)
    jacobian = np.zeros((4, 4))
    jacobian[0, 0], jacobian[1, 0] = -place[1], place[0]
    jacobian[:3, 1:] = np.eye(3)
    jacobian[3, 0] = 1.0
    return jacobian, np.append(prior.map_from_base[:3, 3] - place - shift, heading)
