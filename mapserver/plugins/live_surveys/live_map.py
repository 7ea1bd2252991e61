"""Map that grows keyframe by keyframe: local adjustment of the newest ones, loops with the same gate as in a build, pose graph.

Operators see it during a survey. The finished map is made by a build of the whole recording, which matches again at the
poses after loop closure, and adjusts everything together.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fleetmap import geometry
from fleetmap.geometry import Array, Indices, Mask, se3, se3_adjoint, se3_inverse, transport_cov, turned_cov
from fleetmap.messages import Cause, EstimateMessage, Placement, Status, covariance_entries
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from mapserver.plugins.live_surveys import message
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.bundle_rounds import apply_result, bundle_problem
from mapserver.survey.bundle.problem import MotionPrior
from mapserver.survey.keyframes.keyframes import make_keyframe
from mapserver.survey.loops.connected_components import MIN_SHARED, bridges, grown_sigma
from mapserver.survey.loops.keyframe_groups import KeyframeGroups
from mapserver.survey.loops.loops import LoopCloser, LoopRecord, Loops, LoopVerdict, body_edge
from mapserver.survey.pose_graph.graph_marginals import GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge, optimize_pose_graph
from mapserver.survey.pose_graph.sim3_pose_graph import gate_covariances, solve_scaled
from mapserver.survey.rig import rig_of
from mapserver.survey.state import Keyframe, KeyframeMotion, RelativeTerm, RigImages, SurveyState, turned
from mapserver.survey.survey_inputs import SurveyConfig
from mapserver.survey.tracks.matching import PairFinder, drift_allowance_m
from mapserver.survey.tracks.mono_depths import MonoDepths
from mapserver.survey.tracks.pairs import PairMatch
from mapserver.survey.tracks.tracks import build_landmarks, tracks_of

_WINDOW = 10  # keyframes adjusted with the newest one, with which it shares points
_HELD = 2  # the window's oldest, which are fixed
_MIN_OBSERVATIONS = 30  # below, a keyframe is located by odometry alone
_ROTATION_SIGMA_RAD = 0.02
_LOST = 100.0  # ratio to the images' variance, above which odometry counts as lost
_NEWEST = 12
_BELONGING = 2  # least keyframes of a map
_ADJUST_EVERY_S = 0.4  # keyframes at shorter intervals are adjusted with the next one
_WIDE = 25.0  # factor on odometry's covariance where it only determines what pictures cannot


class LiveMap:
    """Processes every keyframe in order; the result depends on nothing else."""

    def __init__(self, options: SurveyConfig, rectifier: Rectifier) -> None:
        """rectifier: of a single camera, features get their depths from the keyframes of the window."""
        self._options, self._settings, self._rectifier = options, options.settings, rectifier
        self._mounted = rig_of(rectifier).first
        self._scale_known = rectifier.camera.baseline_m > 0 or rectifier.calibration.imu is not None
        self._depths = None
        if rectifier.camera.baseline_m == 0:
            self._depths = MonoDepths([], self._mounted.camera, options.settings)
        self._keyframes: list[Keyframe] = []
        self._news: list[message.NewKeyframe] = []
        self._chain_from_body: list[Array] = []  # adjusted in windows, not moved by loops
        self._walked_m2: list[float] = [0.0]
        self._pairs: list[PairMatch] = []
        self._points_body: list[Array] = []  # landmarks by their reference keyframe
        self._step_covs: list[Array] = []
        self._chain: list[PoseEdge] = []
        self._loop_weights = np.zeros(0)  # 1 accepted, 0 not
        self._map_from_body = np.zeros((0, 4, 4))
        self._closer: LoopCloser | None = None
        self._marginals: GraphMarginals | None = None
        self._level = np.eye(3)
        self._adjusted_ns = 0
        self._seeing = np.zeros(0, bool)
        self._parts = KeyframeGroups()  # by points shared with neighbours, and by odometry
        self._joined = KeyframeGroups()  # also by loops, as in the loop closer

    def __len__(self) -> int:
        return len(self._keyframes)

    @property
    def map_from_body(self) -> Array:
        """(K, 4, 4) of the keyframes after loop closure, upright."""
        return np.asarray(se3(self._level, np.zeros(3)) @ self._map_from_body)

    def points_map(self) -> Array:
        """(N, 3) landmarks, each moved with the keyframe that saw it first."""
        parts = [p @ t[:3, :3].T + t[:3, 3] for p, t in zip(self._points_body, self.map_from_body, strict=True)]
        return np.concatenate([np.zeros((0, 3)), *parts])

    def sketch(self, cells: Array, missing: list[message.LiveMissing]) -> message.MapSketch:
        """Return the displayed data of the map; no array exceeds the limit of a message. cells, missing: of the drive, as in it."""
        found, refused, best = self._loops(), Counter[str](), dict[int, LoopRecord]()
        for record in found.records:
            if record.verdict is not LoopVerdict.ACCEPTED:
                refused[record.verdict.value] += 1 + len(record.also)
            if record.inliers > (best[record.i].inliers if record.i in best else 0):
                best[record.i] = record
        newest = [
            message.LiveRevisit(
                at_s=self._seconds(r.i),
                seen_s=self._seconds(r.j),
                verdict=r.verdict.value,
                words=r.reason[:200],
                matches=r.inliers,
            )
            for _, r in sorted(best.items())[-_NEWEST:]
        ]
        accepted = [(r.i, r.j) for r in found.records if r.verdict is LoopVerdict.ACCEPTED]
        places_m, (labels, spans) = self.map_from_body[:, :2, 3], self.parts()
        numbers = np.where((labels < 0) | (labels >= message.NO_PART), message.NO_PART, labels).astype(np.uint8)
        return message.MapSketch(
            keyframes=len(self),
            path_m=message.packed(places_m),
            part=numbers[message.thinning(len(numbers), message.MOST_PLACES)].tobytes(),
            parts=spans[: message.NO_PART],
            landmarks_m=message.packed(self.points_map()[:, :2]),
            loops_m=message.packed(places_m[np.array(accepted, np.int64).reshape(-1, 2)].reshape(-1, 4)),
            loops=len(accepted),
            refused=dict(refused),
            revisits=newest,
            cells=message.packed(cells),
            missing=missing,
            estimate=self._estimate(labels, spans),
        )

    def _loops(self) -> Loops:
        """All candidates so far, and the loops accepted by the pose graph."""
        return Loops() if self._closer is None else self._closer.loops.without_outliers(self._loop_weights)

    def parts(self) -> tuple[Indices, list[message.LivePart]]:
        """Return the parts that tracking, odometry and accepted loops connect: labels (K,) number them by time, -1 for keyframes that saw
        too little. Only the one with the most keyframes can be the map: parts still separate at the end are left out.
        """
        whole = KeyframeGroups(enumerate(self._parts.labels().tolist()), len(self))
        for edge in self._loops().edges:
            whole.join(edge.i, edge.j)
        firsts = whole.labels()
        members = [np.flatnonzero(firsts == part) for part in np.unique(firsts[self._seeing])]
        members = [part for part in members if len(part) > 1]
        labels = np.full(len(self), -1, np.int64)
        for number, part in enumerate(members):
            labels[part] = number
        largest = int(np.argmax([self._seeing[m].sum() for m in members])) if members else 0
        spans = [
            message.LivePart(
                start_s=self._seconds(m[0]), end_s=self._seconds(m[-1]), keyframes=len(m), is_map=number == largest
            )
            for number, m in enumerate(members)
        ]
        return labels, spans

    def _estimate(self, labels: Indices, spans: list[message.LivePart]) -> EstimateMessage | None:
        """Return the pose of the base at the newest keyframe in the growing map, relative to its first one, in the robots' form with
        odometry's continuous frame as `odom`; LOST while in another part. None for a single keyframe."""
        newest, placed, cov = len(self) - 1, None, None
        if len(self) < _BELONGING:
            return None
        label = int(labels[newest])
        span = spans[label] if label >= 0 else None
        body_from_base = se3_inverse(self._rectifier.calibration.base_from_body)
        odom_from_body = self._news[newest].frame_from_body
        if span is not None and not span.is_map:
            status = Status.LOST, Cause.NO_MATCH
        elif not spans:
            status = Status.INITIALISING, Cause.NONE
        else:
            is_sure = span is not None and bool(self._seeing[newest])
            status = (Status.TRACKING, Cause.NONE) if is_sure else (Status.DEGRADED, Cause.ODOMETRY)
            kept = next(n for n, each in enumerate(spans) if each.is_map)
            first, placed = int(np.flatnonzero(labels == kept)[0]), self.map_from_body[newest]
            cov = np.zeros((6, 6))
            if self._marginals is not None and first != newest:
                cov = turned_cov(self._marginals.relative_cov(newest, first), placed[:3, :3])
            cov = transport_cov(cov, placed[:3, :3] @ body_from_base[:3, 3])
        return EstimateMessage(
            stamp_ns=self._keyframes[newest].stamp_ns,
            status=status[0].value,
            cause=status[1].value,
            map_version=None,
            odom_from_base=Placement.of(odom_from_body @ body_from_base),
            map_from_odom=None if placed is None else Placement.of(placed @ se3_inverse(odom_from_body)),
            cov_rot_trans=None if cov is None else covariance_entries(cov),
        )

    def _seconds(self, k: int) -> float:
        return round((self._keyframes[k].stamp_ns - self._keyframes[0].stamp_ns) * 1e-9, 3)

    def add(self, frame: RectifiedFrame, new: message.NewKeyframe) -> None:
        """Add one more keyframe: match and adjust it with its neighbours, and compare it with all earlier ones."""
        keyframe = make_keyframe(frame, new.number, self._rectifier.camera, self._settings)
        self._keyframes.append(keyframe)
        if len(self._keyframes) > _WINDOW:
            self._keyframes[-_WINDOW - 1] = self._keyframes[-_WINDOW - 1].without_pictures()
            if self._depths is not None:
                self._depths.release(len(self._keyframes) - _WINDOW - 1)
        self._news.append(new)
        self._points_body.append(np.zeros((0, 3)))
        self._seeing = np.append(self._seeing, False)
        for parts in (self._parts, self._joined):
            parts.grow(len(self))
        if len(self._keyframes) == 1:
            self._chain_from_body.append(new.frame_from_body)
            self._level = self._upright()
            self._map_from_body = new.frame_from_body[None].copy()
            return
        motion = se3_inverse(self._news[-2].frame_from_body) @ new.frame_from_body
        assert new.step_cov is not None
        self._walked_m2.append(self._walked_m2[-1] + float(np.trace(new.step_cov[3:, 3:])))
        self._chain_from_body.append(self._chain_from_body[-1] @ motion)
        self._level = self._upright()
        first = max(0, len(self._keyframes) - _WINDOW)
        self._place_features(first)
        found = self._matched(first)
        self._pairs = [pair for pair in self._pairs if pair.i >= first] + found
        self._step_covs.append(self._step_cov(new.step_cov, found))
        if first == 0 or keyframe.stamp_ns - self._adjusted_ns >= _ADJUST_EVERY_S * 1e9:
            self._adjusted_ns = keyframe.stamp_ns
            self._adjust(first)
            self._place_features(first)
        self._follow(first)
        self._connect(first)
        self._close()

    def _upright(self) -> Array:
        """Return (3, 3) rotation of the chain that makes the newest keyframe upright by odometry: windows have rotated the chain."""
        new, up = self._news[-1], np.array([0.0, 0.0, 1.0])
        up_body = (new.level_from_frame @ new.frame_from_body[:3, :3]).T @ up
        return geometry.rotation_between_vectors(self._chain_from_body[-1][:3, :3] @ up_body, up)

    def _matched(self, first: int) -> list[PairMatch]:
        """Match the newest keyframe with those of the window that see the same."""
        window, newest = self._keyframes[first:], len(self._keyframes) - 1
        settings, chain_from_body = self._settings.pairs, np.array(self._chain_from_body[first:])
        finder = PairFinder(RigImages.of(window, chain_from_body, self._mounted), settings)
        wanted = [pair for pair in finder.candidates() if pair[1] == newest - first]

        allowed_m = drift_allowance_m(np.array(self._walked_m2[first:]), chain_from_body[:, :3, 3])
        sigma = _ROTATION_SIGMA_RAD if self._news[-1].inertial else None
        found = finder.match(wanted, allowed_m, sigma)
        return [replace(pair, i=pair.i + first, j=pair.j + first) for pair in found]

    def _place_features(self, first: int) -> None:
        """Compute depths of one camera's features, from the present poses of the window's keyframes."""
        if self._depths is not None:
            self._depths.grow(self._keyframes)
            placed = np.array(self._chain_from_body) @ self._rectifier.body_from_cam
            self._keyframes[first:] = self._depths.keyframes_at(placed, first)

    def _step_cov(self, by_odometry: Array, found: Sequence[PairMatch]) -> Array:
        """Return (6, 6) of the step to the newest keyframe: common images may connect a frame lost by odometry to the previous one."""
        for pair in found:
            if pair.i == pair.j - 1:
                edge = body_edge(pair, self._rectifier.body_from_cam)
                # From the axes of the newest to those of the one before
                carry = se3_adjoint(se3_inverse(edge.i_from_j))
                tied = carry @ edge.cov_rot_trans @ carry.T
                if np.trace(by_odometry[:3, :3]) > _LOST * np.trace(tied[:3, :3]):
                    return np.asarray(tied)
        return by_odometry

    def _adjust(self, first: int) -> None:
        """Adjust the window's keyframes by their common points and the motion between them; its oldest ones are fixed."""
        state = self._state(first)
        if len(state.landmarks.obs_keyframe) < _MIN_OBSERVATIONS:
            return
        held = min(_HELD, len(state.stamps_ns) - 1) if first else 1
        free = np.arange(len(state.stamps_ns)) >= held
        # With an IMU only the position of the chain's start is fixed: with the initial tilt, speed and accelerometer bias of
        # odometry fixed too, the scale of one camera would absorb their errors.
        is_open = first == 0 and state.motion.inertial
        free |= is_open
        problem = bundle_problem(state, self._settings, None if is_open else free)
        if is_open and problem.inertial is not None:  # one second cannot show the bias
            sigma = np.full(9, np.inf)
            sigma[6:] = self._settings.odometry.filter.initial_accel_bias_sigma_mps2
            problem.inertial.priors.append(MotionPrior(0, np.zeros(9), sigma))
        result = optimize(problem, self._settings.rough_bundle)
        keep = result.squared_sigmas < self._settings.noise.cut_sigmas**2
        state = apply_result(state, result)
        level_from_body = state.map_from_body
        chain_from_level = se3(self._level.T, np.zeros(3))
        motions_body = turned(state.motion.motions, level_from_body[:, :3, :3].transpose(0, 2, 1))
        for n in np.flatnonzero(free).tolist():
            self._chain_from_body[first + n] = chain_from_level @ level_from_body[n]
            self._news[first + n] = self._news[first + n]._replace(motion_body=motions_body[n])
        self._keep_points(first, state, keep)

    def _keep_points(self, first: int, state: SurveyState, keep: Mask) -> None:
        """Keep landmarks on which enough keyframes of the window agree, in the axes of the keyframe that saw each first."""
        marks = state.landmarks
        reference = marks.obs_keyframe[np.unique(marks.obs_landmark, return_index=True)[1]]
        seen = np.bincount(marks.obs_landmark[keep], minlength=len(marks.points_map))
        lasting = seen >= self._settings.min_observations
        for n in np.unique(reference).tolist():
            own = marks.points_map[lasting & (reference == n)]
            map_from_body = state.map_from_body[n]
            self._points_body[first + n] = (own - map_from_body[:3, 3]) @ map_from_body[:3, :3]

    def _state(self, first: int) -> SurveyState:
        """Return the window as the state of an adjustment, upright."""
        noise, news = self._rectifier.calibration.imu, self._news[first:]
        level_from_body = se3(self._level, np.zeros(3)) @ np.array(self._chain_from_body[first:])
        inertial = noise is not None and all(new.inertial for new in news)
        motions_body = np.array([new.motion_body for new in news])
        motion = KeyframeMotion(
            inertial=inertial,
            imu=message.joined_imu([new.imu for new in news]),
            noise=noise,
            imu_minus_cam_s=self._rectifier.imu_minus_cam_s,
            motions=turned(motions_body, level_from_body[:, :3, :3]),
            relative=[] if inertial else self._relative(first),
        )
        posed = RigImages.of(self._keyframes[first:], level_from_body, self._mounted)
        pairs = [replace(pair, i=pair.i - first, j=pair.j - first) for pair in self._pairs]
        return SurveyState(
            stamps_ns=np.array([keyframe.stamp_ns for keyframe in posed.images], np.int64),
            map_from_body=level_from_body,
            rig=self._mounted,
            motion=motion,
            landmarks=build_landmarks(posed, tracks_of(pairs), self._settings),
        )

    def _relative(self, first: int) -> list[RelativeTerm]:
        """Return weak odometry between the window's neighbours."""
        terms = []
        for n, (a, b) in enumerate(zip(self._news[first:-1], self._news[first + 1 :], strict=True)):
            assert b.step_cov is not None
            i_from_j = se3_inverse(a.frame_from_body) @ b.frame_from_body
            terms.append(RelativeTerm(n, n + 1, i_from_j, np.linalg.inv(_WIDE * b.step_cov).astype(np.float64)))
        return terms

    def _follow(self, first: int) -> None:
        """Update the chain's edges and the map's poses of the window after adjustment."""
        start, chain = max(first - 1, 0), np.array(self._chain_from_body)
        del self._chain[start:]
        for k in range(start, len(chain) - 1):
            i_from_j = se3_inverse(chain[k]) @ chain[k + 1]
            self._chain.append(PoseEdge(k, k + 1, i_from_j, self._step_covs[k], is_loop=False))
        moved = self._map_from_body[start] @ se3_inverse(chain[start]) @ chain[start + 1 :]
        self._map_from_body = np.concatenate([self._map_from_body[: start + 1], moved])

    def _connect(self, first: int) -> None:
        """Assign the newest keyframes to parts, by the same rule as a build."""
        joins: list[tuple[int, int]] = []
        for pair in self._pairs:
            self._seeing[[pair.i, pair.j]] = True
            if len(pair.features) >= MIN_SHARED:
                joins.append((pair.i, pair.j))
        before = np.flatnonzero(self._seeing[:first])
        sigmas_m = grown_sigma(np.array([new.variance_m2 for new in self._news]))
        joins += bridges(self._seeing, sigmas_m, self._settings.join_sigma_m, int(before[-1]) if len(before) else 0)
        for a, b in joins:
            self._parts.join(a, b)
            self._joined.join(a, b)

    def _close(self) -> None:
        """Search revisits of the newest keyframe; with a new loop the pose graph updates all keyframes."""
        newest = len(self._keyframes) - 1
        posed = RigImages.of(self._keyframes, self._map_from_body, self._mounted)
        matched = [(pair.i, pair.j) for pair in self._pairs if pair.j == newest]
        learned = [] if self._closer is None else self._closer.learned
        scale_walk = self._settings.monocular.scale_walk
        known = self._chain if self._scale_known else gate_covariances(self._chain, scale_walk)
        marginals = GraphMarginals(self._map_from_body, [*known, *learned])
        self._marginals = marginals
        if self._closer is None:
            self._closer = LoopCloser(
                posed, self._options, marginals, matched, self._joined, measures_scale=not self._scale_known
            )
            self._closer.close(0)
        else:
            self._closer.grow(posed, marginals, matched)
        self._closer.close(newest)
        edges = self._closer.loops.edges
        if len(edges) == len(self._loop_weights):
            return
        if self._scale_known:
            solved = optimize_pose_graph(self._closer.begin, [*self._chain, *edges])
            self._map_from_body, self._loop_weights = solved.map_from_body, solved.loop_weights
        else:
            self._map_from_body, self._loop_weights = solve_scaled(
                self._closer.begin, self._chain, edges, self._closer.scales, scale_walk
            )
