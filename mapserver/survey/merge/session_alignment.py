"""Alignments of a survey to the map: sets of fixes whose relative motion agrees with the survey's own."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from fleetmap.geometry import Array, se3_adjoint, se3_inverse, turn_both
from fleetmap.relocalization.relocalizer import Fix, FrameFeatures, Relocalizer
from fleetmap.time_sliced import finished
from mapserver.survey.pose_graph.graph_marginals import CHI2_6_0999, GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge, optimize_pose_graph

_WIDEST_PX = 60.0  # window size at which a descriptor still finds its feature more often than another one
_ANY_TURN_RAD = 0.5  # beyond which two fixes always disagree
_PLACE_M = 1.0  # between independent fixes: nearer ones see the same objects
_MAP_SHAPE = np.diag([0.003**2] * 3 + [0.02**2] * 3)  # of the map between two places: twice the error of surveys


class SessionFix(NamedTuple):
    """Keyframe k of the new survey located in the map: map_from_body (4, 4), the covariance of its inverse in body axes, inliers."""

    k: int
    map_from_body: Array
    cov_rot_trans: Array
    inliers: int


class Alignment(NamedTuple):
    """The agreeing fixes (one for each keyframe), map_from_survey (4, 4) of the one that agrees with the most, and the number of
    their places.
    """

    fixes: tuple[SessionFix, ...]
    map_from_survey: Array
    places: int


Images = Sequence[Sequence[FrameFeatures]]


def find_fixes(
    relocalizer: Relocalizer, images: Images, ks: Sequence[int], body_from_cams: Array, expected: Array | None
) -> list[SessionFix]:
    """Return all fixes of keyframes ks by each of their images, several for one image if places of the map look alike.

    images: of each keyframe by the cameras at body_from_cams (V, 4, 4). expected: map_from_body (K, 4, 4), near which fixes are also
    searched, and put behind the others; None if unknown.
    """
    looks = [(k, *each) for k in ks for each in zip(images[k], body_from_cams, strict=True)]
    found = [_at_body(k, fix, mount) for k, image, mount in looks for fix in finished(relocalizer.anywhere(image))]
    if expected is not None:
        near = [
            (k, relocalizer.by_projection(image, expected[k] @ mount, _WIDEST_PX), mount) for k, image, mount in looks
        ]
        found += [_at_body(k, fix, mount) for k, fix, mount in near if fix is not None]
    return found


def _at_body(k: int, fix: Fix, body_from_cam: Array) -> SessionFix:
    """Return the fix of keyframe k, its covariance converted from map axes to the camera's and then to the body."""
    carry = se3_adjoint(body_from_cam) @ turn_both(fix.map_from_cam[:3, :3].T)
    return SessionFix(
        k, fix.map_from_cam @ se3_inverse(body_from_cam), carry @ fix.cov_rot_trans @ carry.T, fix.inliers
    )


def alignments(fixes: Sequence[SessionFix], survey_from_body: Array, chain: GraphMarginals) -> list[Alignment]:
    """Return sets of fixes that agree with the survey's own motion, the largest first; the sets are disjoint.

    survey_from_body (K, 4, 4). Two fixes agree if the motion between them is that of the survey within 0.999 of chi-square of
    the covariances of its chain, of both fixes and of the map's shape.
    """
    agreeing = [_agreeing(n, fixes, survey_from_body, chain) for n in range(len(fixes))]
    found: list[Alignment] = []
    free = set(range(len(fixes)))
    while free:
        sets = {n: [m for m in agreeing[n] if m in free] for n in sorted(free)}
        best = max(sets, key=lambda n: (len(sets[n]), sum(fixes[m].inliers for m in sets[n]), -n))
        chosen = tuple(fixes[m] for m in sets[best])
        places = count_places(survey_from_body[[fix.k for fix in chosen], :3, 3])
        seed = fixes[best]
        found.append(Alignment(chosen, seed.map_from_body @ se3_inverse(survey_from_body[seed.k]), places))
        free -= set(sets[best])
    return sorted(found, key=lambda placed: -len(placed.fixes))


def _agreeing(seed: int, fixes: Sequence[SessionFix], survey_from_body: Array, chain: GraphMarginals) -> list[int]:
    """Return for every keyframe the fix that agrees best with the seed's, if any; the seed itself first."""
    own = fixes[seed]
    measured = se3_inverse(own.map_from_body) @ np.stack([fix.map_from_body for fix in fixes])
    numbers = np.array([fix.k for fix in fixes])
    predicted = se3_inverse(survey_from_body[own.k]) @ survey_from_body[numbers]
    off = measured @ se3_inverse(predicted)
    innovation = np.column_stack(
        [scipy.spatial.transform.Rotation.from_matrix(off[:, :3, :3]).as_rotvec(), off[:, :3, 3]]
    )
    near = np.flatnonzero((np.linalg.norm(innovation[:, :3], axis=1) < _ANY_TURN_RAD) & (numbers != own.k))
    covariances = chain.relative_covs(own.k, numbers[near])
    best: dict[int, tuple[float, int]] = {}
    for row, covariance in zip(near.tolist(), covariances, strict=True):
        carry = se3_adjoint(measured[row])
        spread = covariance + own.cov_rot_trans + carry @ fixes[row].cov_rot_trans @ carry.T + _MAP_SHAPE
        squared = float(innovation[row] @ np.linalg.solve(spread, innovation[row]))
        if squared < min(CHI2_6_0999, best.get(fixes[row].k, (np.inf, 0))[0]):
            best[fixes[row].k] = squared, row
    return [seed, *(row for _, row in best.values())]


def count_places(positions_m: Array) -> int:
    """Return how many of positions (F, 3), chosen in order, are at least a metre from each other."""
    chosen: list[Array] = []
    for position in positions_m:
        if all(np.linalg.norm(position - other) >= _PLACE_M for other in chosen):
            chosen.append(position)
    return len(chosen)


def follow_fixes(placed: Alignment, survey_from_body: Array, chain: Sequence[PoseEdge]) -> tuple[Array, int]:
    """Return map_from_body (K, 4, 4) by the pose graph of the survey's own edges and the fixes, and the number of accepted fixes."""
    start = np.concatenate([np.eye(4)[None], placed.map_from_survey @ survey_from_body])
    edges = [PoseEdge(e.i + 1, e.j + 1, e.i_from_j, e.cov_rot_trans, is_loop=False) for e in chain]
    edges += [
        PoseEdge(fix.k + 1, 0, se3_inverse(fix.map_from_body), fix.cov_rot_trans, is_loop=True) for fix in placed.fixes
    ]
    solved = optimize_pose_graph(start, edges)
    return solved.map_from_body[1:], int((solved.loop_weights >= 0.5).sum())
