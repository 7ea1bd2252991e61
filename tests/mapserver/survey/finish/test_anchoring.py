"""A survey of unknown scale: its metres from docks, the part of a broken way that is kept, and its size changed about its cameras."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_exp, se3_inverse, so3_exp, transform_points
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.sensors.samples import PositionPrior, Trajectory
from mapserver.survey.odometry_pass import longest_run
from mapserver.survey.pose_graph.position_priors import aligned_by_priors
from mapserver.survey.state import OdometryPass
from mapserver.survey.survey_map import SurveyMap
from support.storage.map_samples import random_survey

BASE_FROM_BODY = se3(so3_exp(np.array([0.0, 0.05, 0.0])), np.array([0.3, 0.0, 0.5]))
TRUE_SCALE = 1.9
MAP_FROM_SURVEY = se3(so3_exp(np.array([0.1, -0.2, 1.0])), np.array([20.0, -5.0, 0.4]))


def unscaled() -> tuple[SurveyMap, Array]:
    """A sample whose scale is unknown, and map_from_body (F, 4, 4) of its frames in truth."""
    survey = replace(random_survey(np.random.default_rng(7)), scale_known=False)
    turned = np.array(
        [se3(so3_exp(np.array([0.0, 0.0, 0.3 * k])), np.array([0.8 * k, 0.2 * k, 0.0])) for k in range(6)]
    )
    stamps_ns = np.arange(6) * 100_000_000 + 5
    survey = replace(survey, trajectory=Trajectory(stamps_ns, turned), trajectory_estimated=np.ones(6, bool))
    true = turned.copy()
    true[:, :3, 3] *= TRUE_SCALE
    return survey, np.asarray(MAP_FROM_SURVEY @ true)


def dock(stamp_ns: int, map_from_body: Array, sigma_m: float, rng: np.random.Generator) -> PositionPrior:
    cov = np.diag([0.005**2] * 3 + [sigma_m**2] * 3)
    error = se3_exp(np.concatenate([0.005 * rng.normal(size=3), np.zeros(3)]))
    map_from_base = map_from_body @ se3_inverse(BASE_FROM_BODY)
    map_from_base[:3, 3] += sigma_m * rng.normal(size=3)
    map_from_base[:3, :3] = error[:3, :3] @ map_from_base[:3, :3]
    return PositionPrior(stamp_ns, map_from_base, cov)


def test_two_docks_give_the_metres() -> None:
    survey, truth = unscaled()
    rng = np.random.default_rng(0)
    docks = [dock(int(survey.trajectory.stamps_ns[k]), truth[k], 0.01, rng) for k in (0, 5)]
    map_from_survey, scale = aligned_by_priors(survey, docks, BASE_FROM_BODY)
    assert scale == pytest.approx(TRUE_SCALE, rel=0.01)
    there = survey.scaled(scale).transformed(map_from_survey)
    assert there.scale_known
    assert there.trajectory.positions_m == pytest.approx(
        truth[:, :3, 3], abs=0.25
    )  # the camera's mounting was in metres


def test_docks_that_leave_the_scale_open_change_nothing() -> None:
    survey, truth = unscaled()
    rng = np.random.default_rng(1)
    vague = [dock(int(survey.trajectory.stamps_ns[k]), truth[k], 0.3, rng) for k in (0, 5)]
    one = [dock(int(survey.trajectory.stamps_ns[2]), truth[2], 0.01, rng)]
    same = [dock(int(survey.trajectory.stamps_ns[2]), truth[2], 0.01, rng)] * 2
    for docks in (vague, one, same, []):
        assert aligned_by_priors(survey, docks, BASE_FROM_BODY) is None


def test_a_scaled_map_is_seen_by_its_cameras_as_before() -> None:
    survey = random_survey(np.random.default_rng(7))
    larger = replace(survey, scale_known=False).scaled(2.5)
    assert larger.scale_known
    for before, after in zip(survey.map_from_body, larger.map_from_body, strict=True):
        old = transform_points(se3_inverse(before @ survey.body_from_cam), survey.points_map)
        new = transform_points(se3_inverse(after @ larger.body_from_cam), larger.points_map)
        assert new == pytest.approx(2.5 * old, abs=1e-9)
    assert larger.point_sigma_m == pytest.approx(2.5 * survey.point_sigma_m)


def estimate(k: int, status: OdometryStatus, *, scale_known: bool) -> OdometryEstimate:
    place = se3(np.eye(3), np.array([float(k), 0, 0]))
    return OdometryEstimate(k, k, place, np.eye(6), status, inertial=scale_known, scale_known=scale_known)


@pytest.mark.parametrize(
    ("marks", "scale_known", "kept"),
    [
        ("iittttdittttttt", False, range(8, 15)),  # the longer of two parts that have scales of their own
        ("ttttttttdittt", False, range(8)),
        ("iittdiTTTDTT", True, [6, 7, 8, 10, 11]),  # the IMU carries through a gap, whose frame itself saw nothing
        ("iii", False, []),
    ],
)
def test_the_longest_part_with_one_scale_is_kept(marks: str, scale_known: bool, kept: range | list[int]) -> None:
    """i initialising, t tracking, d degraded, T tracking in metres, D degraded in metres."""
    kinds = {"i": OdometryStatus.INITIALISING, "t": OdometryStatus.TRACKING, "d": OdometryStatus.DEGRADED}
    estimates = [estimate(k, kinds[m.lower()], scale_known=m.isupper()) for k, m in enumerate(marks)]
    guess = OdometryPass(
        estimates, np.array([e.odom_from_body for e in estimates]), np.array([e.cov_rot_trans for e in estimates]),
        np.array([e.status is not OdometryStatus.DEGRADED for e in estimates]), [], scale_known, scale_known,
    )  # fmt: skip
    assert np.flatnonzero(longest_run(guess, np.eye(4)).tracked).tolist() == list(kept)
