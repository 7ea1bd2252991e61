"""What odometry says of keyframes: through darkness, and where it began anew."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_adjoint, se3_exp, se3_inverse, skew
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples
from mapserver.survey.bundle.bundle_rounds import bundle_problem
from mapserver.survey.loops.connected_components import grown_sigma
from mapserver.survey.odometry_pass import FrameChain
from mapserver.survey.pose_graph.graph_marginals import GraphMarginals
from mapserver.survey.pose_graph.odometry_factors import blackout_factors, chain_edges
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import OdometryPass
from support.worlds.corridor_scene import scene


def passed(odom_from_body: Array, covariances: Array) -> OdometryPass:
    """Odometry with an IMU, all of whose frames are keyframes."""
    keyframes: Any = [SimpleNamespace(frame_index=k) for k in range(len(odom_from_body))]
    return OdometryPass([], odom_from_body, covariances, np.ones(len(keyframes), bool), keyframes, inertial=True)


def estimate(
    variance: float,
    change: Array | None = None,
    *,
    x_m: float = 0.0,
    inertial: bool = True,
    status: OdometryStatus = OdometryStatus.TRACKING,
) -> Any:
    """An odometry's estimate at x_m; its covariance is the unit matrix times `variance`."""
    place = se3(np.eye(3), np.array([x_m, 0.0, 0.0])), variance * np.eye(6)
    return OdometryEstimate(0, 0, *place, status, inertial=inertial, new_odom_from_old_odom=change)


def test_only_what_touches_the_dark_hangs_on_odometry_as_odometry_measured_it() -> None:
    state = scene(8, 3, drift=0.0).state
    dark = (state.landmarks.obs_keyframe == 3) | (state.landmarks.obs_keyframe == 4)
    state = replace(state, landmarks=state.landmarks.keep_observations(~dark, 1))
    truth = state.map_from_body.copy()
    odom_from_body = se3_exp(np.array([0.3, 0.1, -0.2, 4.0, 2.0, 1.0])) @ truth
    guess = replace(passed(odom_from_body, np.arange(8)[:, None, None] * 1e-4 * np.eye(6)), has_wheels=True)
    state.map_from_body[3:5, 0, 3] += 7.0  # where an adjustment may have put them says nothing
    terms = blackout_factors(guess, state)
    assert [(t.i, t.j) for t in terms] == [(2, 3), (3, 4), (4, 5)]
    for term in terms:
        np.testing.assert_allclose(term.i_from_j, se3_inverse(truth[term.i]) @ truth[term.j], atol=1e-9)
        sigmas_m = np.sqrt(np.diag(np.linalg.inv(term.information)))[3:]
        assert (sigmas_m > 0.01).all()
        assert (sigmas_m < 0.05).all()
    # Without wheels the odometry of sparse pictures knows less than it says, and nothing that the IMU does not.
    assert not blackout_factors(replace(guess, has_wheels=False), state)


@pytest.mark.parametrize(("pause_s", "is_pause"), [(9.0, False), (59.0, False), (5 * 3600.0, True)])
def test_no_inertial_factor_spans_a_pause_which_odometry_bridges(pause_s: float, is_pause: bool) -> None:
    """A drive cut at speed: the samples before and after are no motion of the hours between. Where all are there they are one."""
    state = scene(4, 3, drift=0.0).state
    stamps_ns = state.stamps_ns + np.where(np.arange(4) < 2, 0, int(pause_s * 1e9))
    sampled_ns = np.arange(stamps_ns[0], stamps_ns[-1] + 1, 10_000_000)
    if is_pause:
        sampled_ns = sampled_ns[(sampled_ns <= stamps_ns[1]) | (sampled_ns >= stamps_ns[2])]
    imu = ImuSamples(sampled_ns, np.zeros((len(sampled_ns), 3)), np.tile([0.0, 0.0, 9.81], (len(sampled_ns), 1)))
    motion = replace(state.motion, inertial=True, imu=imu, noise=ImuNoise(2e-4, 1e-5, 2e-3, 1e-4))
    state = replace(state, stamps_ns=stamps_ns, motion=motion)
    guess = passed(state.map_from_body, np.tile(1e-4 * np.eye(6), (4, 1, 1)))
    inertial = bundle_problem(state, SurveySettings(), None).inertial
    assert [edge[:2] for edge in inertial.edges] == ([(0, 1), (2, 3)] if is_pause else [(0, 1), (1, 2), (2, 3)])
    assert [(term.i, term.j) for term in blackout_factors(guess, state)] == ([(1, 2)] if is_pause else [])


def chain(*estimates: tuple[SimpleNamespace, float | None]) -> Array:
    """(F, 6, 6) of estimates, each with the standard deviation of its step as the odometry knows it, None where it does not."""
    frames = FrameChain()
    for each, sigma in estimates:
        frames.append(each, None if sigma is None else sigma**2 * np.eye(6))
    return frames.covariances()


def test_beginning_anew_does_not_join_what_nothing_joins() -> None:
    """An odometry that begins anew takes its place for known: the doubt of before goes on, and one metre with it."""
    anew = estimate(0.0, change=np.eye(4), inertial=False)
    whole = chain(
        (estimate(0.0), None), (estimate(0.01), None), (estimate(0.04), None), (anew, None), (estimate(0.01), None)
    )
    between = grown_sigma(np.trace(whole[:, 3:, 3:], axis1=1, axis2=2))
    assert between(1, 2) == pytest.approx(np.sqrt(3 * 0.03))
    assert between(2, 3) > 1.0
    assert between(3, 4) == pytest.approx(np.sqrt(3 * 0.01))


def test_what_a_filter_learns_of_earlier_places_is_no_doubt_of_the_way() -> None:
    """In a bend a filter doubts where it is and learns it back, while it knows each step well: then so is the way known.

    Blind, it doubts its speed, and what it learns in the light does not move the frames that it saw nothing in.
    """
    doubts, way_m = (0.01, 0.25, 0.1, 0.02), [0.0, 0.5, 1.0, 1.5]
    bend = [(estimate(d**2, x_m=x), 0.01) for d, x in zip(doubts, way_m, strict=True)]
    dark = [bend[0], (estimate(0.25**2, x_m=0.5, status=OdometryStatus.DEGRADED), 0.01), *bend[2:]]
    places = np.array([se3(np.eye(3), np.array([x, 0.0, 0.0])) for x in way_m])
    for seen, least_m, most_m in ((bend, 0.02, 0.05), (dark, 0.25, 0.3)):
        edges = chain_edges(passed(places, chain(*seen)), SimpleNamespace(map_from_body=places))
        assert least_m < np.sqrt(GraphMarginals(places, edges).relative_cov(0, 3)[3, 3]) < most_m


def test_edges_of_the_chain_add_up_to_what_odometry_does_not_know() -> None:
    """A filter's covariance of position holds what its direction has done to the whole way; no edge may say that once more."""
    count, step = 200, se3_exp(np.array([0.0, 0.0, 0.002, 0.5, 0.0, 0.0]))
    noise = np.diag([2e-6, 2e-6, 4e-6, 4e-4, 1e-4, 1e-4])
    odom_from_body = se3(np.eye(3), np.array([30.0, -20.0, 1.0])) @ np.tile(np.eye(4), (count, 1, 1))
    covariances, about = np.zeros((count, 6, 6)), np.tile(np.eye(6), (count, 1, 1))
    for k in range(1, count):
        carry = se3_adjoint(odom_from_body[k - 1])
        covariances[k] = covariances[k - 1] + carry @ noise @ carry.T
        odom_from_body[k] = odom_from_body[k - 1] @ step
    about[:, 3:, :3] = [-skew(place) for place in odom_from_body[:, :3, 3]]
    known = passed(odom_from_body, about @ covariances @ about.transpose(0, 2, 1))
    graph = GraphMarginals(odom_from_body, chain_edges(known, SimpleNamespace(map_from_body=odom_from_body)))
    carry = se3_adjoint(se3_inverse(odom_from_body[20]))
    expected = carry @ (covariances[-1] - covariances[20]) @ carry.T
    ratios = np.sqrt(np.diag(graph.relative_cov(20, count - 1)) / np.diag(expected))
    assert (ratios > 1.0).all()  # the floor adds to it
    assert (ratios < 1.2).all()
