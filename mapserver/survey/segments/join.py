"""Segments of a survey become one chain. Pure.

Two neighbours share a keyframe, the last of one and the first of the other: it says exactly where they lie to each other, so that
every edge between neighbours is one that some segment has measured and adjusted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import AnyArray, Array, se3, se3_inverse, so3_exp, so3_log
from mapserver.survey.bundle.bundle_rounds import SurveyState
from mapserver.survey.bundle.odometry_factors import blackout_factors, edge_covariance
from mapserver.survey.chain import AdjustedChain, initial_state
from mapserver.survey.frame_tracks import FrameTracks
from mapserver.survey.odometry_pass import Cut, OdometryPass
from mapserver.survey.segments.segment import SegmentSurvey
from mapserver.survey.survey_inputs import SurveyInputs
from mapserver.survey.tracks.tracks import Landmarks

_GATE = 22.46  # 0.999 of chi-square with 6 degrees of freedom


@dataclass(frozen=True, slots=True)
class _Placed:
    """A segment in the frame of the whole: joined_from_odom and joined_from_map (4, 4), its first keyframe's number, its tracks' first."""

    made: SegmentSurvey
    joined_from_odom: Array
    joined_from_map: Array
    first_keyframe: int
    first_track: int


def refusal(before: SegmentSurvey, after: SegmentSurvey) -> str | None:
    """Why two neighbours cannot be joined, None where they can: both were sure of themselves, and saw the robot drive there alike."""
    if before.lost is not None:
        return f"the odometry before it was in doubt: {before.lost}"
    if after.unsettled is not None:
        return f"the odometry that started before it was in doubt: {after.unsettled}"
    start = before.segment.begin
    led = [frame - start for frame in (after.segment.settled_from, after.segment.begin)]
    if led[0] < 0:
        return "its overlap is longer than the segment before it"
    a, b = before.odometry.odom_from_body[led]
    off = se3_inverse(se3_inverse(a) @ b) @ after.led
    error = np.concatenate([so3_log(off[:3, :3]), off[:3, 3]])
    carry = np.kron(np.eye(2), after.led[:3, :3])  # covariances are in the axes of the first body
    covariance = carry.T @ (edge_covariance(before.odometry, led[0], led[1]) + after.led_covariance) @ carry
    if float(error @ np.linalg.solve(covariance, error)) > _GATE:
        metres, degrees = np.linalg.norm(error[3:]), np.degrees(np.linalg.norm(error[:3]))
        return (
            f"the odometry before it and the one that started there differ by {metres:.2f} m and {degrees:.1f} degrees"
        )
    return None


def joined_chain(segments: Sequence[SegmentSurvey], cuts: tuple[Cut, ...], inputs: SurveyInputs) -> AdjustedChain:
    """One chain of segments that can be joined, in the frame of the first one."""
    placed = _placed(segments, level=inputs.calibration.imu is not None)
    odometry = replace(_joined_odometry(placed), cuts=cuts)
    state = _joined_state(placed, odometry, inputs)
    matched = {(i + each.first_keyframe, j + each.first_keyframe) for each in placed for i, j in each.made.matched}
    return AdjustedChain(odometry, state, matched, None, inputs.priors, inputs.calibration.base_from_body)


def _placed(segments: Sequence[SegmentSurvey], *, level: bool) -> list[_Placed]:
    placed = [_Placed(segments[0], np.eye(4), np.eye(4), 0, 0)]
    for before, after in pairwise(segments):
        last = placed[-1]
        odometry, state, tracks = before.odometry, before.state, before.odometry.tracks
        assert tracks is not None
        placed.append(
            _Placed(
                after,
                _laid_on(last.joined_from_odom @ odometry.odom_from_body[-1], after.odometry.odom_from_body[0], level),
                _laid_on(last.joined_from_map @ state.map_from_body[-1], after.state.map_from_body[0], level),
                last.first_keyframe + len(odometry.keyframes) - 1,
                last.first_track + int(tracks.ids.max(initial=-1)) + 1,
            )
        )
    return placed


def _laid_on(joined_from_body: Array, segment_from_body: Array, level: bool) -> Array:
    """joined_from_segment (4, 4) by one body in both. level: both know gravity, which a turn about z alone leaves as it is.

    So no segment adds its error of tilt to those behind it.
    """
    if not level:
        return np.asarray(joined_from_body @ se3_inverse(segment_from_body))
    turn = joined_from_body[:3, :3] @ segment_from_body[:3, :3].T
    yaw = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    rotation = so3_exp(np.array([0.0, 0.0, yaw]))
    return se3(rotation, joined_from_body[:3, 3] - rotation @ segment_from_body[:3, 3])


def _joined_odometry(placed: Sequence[_Placed]) -> OdometryPass:
    """Every frame is of the segment that begins with it or before it; what two saw of a shared frame, it has of both."""
    last = placed[-1].made.odometry
    covariances, reached = list[Array](), np.zeros((6, 6))
    for each in placed:
        own, turn = each.made.odometry.covariances, np.kron(np.eye(2), each.joined_from_odom[:3, :3])
        covariances.append(reached + turn @ (own - own[0]) @ turn.T)
        reached = covariances[-1][-1]
    covariances[0] += placed[0].made.odometry.covariances[0]
    passes = [each.made.odometry for each in placed]
    return OdometryPass(
        [e for own in passes[:-1] for e in own.estimates[:-1]] + last.estimates,
        _in_turn([each.joined_from_odom @ each.made.odometry.odom_from_body for each in placed]),
        _in_turn(covariances),
        _in_turn([own.tracked for own in passes]),
        [k for own in passes[:-1] for k in own.keyframes[:-1]] + last.keyframes,
        last.inertial,
        last.scale_known,
        last.has_wheels,
        _joined_tracks(placed),
    )


def _in_turn(parts: Sequence[Array]) -> Array:
    """Rows of all, each without its last, which the next one has first."""
    return np.concatenate([*(part[:-1] for part in parts[:-1]), parts[-1]])


def _joined_tracks(placed: Sequence[_Placed]) -> FrameTracks:
    starts, ids, pixels, size = [np.zeros(1, np.int64)], list[AnyArray](), list[AnyArray](), 0
    for each in placed:
        tracks = each.made.odometry.tracks
        assert tracks is not None
        # A shared frame ends where its rows of the later segment do.
        starts[-1] = starts[-1][:-1] if size else starts[-1]
        starts.append(size + tracks.starts[1:])
        ids.append(tracks.ids + np.int32(each.first_track))
        pixels.append(tracks.pixels)
        size += len(tracks.ids)
    return FrameTracks(np.concatenate(starts), np.concatenate(ids), np.concatenate(pixels))


def _joined_state(placed: Sequence[_Placed], odometry: OdometryPass, inputs: SurveyInputs) -> SurveyState:
    states = [each.made.state for each in placed]
    rotations = [each.joined_from_map[:3, :3] for each in placed]
    state = initial_state(odometry, inputs)
    motion = replace(
        state.motion,
        velocities_mps=_in_turn([s.motion.velocities_mps @ r.T for s, r in zip(states, rotations, strict=True)]),
        gyro_bias_radps=_in_turn([s.motion.gyro_bias_radps for s in states]),
        accel_bias_mps2=_in_turn([s.motion.accel_bias_mps2 for s in states]),
    )
    map_from_body = _in_turn([each.joined_from_map @ s.map_from_body for each, s in zip(placed, states, strict=True)])
    state = replace(state, map_from_body=map_from_body, motion=motion, landmarks=_joined_landmarks(placed))
    if odometry.inertial:
        state = replace(state, motion=replace(motion, relative=blackout_factors(odometry, state)))
    return state


def _joined_landmarks(placed: Sequence[_Placed]) -> Landmarks:
    """Those of all segments; what two have seen is two landmarks, until landmarks are made anew."""
    points, owners, number = list[Array](), list[NDArray[np.int32]](), 0
    for each in placed:
        marks, turn = each.made.state.landmarks, each.joined_from_map
        points.append(marks.points_map @ turn[:3, :3].T + turn[:3, 3])
        owners.append((marks.obs_landmark + number).astype(np.int32))
        number += len(marks.points_map)
    all_marks = [each.made.state.landmarks for each in placed]
    return Landmarks(
        np.concatenate(points),
        np.concatenate([m.obs_keyframe + np.int32(p.first_keyframe) for m, p in zip(all_marks, placed, strict=True)]),
        np.concatenate(owners),
        np.concatenate([m.obs_feature for m in all_marks]),
        np.concatenate([m.obs_pixels for m in all_marks]),
        np.concatenate([m.obs_sigma_px for m in all_marks]),
    )
