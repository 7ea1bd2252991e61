"""The survey from end to end: the list of its stages."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import Vocabulary
from fleetmap.errors import SurveyError
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import CameraFrame, ImuSamples, WheelSample
from mapserver.survey.bundle.bundle_rounds import Motion, SurveyState, adjust, adjust_windows
from mapserver.survey.bundle.odometry_factors import blackout_factors, chain_edges, odometry_terms
from mapserver.survey.bundle.stereo_yaw_check import NO_TURN, StereoYaw, estimate_stereo_yaw, without_stereo_yaw
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.finish.culling import Culled
from mapserver.survey.finish.map_assembly import summarise
from mapserver.survey.keyframes.connected_components import (
    Part,
    SigmaBetween,
    beside,
    find_components,
    only_kept,
    seen_by,
)
from mapserver.survey.keyframes.keyframes import ImageStore
from mapserver.survey.keyframes.revisit_thinning import adjust_visits, redundant_keyframes, without_redundant
from mapserver.survey.loops.loops import LoopCloser, Loops
from mapserver.survey.loops.sim3_loops import Sim3LoopCloser, gate_covariances, rigid, solve_scaled
from mapserver.survey.loops.zones import Zones
from mapserver.survey.odometry_pass import OdometryPass, run_odometry
from mapserver.survey.pose_graph.graph_marginals import GraphMarginals
from mapserver.survey.pose_graph.pose_graph import optimize_pose_graph
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_map import SurveyMap
from mapserver.survey.tracks.matching import PairFinder, drift_allowance_m, fixed_allowance_m
from mapserver.survey.tracks.mono_depths import ViewDepths, survey_camera
from mapserver.survey.tracks.pairs import PairMatch
from mapserver.survey.tracks.tracks import build_landmarks, landmarks_of, observed_again, tracks_of

Progress = Callable[[str, int, int], None]  # stage, done, total
_MIN_KEYFRAMES = 2
_MIN_LANDMARKS = 30


@dataclass(frozen=True)
class Survey:
    """What a survey gives: the map, the vocabulary it used, the loops with their reasons, the first guess it began with, the
    adjusted state, which still knows which feature each observation is, what was culled, what was found out about the pair of
    cameras, and the parts that hang together, of which one is the map."""

    map: SurveyMap
    vocabulary: Vocabulary
    loops: Loops
    first_guess: OdometryPass
    state: SurveyState
    culled: Culled
    pair_turn: StereoYaw
    parts: list[Part]


def survey(
    frames: Iterable[CameraFrame | RectifiedFrame], frame_count: int, imu: ImuSamples, calibration: RigCalibration, rectifier: Rectifier,
    vocabulary: Vocabulary, settings: SurveySettings, zones: Zones, progress: Progress,
    shelf: ImageStore | None = None, wheel: Sequence[WheelSample] = (), worker: Executor = SERIAL,
) -> Survey:  # fmt: skip
    """Maps one recording, its keyframes' pictures on `shelf`. Raises SurveyError where it holds too little to map."""
    guess = run_odometry(
        frames, imu, calibration, rectifier, settings, lambda n: progress("odometry", n + 1, frame_count), shelf, wheel,
        worker,
    )  # fmt: skip
    return survey_from(guess, imu, calibration, rectifier, vocabulary, settings, zones, progress, worker)


def survey_from(
    guess: OdometryPass, imu: ImuSamples, calibration: RigCalibration, rectifier: Rectifier, vocabulary: Vocabulary,
    settings: SurveySettings, zones: Zones, progress: Progress, worker: Executor = SERIAL,
) -> Survey:  # fmt: skip
    """All stages after the first guess."""
    if len(guess.keyframes) < _MIN_KEYFRAMES:
        raise SurveyError(
            f"{len(guess.estimates)} frames gave {len(guess.keyframes)} keyframe(s) that belong together; a map needs motion, "
            f"at least {_MIN_KEYFRAMES}"
        )
    state = _first_state(guess, imu, calibration, rectifier, settings)
    depths = ViewDepths(guess.keyframes, state.camera, settings) if rectifier.camera.baseline_m == 0 else None
    guess = _with_depths(guess, state, depths)
    keyframes = guess.keyframes
    finder = PairFinder(keyframes, state.camera, rectifier.body_from_cam, settings, worker)
    pairs = _match_neighbours(guess, state, finder, settings, progress)
    state.landmarks = build_landmarks(
        keyframes, pairs, state.map_from_body, state.body_from_cam, state.camera, settings, worker
    )
    if guess.inertial:
        state.motion = replace(state.motion, relative=blackout_factors(guess, state))
    if len(state.landmarks.points_map) < _MIN_LANDMARKS:
        raise SurveyError(
            f"{len(keyframes)} keyframes share only {len(state.landmarks.points_map)} landmarks; look at the recording with "
            "`mapserver doctor`: dark, blurred, or the wrong calibration?"
        )
    matched = {(p.i, p.j) for p in pairs}
    del pairs  # as large as all else in a long survey
    progress("local adjustment", 0, 1)
    adjust_windows(state, settings)
    if state.motion.inertial:
        adjust(state, settings, rounds=2)
    guess = _with_depths(guess, state, depths)
    loops = _close_loops(guess, state, matched, vocabulary, settings, zones, progress, worker)
    guess, turn = _adjust_globally(guess, state, finder, depths, settings, progress, worker)
    progress("global adjustment", 2, 2)
    frames_of = np.array([k.frame_index for k in guess.keyframes], np.int64)
    parts = find_components(seen_by(state), SigmaBetween(guess.covariances[frames_of]), settings.join_sigma_m)
    state, guess, loops = only_kept(state, guess, loops, parts.kept)
    survey_map, culled = summarise(state, guess, settings)
    between = beside(len(survey_map.trajectory), frames_of, parts.kept)
    survey_map = replace(survey_map, trajectory_estimated=survey_map.trajectory_estimated & between)
    return Survey(survey_map, vocabulary, loops, guess, state, culled, turn, [*parts.parts, *parts.stray])


def _adjust_globally(
    guess: OdometryPass, state: SurveyState, finder: PairFinder, depths: ViewDepths | None, settings: SurveySettings,
    progress: Progress, worker: Executor,
) -> tuple[OdometryPass, StereoYaw]:  # fmt: skip
    """Matches all views where the loops put them and adjusts them together, twice: the first result shows how the pair is turned."""
    turn, spare = NO_TURN, np.zeros(len(guess.keyframes), bool)
    for round_number in range(2):
        progress("global adjustment", round_number, 2)
        if depths is not None:
            guess = _with_depths(guess, state, depths)
            finder = PairFinder(guess.keyframes, state.camera, state.body_from_cam, settings, worker)
        keyframes = guess.keyframes
        if round_number == 0 or depths is not None:
            tracks = tracks_of(_match_all(state, finder, settings, progress))
            spare = redundant_keyframes(tracks, keyframes, settings)
            state.landmarks = landmarks_of(
                keyframes, tracks, spare, state.map_from_body, state.body_from_cam, state.camera, settings, worker
            )
            del tracks
        else:  # a second search finds hardly a match more; its coordinates are finer
            state.landmarks = observed_again(
                state.landmarks, keyframes, state.map_from_body, state.body_from_cam, state.camera, settings, worker
            )
        state.landmarks = without_stereo_yaw(state.landmarks, state.camera, turn.correction_px)
        adjust_visits(state, settings, spare, rounds=3 if round_number == 0 or depths is not None else 2)
        if round_number == 0:
            turn = estimate_stereo_yaw(without_redundant(state, spare), settings)
    return guess, turn


def _with_depths(guess: OdometryPass, state: SurveyState, depths: ViewDepths | None) -> OdometryPass:
    """One camera's keyframes with depths by where they are now; the same guess for rigs that measure depth."""
    if depths is None:
        return guess
    return replace(guess, keyframes=depths.placed(state.map_from_body, state.body_from_cam))


def _first_state(
    guess: OdometryPass, imu: ImuSamples, calibration: RigCalibration, rectifier: Rectifier, settings: SurveySettings
) -> SurveyState:
    """Keyframes where odometry put them, no landmarks yet."""
    numbers = [k.frame_index for k in guess.keyframes]
    estimates = [guess.estimates[n] for n in numbers]
    map_from_body = guess.odom_from_body[numbers]
    motion = Motion(
        guess.inertial, imu, calibration.imu, rectifier.imu_minus_cam_s,
        np.array([e.velocity_odom_mps for e in estimates]), np.array([e.gyro_bias_radps for e in estimates]),
        np.array([e.accel_bias_mps2 for e in estimates]), [] if guess.inertial else odometry_terms(guess, map_from_body),
    )  # fmt: skip
    camera = survey_camera(rectifier.camera)
    nothing = build_landmarks([], [], map_from_body, rectifier.body_from_cam, camera, settings)
    stamps = np.array([k.stamp_ns for k in guess.keyframes], np.int64)
    return SurveyState(
        stamps, map_from_body.copy(), rectifier.body_from_cam, camera, motion, nothing, rectifier.has_depth
    )


def _match_neighbours(
    guess: OdometryPass, state: SurveyState, finder: PairFinder, settings: SurveySettings, progress: Progress
) -> list[PairMatch]:
    candidates = finder.candidates(
        state.map_from_body,
        previous=settings.pairs.previous,
        only_near=max(settings.loops.min_gap_keyframes, settings.pairs.previous),
    )
    covariances = guess.covariances[[k.frame_index for k in guess.keyframes]]
    return finder.match(
        candidates, state.map_from_body, drift_allowance_m(covariances, state.map_from_body[:, :3, 3]),
        rotation_sigma_rad=0.02 if guess.inertial else None, is_known=True,
        progress=lambda n: progress("matching", n + 1, len(candidates)),
    )  # fmt: skip


def _match_all(state: SurveyState, finder: PairFinder, settings: SurveySettings, progress: Progress) -> list[PairMatch]:
    candidates = finder.candidates(state.map_from_body, previous=settings.pairs.previous)
    return finder.match(
        candidates, state.map_from_body, fixed_allowance_m(state.map_from_body), rotation_sigma_rad=0.02, is_known=True,
        progress=lambda n: progress("matching again", n + 1, len(candidates)),
    )  # fmt: skip


def _close_loops(
    guess: OdometryPass, state: SurveyState, matched: set[tuple[int, int]], vocabulary: Vocabulary, settings: SurveySettings,
    zones: Zones, progress: Progress, worker: Executor,
) -> Loops:  # fmt: skip
    """Finds loops, and moves the keyframes to where the pose graph with them says."""
    keyframes = guess.keyframes
    chain, walk = chain_edges(guess, state), settings.monocular.scale_walk
    vectors = [vocabulary.bow_vector(vocabulary.words(k.features.descriptors)) for k in keyframes]
    kind, known = (LoopCloser, chain) if guess.scale_known else (Sim3LoopCloser, gate_covariances(chain, walk))
    closer = kind(
        keyframes, vectors, vocabulary.word_count, state.camera, state.body_from_cam, state.map_from_body,
        GraphMarginals(state.map_from_body, known), matched, settings, zones, worker,
    )  # fmt: skip
    for i in range(len(keyframes)):
        closer.close(i)
        progress("loops", i + 1, len(keyframes))
    if closer.loops.edges and isinstance(closer, Sim3LoopCloser):
        scaled = solve_scaled(state.map_from_body, chain, closer.loops.edges, closer.scales, walk)
        closer.loops.disbelieve(scaled.loop_weights)
        _move(state, rigid(scaled))
        state.motion = replace(state.motion, relative=odometry_terms(guess, state.map_from_body))
    elif closer.loops.edges:
        solved = optimize_pose_graph(state.map_from_body, [*chain, *closer.loops.edges])
        closer.loops.disbelieve(solved.loop_weights)
        _move(state, solved.map_from_body)
    return closer.loops


def _move(state: SurveyState, map_from_body: NDArray[np.float64]) -> None:
    turns = map_from_body[:, :3, :3] @ state.map_from_body[:, :3, :3].transpose(0, 2, 1)
    state.motion = replace(state.motion, velocities_mps=np.einsum("kij,kj->ki", turns, state.motion.velocities_mps))
    state.map_from_body = map_from_body
