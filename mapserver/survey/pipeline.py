"""The survey from end to end: the list of its stages, each a function from a state to a new one."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import Vocabulary
from fleetmap.geometry import Array
from mapserver.survey.bundle.bundle_rounds import SurveyState
from mapserver.survey.bundle.odometry_factors import chain_edges, odometry_factors
from mapserver.survey.bundle.stereo_yaw_check import NO_YAW, StereoYaw, estimate_stereo_yaw, without_stereo_yaw
from mapserver.survey.chain import (
    ADJUSTED_SIGMA_RAD,
    AdjustedChain,
    adjusted_chain,
    pair_finder,
    posed_keyframes,
    progress_of,
    with_depths,
)
from mapserver.survey.finish.culling import Culled
from mapserver.survey.finish.frame_adjustment import place_frames
from mapserver.survey.finish.map_assembly import assemble
from mapserver.survey.keyframes.connected_components import (
    Component,
    SigmaBetween,
    between_kept,
    covisibility_of,
    find_components,
    find_parts,
    only_kept,
)
from mapserver.survey.keyframes.revisit_thinning import adjust_visits, redundant_keyframes, without_redundant
from mapserver.survey.loops.loops import LoopCloser, Loops
from mapserver.survey.loops.sim3_loops import Sim3LoopCloser, gate_covariances, rigid, solve_scaled
from mapserver.survey.odometry_pass import OdometryPass
from mapserver.survey.pose_graph.graph_marginals import GraphMarginals
from mapserver.survey.pose_graph.pose_graph import optimize_pose_graph
from mapserver.survey.pose_graph.position_priors import learn_priors
from mapserver.survey.segments.segmented import begun_in_segments
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyConfig, SurveyInputs, SurveyTools
from mapserver.survey.survey_map import SurveyMap
from mapserver.survey.tracks.matching import PairFinder, fixed_allowance_m
from mapserver.survey.tracks.mono_depths import MonoDepths
from mapserver.survey.tracks.pairs import PairMatch
from mapserver.survey.tracks.tracks import (
    Tracks,
    build_landmarks,
    no_landmarks,
    refine_observations,
    tracks_of,
)

_Known = tuple[set[tuple[int, int]], Tracks | None]


@dataclass(frozen=True)
class Survey:
    """The result of a survey.

    odometry: the initial trajectory. state: the adjusted variables, which still name the feature of each observation.
    components: the connected components, of which one is the map. stereo_yaw: the extrinsic yaw error of the pair.
    seen (F,): frames that points of the map place; the others are where odometry or the IMU carries them.
    """

    map: SurveyMap
    vocabulary: Vocabulary
    loops: Loops
    odometry: OdometryPass
    state: SurveyState
    culled: Culled
    stereo_yaw: StereoYaw
    components: list[Component]
    seen: NDArray[np.bool_]


def survey(inputs: SurveyInputs, options: SurveyConfig, tools: SurveyTools | None = None) -> Survey:
    """Maps one recording. Raises SurveyError where it holds too little to map."""
    tools = tools or SurveyTools()
    return finish_survey(begin_survey(inputs, options.settings, tools), options, tools)


def begin_survey(inputs: SurveyInputs, settings: SurveySettings, tools: SurveyTools) -> AdjustedChain:
    """The stages before loops are looked for: `finish_survey` goes on. Raises SurveyError where there is too little."""
    return begun_in_segments(inputs, settings, tools)


def survey_from(
    odometry: OdometryPass, inputs: SurveyInputs, options: SurveyConfig, tools: SurveyTools | None = None
) -> Survey:
    """All stages after the initial trajectory."""
    tools = tools or SurveyTools()
    return finish_survey(adjusted_chain(odometry, inputs, options.settings, tools), options, tools)


def finish_survey(chain: AdjustedChain, options: SurveyConfig, tools: SurveyTools) -> Survey:
    """The stages from the loops on."""
    settings = options.settings
    odometry, depths = chain.odometry, chain.depths
    state, loops = _close_loops(chain, options, tools)
    # Neighbours need not be matched again. Of one camera they are, as depths by which they were matched have changed.
    known: _Known = (chain.matched, Tracks.of(state.landmarks)) if depths is None else (set(), None)
    # The landmarks so far are those of neighbours; all are made anew, and nobody may hold the old ones meanwhile.
    del chain
    state = replace(state, landmarks=no_landmarks())
    odometry, state, stereo_yaw = _adjust_globally(odometry, state, known, depths, settings, tools)
    tools.at("global adjustment", 2, 2)
    frames_of = np.array([k.frame_index for k in odometry.keyframes], np.int64)
    components = find_components(covisibility_of(state), _sigmas_m(odometry), settings.join_sigma_m)
    state, odometry, loops = only_kept(state, odometry, loops, components.kept)
    placed = place_frames(odometry, state, settings, stereo_yaw.correction_px, tools.executor)
    survey_map, culled = assemble(state, odometry, placed, settings)
    between = between_kept(len(survey_map.trajectory), frames_of, components.kept)
    survey_map = replace(survey_map, trajectory_estimated=survey_map.trajectory_estimated & between)
    every = [*components.components, *components.stray]
    return Survey(survey_map, options.vocabulary, loops, odometry, state, culled, stereo_yaw, every, placed.seen)


def _match_all(
    state: SurveyState, finder: PairFinder, matched: set[tuple[int, int]], settings: SurveySettings, tools: SurveyTools
) -> list[PairMatch]:
    """The matches of all pairs that should see the same now, but for those that were matched before."""
    every = finder.candidates(state.map_from_body, previous=settings.pairs.previous)
    candidates = [pair for pair in every if pair not in matched]
    allowed_m, report = fixed_allowance_m(state.map_from_body), progress_of(tools, "matching again", len(candidates))
    sigma_rad = ADJUSTED_SIGMA_RAD
    return finder.match(candidates, state.map_from_body, allowed_m, rotation_sigma_rad=sigma_rad, progress=report)


def _sigmas_m(odometry: OdometryPass) -> SigmaBetween:
    covariances = odometry.covariances[[k.frame_index for k in odometry.keyframes]]
    return SigmaBetween(np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2))


def _close_loops(begun: AdjustedChain, options: SurveyConfig, tools: SurveyTools) -> tuple[SurveyState, Loops]:
    """Finds loops; the keyframes are then where the pose graph with them says. Position priors are known to the gate alone."""
    odometry, state = begun.odometry, begun.state
    chain, scale_walk = chain_edges(odometry, state), options.settings.monocular.scale_walk
    kind, known = LoopCloser, chain
    if not odometry.scale_known:
        kind, known = Sim3LoopCloser, gate_covariances(chain, scale_walk)
    marginals = GraphMarginals(state.map_from_body, known)
    if odometry.scale_known:
        learn_priors(marginals, begun.priors, begun.base_from_body, odometry)
    parts = find_parts(covisibility_of(state), _sigmas_m(odometry), options.settings.join_sigma_m)
    closer = kind(posed_keyframes(odometry, state), options, marginals, begun.matched, tools.executor, parts)
    for i in range(len(odometry.keyframes)):
        closer.close(i)
        tools.at("loops", i + 1, len(odometry.keyframes))
    loops = closer.loops
    if loops.edges and isinstance(closer, Sim3LoopCloser):
        scaled = solve_scaled(state.map_from_body, chain, loops.edges, closer.scales, scale_walk)
        state = _at(state, rigid(scaled))
        factors = odometry_factors(odometry, state.map_from_body)
        return replace(state, motion=replace(state.motion, relative=factors)), loops.without_outliers(
            scaled.loop_weights
        )
    if loops.edges:
        solved = optimize_pose_graph(closer.begin, [*chain, *loops.edges])
        return _at(state, solved.map_from_body), loops.without_outliers(solved.loop_weights)
    return state, loops


def _at(state: SurveyState, map_from_body: Array) -> SurveyState:
    """The state with its keyframes, and their velocities with them, at map_from_body (K, 4, 4)."""
    rotations = map_from_body[:, :3, :3] @ state.map_from_body[:, :3, :3].transpose(0, 2, 1)
    velocities = np.einsum("kij,kj->ki", rotations, state.motion.velocities_mps)
    return replace(state, map_from_body=map_from_body, motion=replace(state.motion, velocities_mps=velocities))


def _adjust_globally(
    odometry: OdometryPass,
    state: SurveyState,
    known: _Known,
    depths: MonoDepths | None,
    settings: SurveySettings,
    tools: SurveyTools,
) -> tuple[OdometryPass, SurveyState, StereoYaw]:
    """Matches all views where the loops put them and adjusts them together, twice: the first result gives the stereo yaw error.

    known: pairs that need not be matched, and what they have joined.
    """
    yaw, redundant = NO_YAW, np.zeros(len(odometry.keyframes), bool)
    finder = pair_finder(odometry, state, settings, tools)
    for round_number in range(2):
        tools.at("global adjustment", round_number, 2)
        search = round_number == 0 or depths is not None
        if depths is not None:
            odometry = with_depths(odometry, state, depths)
            finder = pair_finder(odometry, state, settings, tools)
        posed = posed_keyframes(odometry, state)
        if search:
            tracks = tracks_of(_match_all(state, finder, known[0], settings, tools), known[1])
            redundant = redundant_keyframes(tracks, odometry.keyframes, settings)
            landmarks, observed_from = (
                build_landmarks(posed, tracks, settings, tools.executor, redundant),
                posed.map_from_cam,
            )
            del tracks
        else:  # a second search finds hardly a match more; its coordinates are finer
            landmarks = refine_observations(posed, state.landmarks, settings, tools.executor, observed_from)
        held = [replace(state, landmarks=without_stereo_yaw(landmarks, state.camera, yaw.correction_px))]
        del landmarks, state  # or observations would be in memory twice
        tools.release()
        state = adjust_visits(held.pop(), settings, redundant, rounds=3 if search else 2)
        if round_number == 0:
            yaw = estimate_stereo_yaw(without_redundant(state, redundant), settings)
    return odometry, state, yaw
