"""The chain of a survey's keyframes: from an initial trajectory to keyframes that are adjusted with their neighbours."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array
from fleetmap.sensors.samples import PositionPrior
from mapserver.survey.bundle.bundle_rounds import KeyframeMotion, SurveyState, bundle_rounds, local_windows
from mapserver.survey.bundle.odometry_factors import blackout_factors, odometry_factors
from mapserver.survey.given_poses import poses_as_odometry
from mapserver.survey.keyframes.keyframes import PosedKeyframes
from mapserver.survey.odometry_pass import OdometryPass, run_odometry
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyInputs, SurveyTools
from mapserver.survey.tracks.matching import PairFinder, drift_allowance_m
from mapserver.survey.tracks.mono_depths import MonoDepths, survey_camera
from mapserver.survey.tracks.pairs import PairMatch
from mapserver.survey.tracks.tracks import build_landmarks, no_landmarks, tracks_of

_MIN_KEYFRAMES = 2
_MIN_LANDMARKS = 30
ADJUSTED_SIGMA_RAD = 0.02  # of the rotation between adjusted keyframes, and between neighbours with an IMU


@dataclass(frozen=True)
class AdjustedChain:
    """The keyframes of a survey before its loops are closed: matched holds the pairs that were matched already.

    priors: what devices said of the robot's place, of its base. base_from_body (4, 4).
    """

    odometry: OdometryPass
    state: SurveyState
    matched: set[tuple[int, int]]
    depths: MonoDepths | None
    priors: Sequence[PositionPrior]
    base_from_body: Array


def begun_chain(inputs: SurveyInputs, settings: SurveySettings, tools: SurveyTools) -> AdjustedChain:
    """The odometry, or the poses that stand in for it, and the chain of its keyframes. Raises SurveyError where there is too little."""
    if inputs.initial_trajectory is None:
        odometry = run_odometry(inputs, settings, tools)
    else:
        odometry = poses_as_odometry(inputs.initial_trajectory, inputs, settings, tools)
    return adjusted_chain(odometry, inputs, settings, tools)


def adjusted_chain(
    odometry: OdometryPass, inputs: SurveyInputs, settings: SurveySettings, tools: SurveyTools
) -> AdjustedChain:
    """Keyframes matched with their neighbours and adjusted, before loops are looked for; SurveyError where there is too little."""
    if len(odometry.keyframes) < _MIN_KEYFRAMES:
        raise SurveyError(
            f"{len(odometry.estimates)} frames gave {len(odometry.keyframes)} keyframe(s) that belong together; a map needs "
            f"motion, at least {_MIN_KEYFRAMES}"
        )
    state = initial_state(odometry, inputs)
    depths = None
    if inputs.rectifier.camera.baseline_m == 0:
        depths = MonoDepths(odometry.keyframes, state.camera, settings)
    odometry = with_depths(odometry, state, depths)
    pairs = _match_neighbours(odometry, state, settings, tools)
    state = _first_landmarks(odometry, state, pairs, settings, tools)
    matched = {(p.i, p.j) for p in pairs}
    del pairs  # as large as all else in a long survey
    tools.at("local adjustment", 0, 1)
    if state.motion.inertial:
        # All at once: windows hold what came before them, and so lose the direction that odometry has from the gyro.
        held = [state]
        del state  # or its observations would be in memory twice
        state = bundle_rounds(held.pop(), settings, rounds=2)
    else:
        state = local_windows(state, settings)
    odometry = with_depths(odometry, state, depths)
    return AdjustedChain(odometry, state, matched, depths, inputs.priors, inputs.calibration.base_from_body)


def initial_state(odometry: OdometryPass, inputs: SurveyInputs) -> SurveyState:
    """Keyframes where odometry put them, no landmarks yet."""
    rectifier, numbers = inputs.rectifier, [k.frame_index for k in odometry.keyframes]
    estimates = [odometry.estimates[n] for n in numbers]
    map_from_body = odometry.odom_from_body[numbers]
    body_velocities = [e.odom_from_body[:3, :3].T @ e.velocity_odom_mps for e in estimates]
    motion = KeyframeMotion(
        inertial=odometry.inertial,
        imu=inputs.imu,
        noise=inputs.calibration.imu,
        imu_minus_cam_s=rectifier.imu_minus_cam_s,
        velocities_mps=np.einsum("kij,kj->ki", map_from_body[:, :3, :3], np.array(body_velocities)),
        gyro_bias_radps=np.array([e.gyro_bias_radps for e in estimates]),
        accel_bias_mps2=np.array([e.accel_bias_mps2 for e in estimates]),
        relative=[] if odometry.inertial else odometry_factors(odometry, map_from_body),
    )
    return SurveyState(
        stamps_ns=np.array([k.stamp_ns for k in odometry.keyframes], np.int64),
        map_from_body=map_from_body.copy(),
        body_from_cam=rectifier.body_from_cam,
        camera=survey_camera(rectifier.camera),
        motion=motion,
        landmarks=no_landmarks(),
        is_depth_camera=rectifier.has_depth,
    )


def with_depths(odometry: OdometryPass, state: SurveyState, depths: MonoDepths | None) -> OdometryPass:
    """The keyframes of one camera with depths by where they are now; unchanged for rigs that measure depth."""
    if depths is None:
        return odometry
    return replace(odometry, keyframes=depths.keyframes_at(state.map_from_body, state.body_from_cam))


def pair_finder(odometry: OdometryPass, state: SurveyState, settings: SurveySettings, tools: SurveyTools) -> PairFinder:
    """Matches the keyframes where they are now."""
    return PairFinder(odometry.keyframes, state.camera, state.body_from_cam, settings.pairs, tools.executor)


def _match_neighbours(
    odometry: OdometryPass, state: SurveyState, settings: SurveySettings, tools: SurveyTools
) -> list[PairMatch]:
    finder, previous = pair_finder(odometry, state, settings, tools), settings.pairs.previous
    near = max(settings.loops.min_gap_keyframes, previous)
    candidates = finder.candidates(state.map_from_body, previous=previous, only_near=near)
    covariances = odometry.covariances[[k.frame_index for k in odometry.keyframes]]
    allowed_m = drift_allowance_m(covariances, state.map_from_body[:, :3, 3])
    sigma_rad = ADJUSTED_SIGMA_RAD if odometry.inertial else None
    report = progress_of(tools, "matching", len(candidates))
    return finder.match(candidates, state.map_from_body, allowed_m, rotation_sigma_rad=sigma_rad, progress=report)


def _first_landmarks(
    odometry: OdometryPass, state: SurveyState, pairs: list[PairMatch], settings: SurveySettings, tools: SurveyTools
) -> SurveyState:
    """The landmarks of neighbouring keyframes; SurveyError where they are too few."""
    landmarks = build_landmarks(posed_keyframes(odometry, state), tracks_of(pairs), settings, tools.executor)
    state = replace(state, landmarks=landmarks)
    if odometry.inertial:
        state = replace(state, motion=replace(state.motion, relative=blackout_factors(odometry, state)))
    if len(landmarks.points_map) < _MIN_LANDMARKS:
        raise SurveyError(
            f"{len(odometry.keyframes)} keyframes share only {len(landmarks.points_map)} landmarks; look at the recording with "
            "`mapserver doctor`: dark, blurred, or the wrong calibration?"
        )
    return state


def posed_keyframes(odometry: OdometryPass, state: SurveyState) -> PosedKeyframes:
    """The keyframes where they are now."""
    return PosedKeyframes(odometry.keyframes, state.map_from_body, state.body_from_cam, state.camera)


def progress_of(tools: SurveyTools, stage: str, total: int) -> Callable[[int], None]:
    """Reports steps of a stage, numbered from 0."""
    return lambda number: tools.at(stage, number + 1, total)
