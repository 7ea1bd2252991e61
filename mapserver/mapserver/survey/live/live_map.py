"""Map that grows keyframe by keyframe: local adjustment of the newest ones, loops behind the same gate as a build, pose graph.

It is what operators see while a survey drives. The finished map is made by a build of the whole recording, which matches again where
the loops put keyframes, and adjusts everything together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3, se3_inverse
from fleetmap.live_survey import LivePart
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import ImuSamples
from mapserver.survey.bundle.bundle_adjustment import RelativeTerm, optimize
from mapserver.survey.bundle.bundle_rounds import KeyframeMotion, SurveyState, apply_result, bundle_problem
from mapserver.survey.keyframes.connected_components import MIN_SHARED, SigmaBetween, bridges
from mapserver.survey.keyframes.keyframes import Keyframe, PosedKeyframes, make_keyframe, without_pictures
from mapserver.survey.loops.loops import LoopCloser, LoopVerdict, body_edge
from mapserver.survey.loops.parts import Parts
from mapserver.survey.pose_graph.graph_marginals import GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge, adjoint, optimize_pose_graph
from mapserver.survey.survey_inputs import SurveyConfig
from mapserver.survey.tracks.matching import PairFinder
from mapserver.survey.tracks.pairs import PairMatch
from mapserver.survey.tracks.tracks import build_landmarks, tracks_of

_WINDOW = 10  # keyframes that move while the chain grows: what the newest one shares points with
_HELD = 2  # of the window's oldest, to which the others are tied
_MIN_OBSERVATIONS = 30  # below which odometry alone places a keyframe
_ROTATION_SIGMA_RAD = 0.02
_LOST = 100.0  # times the variance of what pictures say, from which on odometry has lost a frame that they have not
_WIDE = 25.0  # factor on odometry's covariance where it only decides what pictures leave open


@dataclass(frozen=True, slots=True)
class LiveRig:
    """What saw the survey: the rectified camera, its place on the body, the IMU's noise (None without one) and its clock."""

    camera: StereoCamera
    body_from_cam: Array
    imu_noise: ImuNoise | None = None
    imu_minus_cam_s: float = 0.0
    is_depth_camera: bool = False


@dataclass(frozen=True, slots=True)
class NewKeyframe:
    """A frame that the odometry chose.

    frame_from_body (4, 4) in odometry's continuous frame; level_from_frame (3, 3) turns that upright as gravity is known now.
    step_cov (6, 6): of the motion since the keyframe before, axes of that one, rotation first; None for the first. velocity_body_mps
    and biases (3,); imu: samples since the keyframe before. variance_m2: of the odometry's position, summed over the axes.
    """

    number: int
    frame_from_body: Array
    level_from_frame: Array
    step_cov: Array | None
    velocity_body_mps: Array
    gyro_bias_radps: Array
    accel_bias_mps2: Array
    inertial: bool = False
    imu: ImuSamples = field(default_factory=ImuSamples.empty)
    variance_m2: float = 0.0


@dataclass(frozen=True, slots=True)
class LiveLoops:
    """Loops so far: ends (L, 2) of those that are believed, keyframe numbers; how many candidates were refused and for which reason."""

    believed: NDArray[np.int64]
    refused: dict[str, int]


class LiveParts(NamedTuple):
    """Parts of a survey that lost itself: labels (K,) number them in the order of time, -1 for keyframes that saw too little.

    Only one can be the map, that with most keyframes: those that stay apart when the survey is over are left out.
    """

    labels: NDArray[np.int64]
    spans: list[LivePart]


class LiveMap:
    """Takes every keyframe in turn; what it makes of them depends on nothing else."""

    def __init__(self, options: SurveyConfig, rig: LiveRig) -> None:
        """rig: a stereo or depth camera; one camera alone knows no depths before its survey is over."""
        self._options, self._settings, self._rig = options, options.settings, rig
        self._keyframes: list[Keyframe] = []
        self._news: list[NewKeyframe] = []
        self._chain_from_body: list[Array] = []  # adjusted in windows, moved by no loop
        self._walked_m2: list[float] = [0.0]
        self._pairs: list[PairMatch] = []
        self._points_body: list[Array] = []  # of the landmarks whose reference each keyframe is
        self._step_covs: list[Array] = []
        self._chain: list[PoseEdge] = []
        self._loops: list[PoseEdge] = []
        self._believed: list[PoseEdge] = []
        self._map_from_body = np.zeros((0, 4, 4))
        self._closer: LoopCloser | None = None
        self._level = np.eye(3)
        self._seeing = np.zeros(0, bool)
        self._parts = Parts()  # by what keyframes share with their neighbours, and by odometry
        self._joined = Parts()  # by loops as well, as the loop closer has it

    def __len__(self) -> int:
        return len(self._keyframes)

    @property
    def map_from_body(self) -> Array:
        """(K, 4, 4) of the keyframes as loops place them, upright."""
        return np.asarray(se3(self._level, np.zeros(3)) @ self._map_from_body)

    def points_map(self) -> Array:
        """(N, 3) landmarks, each carried by the keyframe from which it was seen first."""
        placed = self.map_from_body
        parts = [p @ t[:3, :3].T + t[:3, 3] for p, t in zip(self._points_body, placed, strict=True)]
        return np.concatenate([np.zeros((0, 3)), *parts])

    def loops(self) -> LiveLoops:
        """What became of revisits."""
        refused: dict[str, int] = {}
        for record in [] if self._closer is None else self._closer.loops.records:
            if record.verdict is not LoopVerdict.ACCEPTED:
                refused[record.verdict.value] = refused.get(record.verdict.value, 0) + 1 + len(record.also)
        contradicted = len(self._loops) - len(self._believed)
        if contradicted:
            refused[LoopVerdict.REJECTED.value] = refused.get(LoopVerdict.REJECTED.value, 0) + contradicted
        ends = np.array([(edge.i, edge.j) for edge in self._believed], np.int64).reshape(-1, 2)
        return LiveLoops(ends, refused)

    def parts(self) -> LiveParts:
        """What belongs together: by neighbours, by odometry, and by the loops that are believed."""
        whole = Parts(enumerate(self._parts.labels().tolist()), len(self))
        for edge in self._believed:
            whole.join(edge.i, edge.j)
        firsts = whole.labels()
        seen = [p for p in np.unique(firsts[self._seeing]).tolist() if np.sum(firsts == p) > 1]
        labels = np.full(len(self), -1, np.int64)
        for number, part in enumerate(seen):
            labels[firsts == part] = number
        members = [np.flatnonzero(labels == number) for number in range(len(seen))]
        largest = int(np.argmax([self._seeing[m].sum() for m in members])) if members else 0
        spans = [
            LivePart(
                start_s=self._seconds(m[0]), end_s=self._seconds(m[-1]), keyframes=len(m), is_map=number == largest
            )
            for number, m in enumerate(members)
        ]
        return LiveParts(labels, spans)

    def _seconds(self, k: int) -> float:
        return round((self._keyframes[k].stamp_ns - self._keyframes[0].stamp_ns) * 1e-9, 3)

    def add(self, frame: RectifiedFrame, new: NewKeyframe) -> None:
        """One more keyframe: matched with its neighbours, adjusted with them, and compared with all that came before."""
        keyframe = make_keyframe(frame, new.number, self._rig.camera, self._settings)
        self._keyframes.append(keyframe)
        if len(self._keyframes) > _WINDOW:
            self._keyframes[-_WINDOW - 1] = without_pictures(self._keyframes[-_WINDOW - 1])
        self._news.append(new)
        self._level = new.level_from_frame
        self._points_body.append(np.zeros((0, 3)))
        self._seeing = np.append(self._seeing, False)
        for parts in (self._parts, self._joined):
            parts.grow(len(self))
        if len(self._keyframes) == 1:
            self._chain_from_body.append(new.frame_from_body)
            self._map_from_body = new.frame_from_body[None].copy()
            return
        before = self._news[-2]
        motion = se3_inverse(before.frame_from_body) @ new.frame_from_body
        assert new.step_cov is not None
        self._walked_m2.append(self._walked_m2[-1] + float(np.trace(new.step_cov[3:, 3:])))
        self._chain_from_body.append(self._chain_from_body[-1] @ motion)
        first = max(0, len(self._keyframes) - _WINDOW)
        found = self._matched(first)
        self._pairs = [pair for pair in self._pairs if pair.i >= first] + found
        self._step_covs.append(self._step_cov(new.step_cov, found))
        self._adjust(first)
        self._follow(first)
        self._connect(first)
        self._close()

    def _matched(self, first: int) -> list[PairMatch]:
        """The newest keyframe with those of the window that see the same."""
        window, newest = self._keyframes[first:], len(self._keyframes) - 1
        settings, rig = self._settings.pairs, self._rig
        finder = PairFinder(window, rig.camera, rig.body_from_cam, settings)
        chain_from_body = np.array(self._chain_from_body[first:])
        wanted = [p for p in finder.candidates(chain_from_body, previous=settings.previous) if p[1] == newest - first]

        def allowed_m(i: int, j: int) -> float:
            gained = self._walked_m2[first + j] - self._walked_m2[first + i]
            floor = 0.05 + 0.03 * float(np.linalg.norm(chain_from_body[j, :3, 3] - chain_from_body[i, :3, 3]))
            return 3.0 * float(np.sqrt(gained + floor**2))

        sigma = _ROTATION_SIGMA_RAD if self._news[-1].inertial else None
        found = finder.match(
            wanted, chain_from_body, allowed_m, rotation_sigma_rad=sigma, progress=lambda _number: None
        )
        return [replace(pair, i=pair.i + first, j=pair.j + first) for pair in found]

    def _step_cov(self, by_odometry: Array, found: Sequence[PairMatch]) -> Array:
        """(6, 6) of the step to the newest keyframe: a frame that odometry lost may be tied to the one before by what both see."""
        for pair in found:
            if pair.i == pair.j - 1:
                edge = body_edge(pair, self._rig.body_from_cam)
                carry = adjoint(se3_inverse(edge.i_from_j))  # from the axes of the newest to those of the one before
                tied = carry @ edge.cov_rot_trans @ carry.T
                if np.trace(by_odometry[:3, :3]) > _LOST * np.trace(tied[:3, :3]):
                    return np.asarray(tied)
        return by_odometry

    def _adjust(self, first: int) -> None:
        """The window's keyframes by their common points and the motion between them; its oldest ones stay."""
        state = self._state(first)
        if len(state.landmarks.obs_keyframe) < _MIN_OBSERVATIONS:
            return
        held = min(_HELD, len(state.stamps_ns) - 1) if first else 1
        free = np.arange(len(state.stamps_ns)) >= held
        result = optimize(bundle_problem(state, self._settings, free), self._settings.rough_bundle)
        keep = result.squared_sigmas < self._settings.noise.cut_sigmas**2
        state = apply_result(state, result)
        level_from_body = state.map_from_body
        chain_from_level = se3(self._level.T, np.zeros(3))
        for n in np.flatnonzero(free).tolist():
            k, motion = first + n, state.motion
            self._chain_from_body[k] = chain_from_level @ level_from_body[n]
            self._news[k] = replace(
                self._news[k],
                velocity_body_mps=level_from_body[n, :3, :3].T @ motion.velocities_mps[n],
                gyro_bias_radps=motion.gyro_bias_radps[n],
                accel_bias_mps2=motion.accel_bias_mps2[n],
            )
        self._keep_points(first, state, keep)

    def _keep_points(self, first: int, state: SurveyState, keep: NDArray[np.bool_]) -> None:
        """Landmarks that enough keyframes of the window agree on, in the axes of the keyframe that saw each first."""
        marks = state.landmarks
        reference = marks.obs_keyframe[np.unique(marks.obs_landmark, return_index=True)[1]]
        seen = np.bincount(marks.obs_landmark[keep], minlength=len(marks.points_map))
        lasting = seen >= self._settings.min_observations
        for n in np.unique(reference).tolist():
            own = marks.points_map[lasting & (reference == n)]
            map_from_body = state.map_from_body[n]
            self._points_body[first + n] = (own - map_from_body[:3, 3]) @ map_from_body[:3, :3]

    def _state(self, first: int) -> SurveyState:
        """The window as an adjustment takes it, upright."""
        rig, news = self._rig, self._news[first:]
        level_from_body = se3(self._level, np.zeros(3)) @ np.array(self._chain_from_body[first:])
        inertial = rig.imu_noise is not None and all(new.inertial for new in news)
        velocities = np.array([new.velocity_body_mps for new in news])
        motion = KeyframeMotion(
            inertial=inertial,
            imu=joined_imu([new.imu for new in news]),
            noise=rig.imu_noise,
            imu_minus_cam_s=rig.imu_minus_cam_s,
            velocities_mps=np.einsum("kij,kj->ki", level_from_body[:, :3, :3], velocities),
            gyro_bias_radps=np.array([new.gyro_bias_radps for new in news]),
            accel_bias_mps2=np.array([new.accel_bias_mps2 for new in news]),
            relative=[] if inertial else self._relative(first),
        )
        posed = PosedKeyframes(self._keyframes[first:], level_from_body, rig.body_from_cam, rig.camera)
        pairs = [replace(pair, i=pair.i - first, j=pair.j - first) for pair in self._pairs]
        return SurveyState(
            stamps_ns=np.array([keyframe.stamp_ns for keyframe in posed.keyframes], np.int64),
            map_from_body=level_from_body,
            body_from_cam=rig.body_from_cam,
            camera=rig.camera,
            motion=motion,
            landmarks=build_landmarks(posed, tracks_of(pairs), self._settings),
            is_depth_camera=rig.is_depth_camera,
        )

    def _relative(self, first: int) -> list[RelativeTerm]:
        """Odometry between the window's neighbours, weakly."""
        terms = []
        for n, (a, b) in enumerate(zip(self._news[first:-1], self._news[first + 1 :], strict=True)):
            assert b.step_cov is not None
            i_from_j = se3_inverse(a.frame_from_body) @ b.frame_from_body
            terms.append(RelativeTerm(n, n + 1, i_from_j, np.linalg.inv(_WIDE * b.step_cov).astype(np.float64)))
        return terms

    def _follow(self, first: int) -> None:
        """The chain's edges and the map's poses of the window as they are adjusted now."""
        start = max(first - 1, 0)
        del self._chain[start:]
        for k in range(start, len(self._keyframes) - 1):
            i_from_j = se3_inverse(self._chain_from_body[k]) @ self._chain_from_body[k + 1]
            self._chain.append(PoseEdge(k, k + 1, i_from_j, self._step_covs[k], is_loop=False))
        placed = list(self._map_from_body[: start + 1])
        for edge in self._chain[start:]:
            placed.append(placed[-1] @ edge.i_from_j)
        self._map_from_body = np.array(placed)

    def _connect(self, first: int) -> None:
        """Which part the newest keyframes belong to, by the same rule as a build's."""
        joins: list[tuple[int, int]] = []
        for pair in self._pairs:
            self._seeing[[pair.i, pair.j]] = True
            if len(pair.features) >= MIN_SHARED:
                joins.append((pair.i, pair.j))
        before = np.flatnonzero(self._seeing[:first])
        sigmas_m = SigmaBetween(np.array([new.variance_m2 for new in self._news]))
        since = int(before[-1]) if len(before) else 0
        joins += bridges(self._seeing, sigmas_m, self._settings.join_sigma_m, since)
        for a, b in joins:
            self._parts.join(a, b)
            self._joined.join(a, b)

    def _close(self) -> None:
        """Looks for revisits of the newest keyframe; with one more loop the pose graph places all keyframes anew."""
        newest, rig = len(self._keyframes) - 1, self._rig
        posed = PosedKeyframes(self._keyframes, self._map_from_body, rig.body_from_cam, rig.camera)
        matched = [(pair.i, pair.j) for pair in self._pairs if pair.j == newest]
        learned = [] if self._closer is None else self._closer.learned
        marginals = GraphMarginals(self._map_from_body, [*self._chain, *learned])
        if self._closer is None:
            self._closer = LoopCloser(posed, self._options, marginals, set(matched), parts=self._joined)
            self._closer.close(0)
        else:
            self._closer.grow(posed, marginals, matched)
        self._closer.close(newest)
        edges = self._closer.loops.edges
        if len(edges) > len(self._loops):
            self._loops = list(edges)
            solved = optimize_pose_graph(self._closer.begin, [*self._chain, *edges])
            self._map_from_body = solved.map_from_body
            self._believed = [e for e, w in zip(edges, solved.loop_weights, strict=True) if w >= 0.5]


def joined_imu(parts: Sequence[ImuSamples]) -> ImuSamples:
    """Samples of parts that follow each other."""
    return ImuSamples(
        np.concatenate([part.stamps_ns for part in parts]),
        np.concatenate([part.gyro_radps for part in parts]),
        np.concatenate([part.accel_mps2 for part in parts]),
    )
