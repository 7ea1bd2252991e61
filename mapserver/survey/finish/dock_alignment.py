"""Alignment of a site's first survey to `map` by the docks and tags along its path."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array, rotation_angle_rad, se3, se3_inverse, skew, so3_exp, so3_log
from fleetmap.sensors.samples import PositionPrior
from mapserver.survey.survey_map import SurveyMap

_MAX_SCALE_SIGMA_SHARE = 0.01  # limit for the scale by priors: beyond it the scale stays unknown
_MAX_GAP_NS = 2_000_000_000
_YAW_KNOWN_RAD = 0.2


def map_from_survey_by_priors(
    survey_map: SurveyMap, priors: Sequence[PositionPrior], base_from_body: Array
) -> Array | None:
    """Return the rotation about z and the translation (4, 4) with the best fit of a survey to its position priors, by covariance.

    None without usable priors. One prior with a heading suffices. Gauss-Newton on yaw and position.
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
    """Return Jacobian (4, 4) and residual (4,) of position and heading with respect to yaw and shift."""
    place = turn @ survey_from_base[:3, 3]
    off_turn = prior.map_from_base[:3, :3] @ (turn @ survey_from_base[:3, :3]).T
    heading = np.sign(off_turn[1, 0]) * rotation_angle_rad(off_turn)
    jacobian = np.zeros((4, 4))
    jacobian[0, 0], jacobian[1, 0] = -place[1], place[0]
    jacobian[:3, 1:] = np.eye(3)
    jacobian[3, 0] = 1.0
    return jacobian, np.append(prior.map_from_base[:3, 3] - place - shift, heading)


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
