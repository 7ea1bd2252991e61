"""Revisits: looked for by words, allowed by position, verified by geometry, and only then believed."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import BowVector, PlaceIndex
from fleetmap.geometry import Array, se3_inverse
from fleetmap.rectification import StereoCamera
from mapserver.survey.graph_marginals import GraphMarginals
from mapserver.survey.keyframes import Keyframe
from mapserver.survey.matching import median_depth_m
from mapserver.survey.pairs import PairMatch, match_pair
from mapserver.survey.pose_graph import PoseEdge, adjoint
from mapserver.survey.settings import SurveySettings
from mapserver.survey.zones import Zones

_CORRELATION = (
    3.0  # matched points share calibration and depth errors: a pair's own covariance is too narrow by about this
)


class Verdict(StrEnum):
    """What became of a candidate."""

    ACCEPTED = "accepted"
    GATED_OUT = "gated_out"
    REJECTED = "rejected"
    AMBIGUOUS = "ambiguous"


@dataclass(frozen=True, slots=True)
class LoopRecord:
    """One candidate and its fate: keyframe i (new) against j (old); inliers and the reason in words."""

    i: int
    j: int
    score: float
    verdict: Verdict
    reason: str
    inliers: int = 0


@dataclass
class Loops:
    """All candidates, and the edges (i_from_j of bodies) of the accepted ones."""

    records: list[LoopRecord] = field(default_factory=list)
    edges: list[PoseEdge] = field(default_factory=list)

    def counts(self) -> dict[str, int]:
        """candidates, gated_out, rejected, accepted; ambiguous ones count as rejected."""
        tally = {verdict: sum(r.verdict is verdict for r in self.records) for verdict in Verdict}
        return {
            "candidates": len(self.records),
            "gated_out": tally[Verdict.GATED_OUT],
            "rejected": tally[Verdict.REJECTED] + tally[Verdict.AMBIGUOUS],
            "accepted": tally[Verdict.ACCEPTED],
        }

    def disbelieve(self, weights: Array) -> None:
        """Turns loops with a pose-graph weight below one half into rejected ones; weights go along the edges."""
        doubted = {(e.i, e.j) for e, weight in zip(self.edges, weights, strict=True) if weight < 0.5}
        self.edges = [e for e in self.edges if (e.i, e.j) not in doubted]
        self.records = [
            LoopRecord(r.i, r.j, r.score, Verdict.REJECTED, "contradicts the other loops in the pose graph", r.inliers)
            if (r.i, r.j) in doubted and r.verdict is Verdict.ACCEPTED
            else r
            for r in self.records
        ]


class LoopCloser:
    """Searches a finished chain of keyframes for revisits; `marginals` narrows with every loop that is accepted."""

    def __init__(
        self, keyframes: list[Keyframe], vectors: list[BowVector], word_count: int, camera: StereoCamera, body_from_cam: Array,
        map_from_body: Array, marginals: GraphMarginals, matched: set[tuple[int, int]], settings: SurveySettings, zones: Zones,
    ) -> None:  # fmt: skip
        self._keyframes, self._vectors, self._camera = keyframes, vectors, camera
        self._body_from_cam, self._map_from_body = body_from_cam, map_from_body  # moved by every accepted loop
        self._cam_from_body = se3_inverse(body_from_cam)
        self._marginals, self._settings, self._zones = marginals, settings, zones
        self._neighbours: dict[int, list[int]] = {}
        for i, j in sorted(matched):
            self._neighbours.setdefault(i, []).append(j)
            self._neighbours.setdefault(j, []).append(i)
        self._matched = matched
        self._index = PlaceIndex(word_count)
        self.loops = Loops()

    def close(self, i: int) -> None:
        """Looks for revisits of keyframe i among those before it, then adds it to the index. To be called in order."""
        settings = self._settings.loops
        ids = self._index.place_ids
        new = np.array(
            [(j, i) not in self._matched and i - j >= settings.min_gap_keyframes for j in ids.tolist()], bool
        )
        if new.any():
            found, scores = self._index.query(self._vectors[i], new, settings.top)
            believed = [
                edge
                for j, score in zip(found.tolist(), scores.tolist(), strict=True)
                if (edge := self._judge(i, j, score)) is not None
            ]
            self._decide(i, believed)
        self._index.add(i, self._vectors[i])

    def _judge(self, i: int, j: int, score: float) -> tuple[PoseEdge, LoopRecord] | None:
        """The edge of one candidate that passed every test alone; records the failure of any other."""

        outcome = self._examine(i, j, score)
        if isinstance(outcome, LoopRecord):
            self.loops.records.append(outcome)
            return None
        return outcome

    def _examine(self, i: int, j: int, score: float) -> tuple[PoseEdge, LoopRecord] | LoopRecord:
        def refuse(verdict: Verdict, reason: str, inliers: int = 0) -> LoopRecord:
            return LoopRecord(i, j, score, verdict, reason, inliers)

        reach_m = self._settings.loops.view_range_depths * max(
            median_depth_m(self._keyframes[i]), median_depth_m(self._keyframes[j])
        )
        if not self._marginals.reachable(i, np.array([j]), reach_m)[0]:
            return refuse(Verdict.GATED_OUT, "too far apart to see the same, given how well the way between is known")
        if not self._zones.compatible(self._map_from_body[i, :3, 3], self._map_from_body[j, :3, 3]):
            return refuse(Verdict.GATED_OUT, "in different zones")
        match = self._verify(i, j)
        if match is None:
            return refuse(Verdict.REJECTED, "too few features agree on one motion")
        count = len(match.features)
        cells = _cells(self._keyframes[i], match.features[:, 1], self._camera)
        if count < self._settings.loops.min_inliers or cells < self._settings.loops.min_cells:
            return refuse(Verdict.REJECTED, f"{count} matches in {cells} of 48 cells are too few or too crowded", count)
        edge = self._edge(match)
        innovation = self._marginals.innovation_squared(edge)
        if innovation > self._settings.loops.max_innovation:
            return refuse(
                Verdict.GATED_OUT, f"matches, but from where the robot cannot be (innovation {innovation:.0f})", count
            )
        supported = self._neighbours_agree(match)
        if supported is False or (supported is None and count < self._settings.loops.alone_inliers):
            return refuse(Verdict.REJECTED, "neighbouring keyframes do not confirm it", count)
        return edge, LoopRecord(i, j, score, Verdict.ACCEPTED, "verified", count)

    def _verify(self, i: int, j: int) -> PairMatch | None:
        """Match of j (as reference) with i; the graph's rotation is used where it is known well enough."""
        predicted = (
            self._cam_from_body @ se3_inverse(self._map_from_body[i]) @ self._map_from_body[j] @ self._body_from_cam
        )
        sigma = float(np.sqrt(np.trace(self._marginals.relative_cov(i, j)[:3, :3])))
        known = max(sigma, 0.02) if sigma < self._settings.loops.rotation_sigma_limit_rad else None
        return match_pair(j, i, self._keyframes, self._camera, predicted, known, self._settings.pairs)

    def _edge(self, match: PairMatch) -> PoseEdge:
        """Body i from body j; the match has camera i (its j) from camera j (its i)."""
        body_from_body = self._body_from_cam @ match.j_from_i @ self._cam_from_body
        carry = adjoint(self._body_from_cam)
        covariance = _CORRELATION**2 * carry @ match.cov_rot_trans @ carry.T + np.diag([1e-6] * 3 + [1e-5] * 3)
        return PoseEdge(match.j, match.i, body_from_body, covariance, is_loop=True)

    def _neighbours_agree(self, match: PairMatch) -> bool | None:
        """Whether a covisible neighbour of the old keyframe, placed by this match, matches too; None where none can be seen."""
        i, j = match.j, match.i
        tried = 0
        for n in sorted(self._neighbours.get(j, []), key=lambda n: abs(n - j))[:4]:
            if n == i:
                continue
            j_from_n = (
                self._cam_from_body @ se3_inverse(self._map_from_body[j]) @ self._map_from_body[n] @ self._body_from_cam
            )
            predicted = match.j_from_i @ j_from_n
            other = match_pair(
                n, i, self._keyframes, self._camera, predicted, None, self._settings.pairs, is_known=True
            )
            if other is None:
                continue
            tried += 1
            off = se3_inverse(predicted) @ other.j_from_i
            if np.linalg.norm(off[:3, 3]) < 0.1 + 0.05 * median_depth_m(self._keyframes[i]):
                return True
        return False if tried else None

    def _decide(self, i: int, believed: list[tuple[PoseEdge, LoopRecord]]) -> None:
        """Accepts what is left, unless the candidates exclude each other: then none is."""
        places = [self._map_from_body[e.j] @ se3_inverse(e.i_from_j) for e, _ in believed]
        spread = max((float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a in places for b in places), default=0.0)
        between = [self._marginals.relative_cov(a.j, b.j) for a, _ in believed for b, _ in believed if a.j != b.j]
        tolerance = 0.3 + max((3.0 * float(np.sqrt(np.trace(c[3:, 3:]))) for c in between), default=0.0)
        for edge, record in believed:
            if spread > tolerance:
                self.loops.records.append(
                    LoopRecord(
                        i,
                        record.j,
                        record.score,
                        Verdict.AMBIGUOUS,
                        f"candidates {spread:.2f} m apart exclude each other",
                        record.inliers,
                    )
                )
                continue
            self.loops.records.append(record)
            self.loops.edges.append(edge)
            self._marginals.add(edge)
            self._map_from_body = self._marginals.map_from_body


def _cells(keyframe: Keyframe, features: NDArray[np.int64], camera: StereoCamera) -> int:
    """How many of 8 x 6 image cells hold one of the features."""
    pixels = keyframe.features.pixels[features]
    column = np.clip(pixels[:, 0] / camera.width_px * 8, 0, 7).astype(int)
    row = np.clip(pixels[:, 1] / camera.height_px * 6, 0, 5).astype(int)
    return len(np.unique(column * 6 + row))
