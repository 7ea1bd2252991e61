"""A survey from a recording to a map: its stages in order, each a function of the earlier results.

| stage | takes | gives |
|---|---|---|
| `follow` | frames, IMU, wheels, or given poses | `OdometryPass`: odometry of all frames, keyframes with their features |
| `adjust_chain` | that | `AdjustedChain`: keyframes matched with their neighbours, landmarks, both adjusted |
| `close_loops` | the chain, vocabulary, zones, position priors | `SurveyState` after the pose graph, in `map` by priors, and the `Loops` |
| `match_again` | keyframes after loops, matched pairs | the images of all cameras matched again, and adjusted |
| `refine` | that | observations and keyframes again, at better poses; each camera's error of yaw |
| `find_components`, `only_kept` | the adjusted state, odometry, loops | their part in the connected component that becomes the map |
| `place_frames`, `assemble` | the kept state | all frames, and the map; inconsistent observations are culled |

For a long recording, the first two run segment by segment. `mapserver build` calls `begin_survey`, measures the calibration from its
result, and calls `finish_survey` (drafting/survey_recordings.py); drafting/draft.py continues with the map: the site's current map, tiles.
Every stage receives the settings; depths of a single camera come from tracks/mono_depths.py, and replace those of stereo in each stage;
those of single cameras beside a pair are triangulated once, before loop closure.
"""

from dataclasses import dataclass, replace

import numpy as np

from fleetmap.bow.vocabulary import Vocabulary
from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, Indices, Mask, se3_inverse
from mapserver.survey.bundle.bundle_rounds import bundle_rounds, local_windows
from mapserver.survey.bundle.stereo_yaw_check import StereoYaw, estimate_stereo_yaw, without_stereo_yaw
from mapserver.survey.finish.frame_adjustment import place_frames
from mapserver.survey.finish.map_assembly import Culled, assemble
from mapserver.survey.finish.revisit_thinning import adjust_visits, redundant_keyframes, without_redundant
from mapserver.survey.loops import connected_components as connected
from mapserver.survey.loops.connected_components import Component
from mapserver.survey.loops.loops import LoopCloser, Loops
from mapserver.survey.odometry_pass import initial_state, poses_as_odometry, run_odometry
from mapserver.survey.pose_graph import position_priors
from mapserver.survey.pose_graph.graph_marginals import GraphMarginals
from mapserver.survey.pose_graph.odometry_factors import blackout_factors, chain_edges, odometry_factors
from mapserver.survey.pose_graph.pose_graph import PoseEdge, optimize_pose_graph
from mapserver.survey.pose_graph.position_priors import placed_by_priors, prior_edges
from mapserver.survey.pose_graph.sim3_pose_graph import gate_covariances, solve_scaled
from mapserver.survey.rig import rig_of
from mapserver.survey.segments import in_segments
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import Landmarks, OdometryPass, RigImages, SurveyState, image_numbers
from mapserver.survey.survey_inputs import AdjustedChain, SurveyConfig, SurveyInputs, SurveyTools
from mapserver.survey.survey_map import SurveyMap
from mapserver.survey.tracks.matching import PairFinder, drift_allowance_m, fixed_allowance_m
from mapserver.survey.tracks.mono_depths import MonoDepths, with_single_cameras
from mapserver.survey.tracks.tracks import Tracks, build_landmarks, refine_observations, tracks_of

_MIN_KEYFRAMES = 2
_MIN_LANDMARKS = 30
_ADJUSTED_SIGMA_RAD = 0.02  # of the rotation between adjusted keyframes, and between neighbours with an IMU


@dataclass(frozen=True)
class Survey:
    """The result of a survey.

    odometry: the initial trajectory. state: the adjusted variables, which still name the feature of each observation. landmarks_in_map:
    rows of the state's landmarks in the map. components: the connected components, of which one is the map. stereo_yaws: the extrinsic yaw
    error of each camera's pair. seen (F,): frames located by points of the map; the others by odometry or the IMU.
    """

    map: SurveyMap
    landmarks_in_map: Indices
    vocabulary: Vocabulary
    loops: Loops
    odometry: OdometryPass
    state: SurveyState
    culled: Culled
    stereo_yaws: tuple[StereoYaw, ...]
    components: list[Component]
    seen: Mask


def survey(inputs: SurveyInputs, config: SurveyConfig, tools: SurveyTools | None = None) -> Survey:
    """Map one recording. Raises SurveyError if it contains too little to map."""
    tools = tools or SurveyTools()
    return finish_survey(begin_survey(inputs, config.settings, tools), inputs, config, tools)


def begin_survey(inputs: SurveyInputs, settings: SurveySettings, tools: SurveyTools) -> AdjustedChain:
    """Run the stages before loop closure, for a long recording by segments. Raises SurveyError if there is too little."""
    return in_segments(_whole, inputs, settings, tools)


def _whole(inputs: SurveyInputs, settings: SurveySettings, tools: SurveyTools) -> AdjustedChain:
    return adjust_chain(follow(inputs, settings, tools), inputs, settings, tools)


def finish_survey(chain: AdjustedChain, inputs: SurveyInputs, config: SurveyConfig, tools: SurveyTools) -> Survey:
    """Run the stages after `begin_survey`. The caller must drop its reference to the chain, or a long survey is in memory twice."""
    settings, rig = config.settings, rig_of(inputs.rectifier)
    odometry = with_single_cameras(chain.odometry, chain.state.map_from_body, rig, settings)
    chain = replace(chain, odometry=odometry)
    state, loops = close_loops(chain, inputs, config, tools)
    # Neighbours need not be matched again, except for one camera: the depths used for matching have changed.
    known = None
    if chain.depths is None:
        known = chain.matched, Tracks.of(state.landmarks, image_numbers(len(state.stamps_ns), len(rig)))
    # Landmarks so far are those of neighbours; all are built again, and nothing may hold the old ones meanwhile.
    state = replace(state, landmarks=Landmarks.empty(), rig=rig)
    chain = replace(chain, odometry=connected.without_doubted(chain.odometry, loops.doubted), state=state)
    odometry, state, stereo_yaws = refine(match_again(chain, known, settings, tools), settings, tools, inputs.pair_yaw)
    tools.at("global adjustment", 2, 2)
    frames_of = np.array(odometry.keyframe_frames, np.int64)
    components = connected.find_components(state, connected.sigma_between(odometry), settings.join_sigma_m)
    state, odometry, loops = connected.only_kept(state, odometry, loops, components.kept)
    placed = place_frames(odometry, state, settings, stereo_yaws[0].correction_px, tools.executor)
    survey_map, rows, culled = assemble(state, odometry, placed, settings)
    between = connected.between_kept(len(survey_map.trajectory), frames_of, components.kept)
    survey_map = replace(survey_map, trajectory_estimated=survey_map.trajectory_estimated & between)
    every = [*components.components, *components.stray]
    return Survey(survey_map, rows, config.vocabulary, loops, odometry, state, culled, stereo_yaws, every, placed.seen)


def follow(inputs: SurveyInputs, settings: SurveySettings, tools: SurveyTools) -> OdometryPass:
    """Run odometry over all frames, or use the poses of another system instead, with the keyframes."""
    if inputs.initial_trajectory is None:
        return run_odometry(inputs, settings, tools)
    return poses_as_odometry(inputs.initial_trajectory, inputs, settings, tools)


def adjust_chain(
    odometry: OdometryPass, inputs: SurveyInputs, settings: SurveySettings, tools: SurveyTools
) -> AdjustedChain:
    """Match keyframes with their neighbours and adjust them, before loop closure; SurveyError if there is too little."""
    if len(odometry.keyframes) < _MIN_KEYFRAMES:
        raise SurveyError(
            f"{len(odometry.estimates)} frames gave {len(odometry.keyframes)} connected keyframe(s); a map needs "
            f"motion, at least {_MIN_KEYFRAMES}"
        )
    state = initial_state(odometry, inputs)
    depths = None
    if inputs.rectifier.camera.baseline_m == 0:
        depths = MonoDepths(odometry.keyframes, state.rig.camera, settings)
    odometry = _with_depths(odometry, state, depths)
    state, matched = _with_neighbours(odometry, state, settings, tools)
    if odometry.inertial:
        state = replace(state, motion=replace(state.motion, relative=blackout_factors(odometry, state)))
    if len(state.landmarks.points_map) < _MIN_LANDMARKS:
        raise SurveyError(
            f"{len(odometry.keyframes)} keyframes share only {len(state.landmarks.points_map)} landmarks; check the recording with "
            "`mapserver doctor`: dark, blurred, or the wrong calibration?"
        )
    tools.at("local adjustment", 0, 1)
    # With an IMU all at once: windows fix earlier keyframes, and so lose the heading that odometry has from the gyro.
    state = bundle_rounds(state, settings, rounds=2) if state.motion.inertial else local_windows(state, settings)
    return AdjustedChain(_with_depths(odometry, state, depths), state, matched, depths)


def _with_neighbours(
    odometry: OdometryPass, state: SurveyState, settings: SurveySettings, tools: SurveyTools
) -> tuple[SurveyState, set[tuple[int, int]]]:
    """Return the state with the landmarks that the first camera sees in neighbouring keyframes, and the matched pairs of them."""
    allowed_m = drift_allowance_m(odometry.keyframe_variances_m2, state.map_from_body[:, :3, 3])
    posed = _posed(odometry, state)
    finder = PairFinder(posed, settings.pairs, tools.executor, tools.at)
    candidates = finder.candidates(max(settings.loops.min_gap_keyframes, settings.pairs.previous))
    pairs = finder.match(candidates, allowed_m, _ADJUSTED_SIGMA_RAD if odometry.inertial else None)
    landmarks = build_landmarks(posed, tracks_of(pairs), settings, tools.executor)
    return replace(state, landmarks=landmarks), {(p.i, p.j) for p in pairs}


def close_loops(
    begun: AdjustedChain, inputs: SurveyInputs, config: SurveyConfig, tools: SurveyTools
) -> tuple[SurveyState, Loops]:
    """Find loops, and return the keyframes after the pose graph with them: in `map` if position priors give its frame."""
    odometry, state, settings = begun.odometry, begun.state, config.settings
    chain, scale_walk = chain_edges(odometry, state), settings.monocular.scale_walk
    known = chain if odometry.scale_known else gate_covariances(chain, scale_walk)
    marginals = GraphMarginals(state.map_from_body, known)
    if odometry.scale_known and inputs.priors:
        base_from_body = inputs.calibration.base_from_body
        placed, terms = placed_by_priors(state.map_from_body, marginals, inputs.priors, base_from_body, odometry)
        marginals = GraphMarginals(placed, known)
        state = replace(state.moved(placed), priors=position_priors.learn_priors(marginals, terms))
    groups = connected.find_groups(state, connected.sigma_between(odometry), settings.join_sigma_m)
    posed = _posed(odometry, replace(state, rig=rig_of(inputs.rectifier)))
    closer = LoopCloser(
        posed,
        config,
        marginals,
        begun.matched,
        groups,
        tools.executor,
        connected.find_groups(state, lambda *_: np.inf, 0.0) if odometry.scale_known else None,
        measures_scale=not odometry.scale_known,
    )
    for i in range(len(posed.images)):
        closer.close(i)
        tools.at("loops", i + 1, len(posed.images))
    loops = replace(closer.loops, doubted=closer.doubted())
    if odometry.scale_known:
        return _solved(state, closer.begin, chain, loops)
    if not loops.edges:
        return state, loops
    map_from_body, weights = solve_scaled(state.map_from_body, chain, loops.edges, closer.scales, scale_walk)
    state = state.moved(map_from_body)
    factors = odometry_factors(odometry, state.map_from_body)
    return replace(state, motion=replace(state.motion, relative=factors)), loops.without_outliers(weights)


def _solved(state: SurveyState, map_from_body: Array, chain: list[PoseEdge], loops: Loops) -> tuple[SurveyState, Loops]:
    """Return the state and the loops after the pose graph of both and of believed priors; begun at map_from_body (K, 4, 4)."""
    believed = [n for n, term in enumerate(state.priors) if term.is_believed]
    if not loops.edges and not believed:
        return state, loops
    if not believed:
        solved = optimize_pose_graph(map_from_body, [*chain, *loops.edges])
        return state.moved(solved.map_from_body), loops.without_outliers(solved.loop_weights)
    nodes, held = prior_edges(map_from_body, [state.priors[n] for n in believed])
    solved = optimize_pose_graph(nodes, [*chain, *loops.edges, *held])
    new_from_map = position_priors.level(se3_inverse(solved.map_from_body[-1]), state.priors[believed[0]].map_from_body)
    weights = dict(zip(believed, solved.loop_weights[len(loops.edges) :] >= 0.5, strict=True))
    priors = [replace(term, is_believed=bool(weights.get(n, False))) for n, term in enumerate(state.priors)]
    state = replace(state.moved(new_from_map @ solved.map_from_body[:-1]), priors=priors)
    return state, loops.without_outliers(solved.loop_weights[: len(loops.edges)])


@dataclass(frozen=True)
class GlobalMatch:
    """A survey after its first global adjustment: redundant keyframes (K,), and map_from_cam (P, 4, 4) at which its images were matched."""

    odometry: OdometryPass
    state: SurveyState
    depths: MonoDepths | None
    redundant: Mask
    map_from_cam: Array


_Known = tuple[set[tuple[int, int]], Tracks]


def match_again(
    chain: AdjustedChain, known: _Known | None, settings: SurveySettings, tools: SurveyTools
) -> GlobalMatch:
    """Match the images of all cameras at the poses after loop closure, and adjust them together.

    known: pairs of keyframes whose images by the first camera need not be matched again, and their tracks.
    """
    tools.at("global adjustment", 0, 2)
    odometry = _with_depths(chain.odometry, chain.state, chain.depths)
    posed = _posed(odometry, chain.state)
    landmarks, redundant = _observed(posed, chain.state, known, settings, tools)
    state = _adjusted(replace(chain.state, landmarks=landmarks), redundant, settings, tools, rounds=3)
    return GlobalMatch(odometry, state, chain.depths, redundant, posed.map_from_cam)


def refine(
    first: GlobalMatch, settings: SurveySettings, tools: SurveyTools, pair_yaw: tuple[float, float] | None = None
) -> tuple[OdometryPass, SurveyState, tuple[StereoYaw, ...]]:
    """Observe and adjust once more, at the poses of the first adjustment, which give the stereo yaw error of each camera.

    pair_yaw: see SurveyInputs; in place of the first camera's.
    """
    tools.images.release()
    yaws = _stereo_yaws(first.state, first.redundant, settings)
    if pair_yaw is not None:
        shift_px, sigma_px = (first.state.rig.camera.focal_px * angle for angle in pair_yaw)
        yaws = StereoYaw(shift_px, sigma_px, corrected=True, is_earlier=True), *yaws[1:]
    tools.at("global adjustment", 1, 2)
    odometry, redundant, rounds = _with_depths(first.odometry, first.state, first.depths), first.redundant, 2
    posed = _posed(odometry, first.state)
    if first.depths is None:  # a second search finds almost no further matches; its coordinates are more accurate
        landmarks = refine_observations(posed, first.state.landmarks, settings, tools.executor, first.map_from_cam)
    else:
        landmarks, redundant = _observed(posed, first.state, None, settings, tools)
        rounds = 3
    landmarks = without_stereo_yaw(landmarks, posed.rig.camera, *(yaw.correction_px for yaw in yaws))
    state = _adjusted(replace(first.state, landmarks=landmarks), redundant, settings, tools, rounds)
    return odometry, state, yaws


def _observed(
    posed: RigImages, state: SurveyState, known: _Known | None, settings: SurveySettings, tools: SurveyTools
) -> tuple[Landmarks, Mask]:
    """Return the landmarks of all images, and the keyframes (K,) that their adjustment can do without."""
    finder = PairFinder(posed, settings.pairs, tools.executor, tools.at)
    candidates, tracks = finder.candidates(), None
    if known is not None:
        first, (matched, tracks) = posed.numbers[:, 0].tolist(), known
        done = {(first[i], first[j]) for i, j in matched}
        candidates = [pair for pair in candidates if pair not in done]
    allowed_m = fixed_allowance_m(posed.map_from_body)
    tracks = tracks_of(finder.match(candidates, allowed_m, _ADJUSTED_SIGMA_RAD, "matching again"), tracks)
    redundant = redundant_keyframes(tracks, posed, settings)
    redundant[[term.k for term in state.priors]] = False
    return build_landmarks(posed, tracks, settings, tools.executor, redundant), redundant


def _adjusted(
    state: SurveyState, redundant: Mask, settings: SurveySettings, tools: SurveyTools, rounds: int
) -> SurveyState:
    """Return the adjusted state; priors that contradict it are then no longer believed."""
    tools.images.release()
    state = adjust_visits(state, settings, redundant, rounds)
    priors, same = position_priors.judged_priors(state.priors, state.map_from_body)
    return state if same else adjust_visits(replace(state, priors=priors), settings, redundant, rounds=2)


def _stereo_yaws(state: SurveyState, redundant: Mask, settings: SurveySettings) -> tuple[StereoYaw, ...]:
    part = without_redundant(state, redundant)  # a copy of most landmarks, which must not outlive this call
    return tuple(estimate_stereo_yaw(part, settings, camera) for camera in range(len(part.rig)))


def _with_depths(odometry: OdometryPass, state: SurveyState, depths: MonoDepths | None) -> OdometryPass:
    """Return the keyframes of one camera with depths by their present poses; unchanged for rigs that measure depth."""
    if depths is None:
        return odometry
    return replace(odometry, keyframes=depths.keyframes_at(state.map_from_cams[:, 0]))


def _posed(odometry: OdometryPass, state: SurveyState) -> RigImages:
    return RigImages.of(odometry.keyframes, state.map_from_body, state.rig)
