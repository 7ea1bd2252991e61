"""Position priors of a survey (docks, tags, zones): its frame `map`, edges of its pose graph, terms of its adjustment, its scale. Pure.

They hold what pictures and the IMU leave weak, such as the yaw of a block of aisles, each with its own covariance. A prior that contradicts
the survey beyond both covariances has no influence and is reported: before loops are searched by the chain of odometry, after the
adjustment by the prior's own covariance. A device publishes many samples while a robot stands at it or passes it, and they share its
error: each visit is one term with the covariance of one sample.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fleetmap.geometry import Array, se3, se3_inverse, skew, so3_exp, so3_log, transport_cov, turned_cov
from fleetmap.sensors.samples import PositionPrior
from mapserver.survey.pose_graph.graph_marginals import CHI2_6_0999, GraphMarginals
from mapserver.survey.pose_graph.odometry_factors import edge_covariance
from mapserver.survey.pose_graph.pose_graph import PoseEdge
from mapserver.survey.state import OdometryPass, PriorTerm
from mapserver.survey.survey_map import SurveyMap

_MAX_GAP_NS = 500_000_000  # between a prior and the frame used for it
_HEADING_KNOWN_RAD = 0.2
# A robot that was not away for so long, and not further, is still at the same device: tags are read from up to 3 m.
_AWAY_NS, _AWAY_M = 10_000_000_000, 3.0
_UNKNOWN_VARIANCE = np.array([1.0] * 3 + [1e4] * 3)  # rad^2, m^2
# Errors of a prior by the ground's unevenness and a robot's tilt: roll, pitch, yaw in rad; x, y, z in m.
_UNEVEN = np.diag(np.square([0.05, 0.05, 0.0, 0.01, 0.01, 0.25]))
# Of the frame `map` about the first keyframe: gravity knows roll and pitch, priors yaw and position.
_LEVEL = np.diag(np.square([1e-3, 1e-3, 0.5, 10.0, 10.0, 10.0]))


def placed_by_priors(
    survey_from_body: Array,
    marginals: GraphMarginals,
    priors: Sequence[PositionPrior],
    base_from_body: Array,
    odometry: OdometryPass,
) -> tuple[Array, list[PriorTerm]]:
    """Return keyframes (K, 4, 4) in `map`, and a term for each visit of a device, the reference first; no terms without a usable prior.

    priors: in order of time. The reference is the visit with a heading with which most others agree within the covariances of
    `marginals`; among equals the first. Positions alone suffice if they are far enough apart for a heading. A prior without heading
    takes that of the survey.
    """
    usable = _usable(priors, odometry)
    terms = _terms(usable, base_from_body, odometry, survey_from_body)
    chosen = _one_a_visit(usable, terms, marginals)
    usable, terms = [usable[n] for n in chosen], [terms[n] for n in chosen]
    headed = [n for n, term in enumerate(terms) if _has_heading(term)]
    order = list(range(len(terms)))
    if headed:
        agreeing = [sum(_agree(marginals, terms[n], terms[m]) for m in headed) for n in headed]
        order.insert(0, order.pop(headed[int(np.argmax(agreeing))]))
        reference = terms[order[0]]
        map_from_survey = level(
            reference.map_from_body @ se3_inverse(survey_from_body[reference.k]), reference.map_from_body
        )
    elif len(terms) > 1:
        there = np.array([term.map_from_body[:3, 3] for term in terms])
        here = survey_from_body[[term.k for term in terms], :3, 3]
        map_from_survey = level_fit(there, here)
        if not _gives_heading(terms, here @ map_from_survey[:3, :3].T):
            return survey_from_body, []
    else:
        return survey_from_body, []
    map_from_body = map_from_survey @ survey_from_body
    terms = _terms(usable, base_from_body, odometry, map_from_body)
    return map_from_body, [terms[n] for n in order]


def learn_priors(marginals: GraphMarginals, priors: Sequence[PriorTerm]) -> list[PriorTerm]:
    """Add priors to a graph of a survey's keyframes; those that contradict it are not added, and no longer believed.

    Without a heading nothing is added: positions alone do not give the survey's heading.
    """
    if not priors or not _has_heading(priors[0]):
        return list(priors)
    reference, judged = priors[0], [priors[0]]
    for term in priors[1:]:
        is_believed = _agree(marginals, reference, term)
        if is_believed and term.k != reference.k:
            marginals.add(_edge(reference, term))
        judged.append(replace(term, is_believed=is_believed))
    return judged


def prior_edges(map_from_body: Array, priors: Sequence[PriorTerm]) -> tuple[Array, list[PoseEdge]]:
    """Return keyframes (K, 4, 4) with the frame `map` as a node behind them, and the edges from there: its level, then the priors."""
    count = len(map_from_body)
    edges = [PoseEdge(count, 0, map_from_body[0], transport_cov(_LEVEL, -map_from_body[0, :3, 3]), is_loop=False)]
    for term in priors:
        covariance = transport_cov(_covariance(term), -term.map_from_body[:3, 3])
        edges.append(PoseEdge(count, term.k, term.map_from_body, covariance, is_loop=True))
    return np.concatenate([map_from_body, np.eye(4)[None]]), edges


def level(map_from_survey: Array, there: Array) -> Array:
    """Return map_from_survey (4, 4) without its tilt, which gravity knows better; the place `there` (4, 4) in `map` stays."""
    turn = so3_exp(np.array([0.0, 0.0, float(np.arctan2(map_from_survey[1, 0], map_from_survey[0, 0]))]))
    stays_m = map_from_survey[:3, :3].T @ (there[:3, 3] - map_from_survey[:3, 3])
    return se3(turn, there[:3, 3] - turn @ stays_m)


def level_fit(there: Array, here: Array) -> Array:
    """Return the rotation about z and the translation (4, 4) that bring positions `here` (N, 3) nearest to those `there`.

    Source: Horn 1987, in the plane.
    """
    a, b = here - here.mean(axis=0), there - there.mean(axis=0)
    yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum())
    turn = so3_exp(np.array([0.0, 0.0, float(yaw)]))
    return se3(turn, there.mean(axis=0) - turn @ here.mean(axis=0))


def in_frame(term: PriorTerm, new_from_map: Array) -> PriorTerm:
    """Return a prior in another frame; new_from_map (4, 4)."""
    information = turned_cov(term.information, new_from_map[:3, :3])
    return replace(term, map_from_body=new_from_map @ term.map_from_body, information=information)


def judged_priors(priors: Sequence[PriorTerm], map_from_body: Array) -> tuple[list[PriorTerm], bool]:
    """Return priors of keyframes at map_from_body (K, 4, 4), and True if none changed.

    Beyond the 0.999 of their covariance they are no longer believed.
    """
    judged = []
    for term in priors:
        off = map_from_body[term.k] @ se3_inverse(term.map_from_body)
        apart = np.concatenate([so3_log(off[:3, :3]), map_from_body[term.k, :3, 3] - term.map_from_body[:3, 3]])
        is_near = float(apart @ term.information @ apart) <= CHI2_6_0999
        judged.append(replace(term, is_believed=term.is_believed and is_near))
    return judged, all(a.is_believed == b.is_believed for a, b in zip(judged, priors, strict=True))


def _usable(priors: Sequence[PositionPrior], odometry: OdometryPass) -> list[PositionPrior]:
    """Return the priors of devices with known position in the plane and a frame near in time."""
    stamps_ns = odometry.stamps_ns
    return [
        prior
        for prior in priors
        if not prior.is_revisable
        and np.isfinite(np.diag(prior.cov_rot_trans)[3:5]).all()
        and np.abs(stamps_ns - prior.stamp_ns).min() <= _MAX_GAP_NS
    ]


def _terms(
    priors: Sequence[PositionPrior], base_from_body: Array, odometry: OdometryPass, map_from_body: Array
) -> list[PriorTerm]:
    """Return a term for each usable prior, at the keyframe nearest in time; map_from_body (K, 4, 4)."""
    stamps_ns, frames = odometry.stamps_ns, np.array(odometry.keyframe_frames)
    found = []
    for prior in priors:
        frame = int(np.argmin(np.abs(stamps_ns - prior.stamp_ns)))
        k = int(np.argmin(np.abs(frames - frame)))
        # By odometry from the frame to its keyframe: both are standing at a dock, and near each other elsewhere.
        body_from_k = se3_inverse(odometry.odom_from_body[frame]) @ odometry.odom_from_body[frames[k]]
        base_from_k, map_from_base = base_from_body @ body_from_k, prior.map_from_base
        if not np.sqrt(prior.cov_rot_trans[2, 2]) <= _HEADING_KNOWN_RAD:
            map_from_base = se3((map_from_body[k] @ se3_inverse(base_from_k))[:3, :3], map_from_base[:3, 3])
        map_from_k = map_from_base @ base_from_k
        covariance = transport_cov(_finite(prior) + _UNEVEN, map_from_k[:3, 3] - map_from_base[:3, 3])
        if frames[k] != frame:
            first, last = sorted((frame, int(frames[k])))
            covariance = covariance + turned_cov(edge_covariance(odometry, first, last), map_from_k[:3, :3])
        found.append(PriorTerm(k, map_from_k, np.asarray(np.linalg.inv(covariance), np.float64)))
    return found


def _one_a_visit(priors: Sequence[PositionPrior], terms: Sequence[PriorTerm], marginals: GraphMarginals) -> list[int]:
    """Return the number of the most certain sample of each visit of a device.

    A sample continues a visit if it agrees with its first one, and the robot stood or hardly moved since. Contradicting samples are
    visits of their own, and judged.
    """
    positions_m = marginals.map_from_body[:, :3, 3]
    visits, present = list[list[int]](), list[list[int]]()
    for n, (prior, term) in enumerate(zip(priors, terms, strict=True)):
        present = [
            visit
            for visit in present
            if term.k == terms[visit[-1]].k or prior.stamp_ns - priors[visit[-1]].stamp_ns <= _AWAY_NS
        ]
        for visit in present:
            first = terms[visit[0]]
            is_near = np.linalg.norm(positions_m[term.k] - positions_m[first.k]) <= _AWAY_M
            if is_near and _agree(marginals, first, term):
                visit.append(n)
                break
        else:
            present.append([n])
            visits.append(present[-1])
    return [max(visit, key=lambda n: float(np.linalg.slogdet(terms[n].information)[1])) for visit in visits]


def _has_heading(term: PriorTerm) -> bool:
    return float(_covariance(term)[2, 2]) <= _HEADING_KNOWN_RAD**2


def _gives_heading(terms: Sequence[PriorTerm], places: Array) -> bool:
    """Return True if the positions' own covariances give the yaw of `level_fit` as well as a prior with a heading.

    places (N, 3) by the fit. To first order the error of the yaw is the mean of the positions' errors across their arms, weighted by
    the arms.
    """
    arms = (places - places.mean(axis=0))[:, :2]
    across = np.column_stack([-arms[:, 1], arms[:, 0]])
    covariances = np.array([_covariance(term)[3:5, 3:5] for term in terms])
    variance = float(np.einsum("ni,nij,nj->", across, covariances, across))
    return variance < (_HEADING_KNOWN_RAD * float((arms**2).sum())) ** 2


def _covariance(term: PriorTerm) -> Array:
    return np.asarray(np.linalg.inv(term.information), np.float64)


def _agree(marginals: GraphMarginals, reference: PriorTerm, term: PriorTerm) -> bool:
    """Return True if the graph allows two priors within its covariance and theirs."""
    return marginals.innovation_squared(_edge(reference, term)) <= CHI2_6_0999


def _edge(reference: PriorTerm, term: PriorTerm) -> PoseEdge:
    """Return the pose of a term's keyframe relative to the reference's."""
    apart_m = term.map_from_body[:3, 3] - reference.map_from_body[:3, 3]
    both = _covariance(reference) + transport_cov(_covariance(term), -apart_m)
    i_from_j = se3_inverse(reference.map_from_body) @ term.map_from_body
    cov_in_i = turned_cov(both, reference.map_from_body[:3, :3].T)
    return PoseEdge(reference.k, term.k, i_from_j, cov_in_i, is_loop=True)


def _finite(prior: PositionPrior) -> Array:
    """Return its covariance (6, 6) with large variances instead of infinite ones, which are uncorrelated."""
    covariance, known = prior.cov_rot_trans, np.isfinite(np.diag(prior.cov_rot_trans))
    finite = np.where(np.isfinite(covariance) & known & known[:, None], covariance, 0.0)
    return np.asarray(finite + np.diag(np.where(known, 0.0, _UNKNOWN_VARIANCE)))


_MAX_SCALE_SIGMA_SHARE = 0.01  # limit for the scale by priors: beyond it the scale stays unknown
_MAX_DOCK_GAP_NS = 2_000_000_000


def aligned_by_priors(
    survey_map: SurveyMap, priors: Sequence[PositionPrior], base_from_body: Array
) -> tuple[Array, float] | None:
    """Return the pose of a survey of unknown scale, map_from_survey (4, 4) without the scale, and the metres per unit of the survey.

    By the docks and tags along its path with position and direction; None with fewer than two, or with a scale less accurate than 1 %.
    Gauss-Newton on seven unknowns.
    """
    usable = []
    for prior in priors:
        survey_from_body = survey_map.trajectory.at(prior.stamp_ns, _MAX_DOCK_GAP_NS)
        if survey_from_body is not None and np.isfinite(np.diag(prior.cov_rot_trans)).all():
            usable.append((survey_from_body, prior))
    if len(usable) < 2:
        return None
    body_in_base_m = base_from_body[:3, 3]
    turn = usable[0][1].map_from_base[:3, :3] @ base_from_body[:3, :3] @ usable[0][0][:3, :3].T
    places = np.array([there[:3, 3] for there, _ in usable])
    targets = np.array([p.map_from_base[:3, :3] @ body_in_base_m + p.map_from_base[:3, 3] for _, p in usable])
    spread = float(np.linalg.norm(places - places.mean(axis=0)))
    if spread < 1e-6:
        return None
    scale = float(np.linalg.norm(targets - targets.mean(axis=0))) / spread
    shift = targets.mean(axis=0) - scale * turn @ places.mean(axis=0)
    for _ in range(15):
        hessian, gradient = 1e-12 * np.eye(7), np.zeros(7)
        for place, target, (survey_from_body, prior) in zip(places, targets, usable, strict=True):
            arm = scale * turn @ place
            by_place = np.hstack([-skew(arm), np.eye(3), arm[:, None]])
            map_from_body = prior.map_from_base[:3, :3] @ base_from_body[:3, :3]
            off_turn = so3_log(map_from_body @ (turn @ survey_from_body[:3, :3]).T)
            jacobian = np.vstack([np.hstack([np.eye(3), np.zeros((3, 4))]), by_place])
            residual = np.concatenate([off_turn, target - arm - shift])
            weight = np.linalg.inv(prior.cov_rot_trans)
            hessian += jacobian.T @ weight @ jacobian
            gradient += jacobian.T @ weight @ residual
        step = np.linalg.solve(hessian, gradient)
        turn, scale = so3_exp(np.asarray(step[:3], np.float64)) @ turn, scale * float(np.exp(step[6]))
        shift = shift + step[3:6]
    sigma = float(np.sqrt(np.linalg.inv(hessian)[6, 6]))
    return (se3(turn, shift), scale) if sigma <= _MAX_SCALE_SIGMA_SHARE else None
