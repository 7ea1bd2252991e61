"""Loop closure: candidates by bag of words, gated by position, verified by geometry and by their neighbours."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from fleetmap.bow.vocabulary import BowVector, PlaceIndex
from fleetmap.geometry import Array, Indices, Mask, se3_adjoint, se3_inverse, se3_log, transform_points
from fleetmap.relocalization.map_view import image_cells
from fleetmap.sensors.rectification import StereoCamera
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.loops.keyframe_groups import KeyframeGroups, Revisit, WaitingRevisits
from mapserver.survey.pose_graph.graph_marginals import CHI2_3_0999, GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge
from mapserver.survey.pose_graph.sim3_pose_graph import measured_log_scale
from mapserver.survey.rig import projection_by_point
from mapserver.survey.state import Keyframe, RigImages
from mapserver.survey.survey_inputs import SurveyConfig
from mapserver.survey.tracks.pairs import MatchInputs, PairMatch, PairTask, PredictedMotion, match_pair, match_task

# Matched points share calibration and depth errors: a pair's own covariance is too narrow by about this factor.
_CORRELATION = 3.0
_SIDES = 16  # directions of a possible repetition of the site
_ALIAS_SCORE = 0.7  # of a candidate's score, above which another place looks the same
# Of the view's reach, and of the gate, beyond which a match is certainly of another place
_ALIAS_REACH, _ALIAS_GATE = 0.5, 4.0
_WORTH_LEARNING = 1.0  # variance against the measurement's: below, a loop improves the gate by less than half
# At this accuracy no place can be mistaken for another: the gate need not improve further. Doubled with every so many learned
# loops, as their memory grows with the square; skipped loops leave the gate wider, and the next loop can still be learned.
_WELL_KNOWN = np.repeat([0.005, 0.05], 3)  # rad, m
_LEARNED_PER_DOUBLING = 64
_PLACE_M = 0.3  # between the places that two matches give one keyframe if both are right
_SAME_SHARE = 0.25  # of its length by which two equal steps may differ
_ENOUGH = 3  # keyframes that must see a step: one match may be wrong
CONTRADICTED = "contradicts the other loops in the pose graph"
_WAITING = "it would join two parts of the survey, and too few keyframes over a metre agree with it yet"
_FAR = "too far apart to see the same, given the accuracy of the relative pose"


class LoopVerdict(StrEnum):
    """Outcome of a candidate."""

    ACCEPTED = "accepted"
    GATED_OUT = "gated_out"
    REJECTED = "rejected"
    AMBIGUOUS = "ambiguous"


@dataclass(frozen=True, slots=True)
class LoopRecord:
    """One candidate and its outcome: keyframe i (new) against j (old); inliers and the reason as text.

    also: further old keyframes, less similar than j, refused for the same reason before a detailed comparison.
    """

    i: int
    j: int
    score: float
    verdict: LoopVerdict
    reason: str
    inliers: int = 0
    also: tuple[int, ...] = ()


@dataclass(frozen=True)
class Loops:
    """All candidates, and the edges (i_from_j of bodies) of the accepted ones that tell more than is known without them.

    doubted: keyframes whose motion to the next one no picture shows, and matches that agree with each other contradict.
    """

    records: list[LoopRecord] = field(default_factory=list)
    edges: list[PoseEdge] = field(default_factory=list)
    doubted: tuple[int, ...] = ()

    def counts(self) -> dict[str, int]:
        """Return candidates, gated_out, rejected, accepted; ambiguous ones count as rejected."""
        tally = {verdict: sum(1 + len(r.also) for r in self.records if r.verdict is verdict) for verdict in LoopVerdict}
        return {
            "candidates": sum(tally.values()),
            "gated_out": tally[LoopVerdict.GATED_OUT],
            "rejected": tally[LoopVerdict.REJECTED] + tally[LoopVerdict.AMBIGUOUS],
            "accepted": tally[LoopVerdict.ACCEPTED],
        }

    def without_outliers(self, weights: Array) -> "Loops":
        """Return the loops, rejecting those with a pose-graph weight below one half; one weight for each edge."""
        outliers = {(e.i, e.j) for e, weight in zip(self.edges, weights, strict=True) if weight < 0.5}
        records = list(self.records)
        for n, r in enumerate(records):
            if (r.i, r.j) in outliers and r.verdict is LoopVerdict.ACCEPTED:
                records[n] = replace(r, verdict=LoopVerdict.REJECTED, reason=CONTRADICTED)
        return replace(self, records=records, edges=[e for e in self.edges if (e.i, e.j) not in outliers])


class LoopCloser:
    """Searches a chain of keyframes for revisits: candidates pass a gate, are verified one by one and decided together.

    Each image is searched among those of all cameras. `marginals` narrows with every accepted loop. loops: the outcome so far. learned:
    loops used to narrow the gate. scales: if measured, the scale difference of each verified loop's keyframes: (log scale, sigma) by
    (new, old).
    """

    def __init__(
        self,
        posed: RigImages,
        config: SurveyConfig,
        marginals: GraphMarginals,
        matched: Iterable[tuple[int, int]],
        groups: KeyframeGroups,
        executor: Executor = SERIAL,
        pieces: KeyframeGroups | None = None,
        *,
        measures_scale: bool = False,
    ) -> None:
        """matched: pairs of keyframes matched as neighbours, which are not loops. groups: joined here by certain revisits. pieces:
        keyframes that pictures link; None if the motion between them is not to be doubted. Pairs, groups, marginals, records and edges
        have the numbers of keyframes, matches those of the images in `posed`.
        """
        self.loops, self.learned = Loops(), list[PoseEdge]()
        self.groups, self.scales = groups, dict[tuple[int, int], tuple[float, float]]()
        self._config, self._settings, self._executor = config, config.settings.loops, executor
        self._measures_scale = measures_scale
        self._waiting, self._repetition = WaitingRevisits(), Repetition()
        self._pieces, self._against = pieces or KeyframeGroups(), WaitingRevisits()
        self._breaks = list[tuple[int, int]]()  # keyframes, of the first and the last of which one must be
        self._neighbours: dict[int, list[int]] = {}
        self._vectors: list[BowVector] = []
        self._index = PlaceIndex(config.vocabulary.word_count)
        self._depths_m = np.zeros(0)
        self._bare: dict[int, Keyframe] = {}
        self._shared = MatchInputs({}, posed.rig.camera, config.settings.pairs)
        self._inputs = replace(self._shared, keyframes=self._bare)
        self.grow(posed, marginals, matched)

    def grow(self, posed: RigImages, marginals: GraphMarginals, matched: Iterable[tuple[int, int]]) -> None:
        """Extend the chain: all keyframes at their present poses, known ones first; `matched` adds to earlier pairs."""
        self._posed, self._map_from_body, self._marginals = posed, posed.map_from_body, marginals
        self._keyframe, self._camera = posed.keyframe, posed.camera
        vocabulary, new = self._config.vocabulary, posed.images[len(self._vectors) :]
        self._vectors += [vocabulary.bow_vector(vocabulary.words(k.features.descriptors)) for k in new]
        for i, j in sorted(matched):
            self._neighbours.setdefault(i, []).append(j)
            self._neighbours.setdefault(j, []).append(i)
        bare = [replace(k.without_pictures(), nodes=vocabulary.branches(k.features.descriptors)) for k in new]
        self._bare.update(enumerate(bare, len(self._bare)))
        added = posed.numbers[len(self._depths_m) :].tolist()
        depths_m = [max(posed.images[n].median_depth_m for n in row) for row in added]
        self._depths_m = np.append(self._depths_m, depths_m)

    @property
    def begin(self) -> Array:
        """Return (K, 4, 4) initial poses for a pose graph with the loops: unchanged, unless a loop has moved a group."""
        return self._marginals.linearised_at

    def close(self, i: int) -> None:
        """Search revisits of image i among the earlier ones, then add it to the index. Call in order."""
        keyframe = int(self._keyframe[i])
        numbers, gap = self._posed.numbers[:, self._camera[i]], self._settings.min_gap_keyframes
        if keyframe >= gap:
            ids = self._index.place_ids
            new = (ids <= numbers[keyframe - gap]) & ~np.isin(ids, numbers[self._neighbours.get(keyframe, [])])
            alike, scores = self._index.query(self._vectors[i], new, self._settings.depth)
            if len(alike):
                self._decide(self._verify(i, alike, scores, self._gate(keyframe, alike, scores)))
        self._index.add(i, self._vectors[i])

    def _gate(self, i: int, ids: Indices, scores: Array) -> list[int]:
        """Return numbers of at most `top` of the old images (C,) that may be seen from possible poses of keyframe i, the best first.

        With repeated aisles the most similar ones may all be in other aisles, so the gate goes down the list and records the refused
        ones. Further ones, out of reach of a keyframe that no picture links to theirs, may show that the motion between them is wrong.
        """
        bodies, top, here_m = self._keyframe[ids], self._settings.top, self._map_from_body[i, :3, 3]
        reach_m = self._settings.view_range_depths * np.maximum(self._depths_m[i], self._depths_m[bodies])
        covariances, places_m = self._marginals.relative_covs(i, bodies), self._map_from_body[bodies, :3, 3]
        reachable = self._marginals.reachable(i, bodies, reach_m, covariances)
        # In all directions at once
        known = np.linalg.eigvalsh(covariances / np.outer(_WELL_KNOWN, _WELL_KNOWN))[:, -1] < 1.0
        known &= np.linalg.norm(places_m - here_m, axis=1) < _ALIAS_REACH * reach_m
        unlinked = np.array([self._are_unlinked(i, j) for j in bodies.tolist()])
        beyond = np.flatnonzero(~reachable & unlinked)[:top].tolist()
        # A loop where the pose is known would add no information; the global adjustment matches what both see anyway.
        near = np.flatnonzero(reachable & (unlinked | ~known)).tolist()
        chosen = [n for n in near if self._config.zones.compatible(here_m, places_m[n])]
        far = sorted({*np.flatnonzero(~reachable).tolist()} - {*beyond})
        for refused, reason in ((far, _FAR), (sorted({*near} - {*chosen}), "in different zones")):
            if refused:
                first, *others = bodies[refused].tolist()
                fate = float(scores[refused[0]]), LoopVerdict.GATED_OUT, reason
                self.loops.records.append(LoopRecord(i, first, *fate, also=tuple(others)))
        return [*chosen[:top], *beyond]

    def _verify(self, i: int, ids: Indices, scores: Array, chosen: list[int]) -> list[tuple[PoseEdge, LoopRecord]]:
        """Return the chosen ones of old images (C,) that pass every single test, with their edges; record the others."""
        verified: list[tuple[PoseEdge, LoopRecord]] = []
        tasks = [PairTask.of([self._predict(i, int(ids[n]))], self._inputs) for n in chosen]
        matches = self._executor.map(match_task, self._shared, tasks)
        i, bodies = int(self._keyframe[i]), self._keyframe[ids]
        for n, (match,) in zip(chosen, matches, strict=True):
            j, score = int(bodies[n]), float(scores[n])
            others = np.array([edge.j for edge, _ in verified], np.int64)
            same = others[~self._are_apart(j, others)].tolist() if len(others) else []
            if len(same) >= self._settings.per_place:
                reason = f"its place is already closed with keyframe {same[0]}"
                self.loops.records.append(LoopRecord(i, j, score, LoopVerdict.REJECTED, reason))
                continue
            edge = None if match is None else self._edge(match)
            aliases = ids[scores >= _ALIAS_SCORE * score]
            verdict, reason = self._examined(match, edge, aliases)
            record = LoopRecord(i, j, score, verdict, reason, 0 if match is None else len(match.features))
            if edge is not None and verdict is LoopVerdict.ACCEPTED:
                verified.append((edge, record))
            else:
                self.loops.records.append(record)
        return verified

    def _examined(self, match: PairMatch | None, edge: PoseEdge | None, aliases: Indices) -> tuple[LoopVerdict, str]:
        """Return the verdict on one candidate alone, and its reason. aliases: old images as similar to the new one."""
        if match is None or edge is None:
            return LoopVerdict.REJECTED, "too few features agree on one motion"
        count, settings = len(match.features), self._settings
        pixels = self._posed.images[match.j].features.pixels[match.features[:, 1]]
        cells = len(np.unique(image_cells(pixels, self._posed.rig.camera)))
        if count < settings.min_inliers or cells < settings.min_cells:
            return LoopVerdict.REJECTED, f"{count} matches in {cells} of 48 cells are too few or too crowded"
        innovation = self._marginals.innovation_squared(edge)
        if innovation > settings.max_innovation:
            self._learn_repetition(edge, count, innovation)
            self._weigh_against(match, edge)
            reason = f"matches, but from an impossible position (innovation {innovation:.0f})"
            return LoopVerdict.GATED_OUT, reason
        supported = self._neighbours_agree(match)
        if supported is False or (supported is None and count < settings.alone_inliers):
            return LoopVerdict.REJECTED, "neighbouring keyframes do not confirm it"
        shift_m = self._unseen_alias(match, edge, aliases)
        if shift_m is not None:
            alike = f"places {shift_m:.2f} m apart look the same here"
            return LoopVerdict.AMBIGUOUS, f"{alike}, and another such step is equally possible"
        return LoopVerdict.ACCEPTED, "verified"

    def _decide(self, verified: list[tuple[PoseEdge, LoopRecord]]) -> None:
        """Accept the remaining candidates, or none if they exclude each other."""
        places = [self._map_from_body[e.j] @ se3_inverse(e.i_from_j) for e, _ in verified]
        spread = max((float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a in places for b in places), default=0.0)
        js = np.array([edge.j for edge, _ in verified], np.int64)
        between = [np.trace(self._marginals.relative_covs(j, js[js != j])[:, 3:, 3:], axis1=1, axis2=2) for j in js]
        tolerance = _PLACE_M + 3.0 * float(np.sqrt(max((traces.max(initial=0.0) for traces in between), default=0.0)))
        records = self.loops.records
        for edge, record in verified:
            if spread > tolerance:
                reason = f"candidates {spread:.2f} m apart exclude each other"
                records.append(replace(record, verdict=LoopVerdict.AMBIGUOUS, reason=reason))
            elif self._is_of_one_group(edge):
                records.append(record)
                self._accept(edge)
            else:
                revisit = Revisit(edge, len(records))
                records.append(replace(record, verdict=LoopVerdict.AMBIGUOUS, reason=_WAITING))
                for sure in self._waiting.add(revisit, self.groups, self._marginals):
                    accepted = replace(records[sure.record], verdict=LoopVerdict.ACCEPTED, reason="verified")
                    records[sure.record] = accepted
                    self.groups.join(sure.edge.i, sure.edge.j)
                    self._accept(sure.edge)

    def _are_unlinked(self, i: int, j: int) -> bool:
        """Return True for keyframes of two pieces: their relative pose is that of odometry which no picture confirms."""
        return bool(len(self._pieces)) and self._pieces.of(i) != self._pieces.of(j)

    def _weigh_against(self, match: PairMatch, edge: PoseEdge) -> None:
        """Count a match from an impossible position against the motion between two pieces, if neighbours confirm it.

        Those that agree with each other are a break of that motion, or of another place that looks the same: nobody can tell.
        """
        if not self._are_unlinked(edge.i, edge.j) or not self._neighbours_agree(match):
            return
        agreeing = self._against.add(Revisit(edge, 0), self._pieces, self._marginals)
        if agreeing:
            self._breaks.append((max(r.edge.j for r in agreeing), min(r.edge.i for r in agreeing)))

    def doubted(self) -> tuple[int, ...]:
        """Return `Loops.doubted`. A revisit on either side of a break, where the motion expects it, removes the doubt."""
        confirmed = [(r.j, r.i) for r in self.loops.records if r.verdict is LoopVerdict.ACCEPTED]
        return tuple(
            k
            for k in sorted({k for first, last in self._breaks for k in range(first, last)})
            if self._are_unlinked(k, k + 1) and not any(j <= k < i for j, i in confirmed)
        )

    def _accept(self, edge: PoseEdge) -> None:
        if self._marginals.gain(edge, np.diag(_WELL_KNOWN**2)) < _WORTH_LEARNING:
            return  # matches of far features in aisles are wrong by more than this, and many would add up
        self.loops.edges.append(edge)
        well_known = np.diag(_WELL_KNOWN**2) * 2.0 ** (self._marginals.learned / _LEARNED_PER_DOUBLING)
        if self._marginals.gain(edge, well_known) > _WORTH_LEARNING:
            self._marginals.add(edge)
            self.learned.append(edge)
            self._map_from_body = self._marginals.map_from_body

    def _are_apart(self, j: int, others: Indices) -> Mask:
        """Return (M,) True for old keyframes at other places than j: they cannot be seen from there."""
        reach_m = self._settings.view_range_depths * np.maximum(self._depths_m[j], self._depths_m[others])
        return np.asarray(~self._marginals.reachable(j, others, reach_m) & (others != j))

    def _unseen_alias(self, match: PairMatch, edge: PoseEdge, aliases: Indices) -> float | None:
        """Return the possible position error if the site repeats as seen or configured; None if no alias is possible.

        Aliases are similar to the new image; those count that are at other places than the old one and match the new one too, as if
        it were somewhere else. The offset to each of them is a step of repetition of the site, perhaps also to a place without
        keyframes so far: a first visit must not be taken for a return. So are the steps shown by aliases anywhere in the site.
        """
        learnt = self._repetition.steps_m if self._is_of_one_group(edge) else np.zeros((0, 3))
        steps = np.concatenate([learnt, _around(self._settings.repeats_every_m)])
        lengths_m = np.linalg.norm(steps[self._is_possible(edge, steps)], axis=1)
        if len(lengths_m):
            return float(lengths_m.min())
        bodies = self._keyframe[aliases]
        apart = self._are_apart(edge.j, bodies)
        ways = self._map_from_body[bodies[apart], :3, 3] - self._map_from_body[edge.j, :3, 3]
        possible = self._is_possible(edge, ways) | self._is_possible(edge, -ways)
        for alias, way in zip(aliases[apart][possible].tolist(), ways[possible], strict=True):
            other = match_pair(alias, match.j, self._inputs, self._predict(match.j, alias)[2])
            if other is not None and self._is_elsewhere(edge, self._edge(other)):
                return float(np.linalg.norm(way))
        return None

    def _is_possible(self, edge: PoseEdge, steps: Array) -> Mask:
        """Return (M,) True where the new keyframe may be a step (M, 3) beside the place that the edge gives it."""
        return np.asarray(self._marginals.innovations_squared_beside(edge, steps) <= self._settings.max_innovation)

    def _is_elsewhere(self, one: PoseEdge, other: PoseEdge) -> bool:
        """True if two edges to the same new keyframe put it at different places, given how well the old ones are known."""
        places = [self._map_from_body[e.j] @ se3_inverse(e.i_from_j) for e in (one, other)]
        between = float(np.trace(self._marginals.relative_cov(one.j, other.j)[3:, 3:]))
        return bool(np.linalg.norm(places[0][:3, 3] - places[1][:3, 3]) > _PLACE_M + 3.0 * np.sqrt(between))

    def _learn_repetition(self, edge: PoseEdge, count: int, innovation: float) -> None:
        """Learn a step of the site: a match from an impossible position is an alias, and its offset a step.

        Not if the graph may misjudge a true revisit: aliases are far apart by covisibility and by the graph. Both
        must have the same orientation: a site repeats by translations, not by rotations.
        """
        here = self._map_from_body[edge.i]
        step_m = (self._map_from_body[edge.j] @ se3_inverse(edge.i_from_j))[:3, 3] - here[:3, 3]
        reach_m = self._settings.view_range_depths * float(self._depths_m[[edge.i, edge.j]].max())
        is_far = (
            np.linalg.norm(step_m) > _ALIAS_REACH * reach_m and innovation > _ALIAS_GATE * self._settings.max_innovation
        )
        if not is_far or count < self._settings.alone_inliers or not self._is_of_one_group(edge):
            return
        off = se3_log(edge.i_from_j @ se3_inverse(self._map_from_body[edge.j]) @ here)
        cov = self._marginals.relative_cov(edge.i, edge.j) + edge.cov_rot_trans
        if off[:3] @ np.linalg.solve(cov[:3, :3], off[:3]) <= CHI2_3_0999:
            self._repetition.see(edge.i, step_m, float(np.trace(cov[3:, 3:])) / 3)

    def _is_of_one_group(self, edge: PoseEdge) -> bool:
        return self.groups.of(edge.i) == self.groups.of(edge.j)

    def _cam_from_cam(self, j: int, i: int) -> Array:
        """Return the motion (4, 4) between the cameras of two images."""
        cam_from_map = se3_inverse(self._mount(j)) @ se3_inverse(self._map_from_body[self._keyframe[j]])
        return np.asarray(cam_from_map @ self._map_from_body[self._keyframe[i]] @ self._mount(i))

    def _mount(self, n: int) -> Array:
        """Return body_from_cam (4, 4) of an image."""
        return np.asarray(self._posed.rig.body_from_cam[self._camera[n]])

    def _predict(self, i: int, j: int) -> tuple[int, int, PredictedMotion]:
        """Return the predicted motion to match j (as reference) with i; the graph's rotation is used if it is accurate enough."""
        between = self._marginals.relative_cov(int(self._keyframe[i]), int(self._keyframe[j]))
        sigma = float(np.sqrt(np.trace(between[:3, :3])))
        known = max(sigma, 0.02) if sigma < self._settings.rotation_sigma_limit_rad else None
        return j, i, PredictedMotion(self._cam_from_cam(i, j), known)

    def _edge(self, match: PairMatch) -> PoseEdge:
        if self._measures_scale:
            points_old = self._posed.images[match.i].points_cam[match.features[:, 0]]
            points_new = self._posed.images[match.j].points_cam[match.features[:, 1]]
            self.scales[match.j, match.i] = measured_log_scale(points_old, points_new, match.j_from_i)
        mount, old = self._mount(match.j), self._posed.images[match.i]
        edge = body_edge(match, mount, self._mount(match.i))
        edge = replace(edge, i=int(self._keyframe[edge.i]), j=int(self._keyframe[edge.j]))
        if old.from_views:
            return edge
        per_px = by_disparity(old.points_cam[match.features[:, 0]], match.j_from_i, self._posed.rig.camera)
        shared = self._config.settings.noise.disparity_sigma_px * se3_adjoint(mount) @ per_px
        return replace(edge, cov_rot_trans=edge.cov_rot_trans + np.outer(shared, shared))

    def _neighbours_agree(self, match: PairMatch) -> bool | None:
        """True if a covisible neighbour of the old keyframe, located by this match, matches too; None if none is visible."""
        i, j, keyframe, tried = match.j, match.i, int(self._keyframe[match.i]), 0
        beside = sorted(self._neighbours.get(keyframe, []), key=lambda k: abs(k - keyframe))[:4]
        for n in self._posed.numbers[beside, self._camera[j]].tolist():
            if n == i:
                continue
            predicted = match.j_from_i @ self._cam_from_cam(j, n)
            other = match_pair(n, i, self._inputs, PredictedMotion(predicted, is_known=True))
            if other is None:
                continue
            tried += 1
            off = se3_inverse(predicted) @ other.j_from_i
            if np.linalg.norm(off[:3, 3]) < 0.1 + 0.05 * self._depths_m[self._keyframe[i]]:
                return True
        return False if tried else None


class Repetition:
    """Steps of repetition learned from aliases of single places, in map axes.

    Aisles are identical at one distance. If the first two are distinguished, their offset is known; if the robot later
    knows its position only to about that offset, a view that fits an old aisle also fits a neighbouring one, even one never seen.
    """

    def __init__(self) -> None:
        self._means = np.zeros((0, 3))
        self._weights = np.zeros(0)
        self._seen_by: list[set[int]] = []

    def see(self, keyframe: int, step_m: Array, variance_m2: float) -> None:
        """Record that a keyframe resembles a place at step_m (3,) from its true one, known to variance_m2 along each axis."""
        weight = 1.0 / variance_m2
        # A repetition by a step implies one by its opposite.
        signs = np.where(self._means @ step_m < 0, -1.0, 1.0)
        away = np.linalg.norm(signs[:, None] * self._means - step_m, axis=1)
        if away.min(initial=np.inf) > _SAME_SHARE * np.linalg.norm(step_m):
            self._means = np.vstack([self._means, step_m])
            self._weights = np.append(self._weights, weight)
            self._seen_by.append({keyframe})
            return
        n = int(np.argmin(away))
        self._means[n] += weight / (self._weights[n] + weight) * (signs[n] * step_m - self._means[n])
        self._weights[n] += weight
        self._seen_by[n].add(keyframe)

    @property
    def steps_m(self) -> Array:
        """Return (M, 3) the steps seen by enough keyframes, and their opposites."""
        believed = self._means[[len(seen) >= _ENOUGH for seen in self._seen_by]]
        return np.concatenate([believed, -believed])


def body_edge(match: PairMatch, body_from_cam: Array, old_body_from_cam: Array | None = None) -> PoseEdge:
    """Return body i from body j as a loop; the match has camera i (its j) from camera j (its i), which may be mounted differently."""
    body_from_body = (
        body_from_cam @ match.j_from_i @ se3_inverse(body_from_cam if old_body_from_cam is None else old_body_from_cam)
    )
    carry = se3_adjoint(body_from_cam)
    covariance = _CORRELATION**2 * carry @ match.cov_rot_trans @ carry.T + np.diag([1e-6] * 3 + [1e-5] * 3)
    return PoseEdge(match.j, match.i, body_from_body, covariance, is_loop=True)


def by_disparity(points_cam: Array, new_from_old: Array, camera: StereoCamera) -> Array:
    """Return (6,) how an error of all disparities by one pixel moves a match, new_from_old (4, 4), of points (N, 3) in the old camera.

    At depth edges disparities are too large and never too small: errors that a view's points share do not average out. In long
    aisles, 12 m and more away, they are 0.2 px (rms of 222 loops of rendered drives). First order, for equal weights.
    """
    seen = points_cam[np.isfinite(points_cam).all(axis=1)]
    nearer = -seen * seen[:, 2:] / (camera.focal_px * camera.baseline_m)
    there = transform_points(new_from_old, seen)
    rows = projection_by_point(camera, there)
    shift = np.einsum("nab,nb->na", rows, nearer @ new_from_old[:3, :3].T) - [0.0, 0.0, 1.0]
    turns = np.cross(np.eye(3), there[:, None]).transpose(0, 2, 1)
    jacobian = np.concatenate([rows @ turns, rows], axis=2).reshape(-1, 6)
    return np.asarray(-np.linalg.lstsq(jacobian, shift.ravel(), rcond=None)[0])


def _around(distance_m: float) -> Array:
    """Return (16, 3) level steps of one length in all directions, empty for length 0."""
    if distance_m <= 0:
        return np.zeros((0, 3))
    angles = np.arange(_SIDES) * (2 * np.pi / _SIDES)
    return distance_m * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(_SIDES)])
