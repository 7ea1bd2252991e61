"""Two corridors that look the same: what loops by appearance make of them, with and without asking where the robot can be."""

from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np
from matplotlib.figure import Figure

from fleetmap.geometry import Array, se3, se3_exp, se3_inverse, so3_exp
from mapserver.survey.pose_graph.graph_marginals import CHI2_6_0999, GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge, optimize_pose_graph
from studies.study import Column, Row, publish, results, rms, study, table

APART_M, LONG_M = 5, 40
# Corner to corner: corridor A, home through C, corridor B, home through C, corridor A.
_CORNERS = [
    (0, 0),
    (LONG_M, 0),
    (LONG_M, 10),
    (0, 10),
    (0, APART_M),
    (LONG_M, APART_M),
    (LONG_M, 10),
    (0, 10),
    (0, 0),
    (LONG_M, 0),
]
SEEDS = range(20)
_LOOP_COV = np.diag([np.radians(0.2) ** 2] * 3 + [0.02**2] * 3)
_BESIDE_M = np.array([[0.0, APART_M, 0.0], [0.0, -APART_M, 0.0]])
Way = Literal["appearance", "robust", "gate", "gate and step"]


def walked() -> Array:
    """(K, 4, 4) a keyframe at every metre, facing ahead."""
    places = []
    for a, b in pairwise(_CORNERS):
        begin, way = np.array([*a, 0.0]), np.array([*b, 0.0]) - [*a, 0.0]
        size = int(np.linalg.norm(way))
        facing = so3_exp(np.array([0.0, 0.0, np.arctan2(way[1], way[0])]))
        places += [se3(facing, begin + way * n / size) for n in range(size)]
    return np.array(places)


def odometry(truth: Array, sigma_deg: float, rng: np.random.Generator) -> tuple[Array, list[PoseEdge]]:
    """The drive as measured, with covariances that are right: sigma_deg of heading and a centimetre at each metre."""
    cov = np.diag([1e-8, 1e-8, np.radians(sigma_deg) ** 2, 1e-4, 1e-4, 1e-8])
    places, edges = [truth[0]], []
    for k in range(len(truth) - 1):
        step = se3_exp(rng.multivariate_normal(np.zeros(6), cov)) @ se3_inverse(truth[k]) @ truth[k + 1]
        edges.append(PoseEdge(k, k + 1, step, cov, is_loop=False))
        places.append(places[-1] @ step)
    return np.array(places), edges


def alike(truth: Array, rng: np.random.Generator) -> list[tuple[PoseEdge, bool]]:
    """For each keyframe the earlier ones that look the same, by chance ordered, measured as one place; and whether they are."""
    spots, found = truth[:, :3, 3].round(3), []
    for k in range(len(truth)):
        earlier = np.flatnonzero(
            (np.arange(len(truth)) < k - 5) & np.isclose(truth[:, 0, 0], truth[k, 0, 0], atol=1e-6)
        )
        off = spots[earlier] - spots[k]
        in_corridor = spots[k, 1] in (0.0, APART_M) and 0 < spots[k, 0] < LONG_M
        same = (np.abs(off) < 1e-6).all(axis=1)
        twin = (
            in_corridor
            & (np.abs(off[:, 0]) < 1e-6)
            & (np.abs(np.abs(off[:, 1]) - APART_M) < 1e-6)
            & (spots[earlier, 1] <= APART_M)
        )
        for j in rng.permutation(earlier[same | twin]):
            measured = se3_exp(rng.multivariate_normal(np.zeros(6), _LOOP_COV))
            found.append((PoseEdge(k, int(j), measured, _LOOP_COV, is_loop=True), bool(same[earlier == j][0])))
    return found


def mapped(way: Way, sigma_deg: float, seed: int) -> tuple[Array, int, int, int]:
    """map_from_body (K, 4, 4); wrong loops and true ones that were believed, and true ones there were."""
    rng, truth = np.random.default_rng(seed), walked()
    start, edges = odometry(truth, sigma_deg, rng)
    loops = alike(truth, rng)
    if way.startswith("gate"):
        marginals, inside = GraphMarginals(start, edges), []
        for k in sorted({edge.i for edge, _ in loops}):
            possible = [one for one in loops if one[0].i == k and marginals.innovation_squared(one[0]) <= CHI2_6_0999]
            steps = _BESIDE_M if way == "gate and step" else _BESIDE_M[:0]
            unseen = [marginals.innovations_squared_beside(one[0], steps) for one in possible]
            # More than one place for the other end is an ambiguous view, of which nothing is learned.
            places = {tuple(truth[edge.j, :2, 3].round(1)) for edge, _ in possible}
            if len(places) == 1 and not (np.array(unseen) <= CHI2_6_0999).any():
                for one in possible:
                    marginals.add(one[0])
                inside += possible
        chosen = inside
    else:  # one for each keyframe, the best looking: which of the two is chance
        chosen = list({edge.i: (edge, is_same) for edge, is_same in loops}.values())
    found = optimize_pose_graph(start, [*edges, *(edge for edge, _ in chosen)], robust=way != "appearance")
    believed = [is_same for (_, is_same), weight in zip(chosen, found.loop_weights, strict=True) if weight > 0.5]
    return found.map_from_body, believed.count(False), believed.count(True), sum(is_same for _, is_same in loops)


def case(way: Way, sigma_deg: float) -> Row:
    """Means over the seeds."""
    truth, errors, wrong, right, there = walked(), [], 0, 0, 0
    for seed in SEEDS:
        places, *counts = mapped(way, sigma_deg, seed)
        errors.append(rms(np.linalg.norm(places[:, :3, 3] - truth[:, :3, 3], axis=1)))
        wrong, right, there = wrong + counts[0], right + counts[1], there + counts[2]
        if errors[-1] == max(errors):
            path = places[:, :2, 3].round(3).tolist()
    return {
        "way": way, "sigma_deg": sigma_deg, "rms_m": float(np.median(errors)), "worst_m": max(errors),
        "wrong": wrong, "right_share": right / there, "path": path,
    }  # fmt: skip


def draw(rows: list[Row]) -> Figure:
    """The worst seed of each way at the middle drift."""
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    for axes, row in zip(figure.subplots(2, 2).flat, rows[4:8], strict=True):
        axes.plot(*walked()[:, :2, 3].T, color="#e5e7eb", linewidth=6)
        axes.plot(*np.array(row["path"]).T, color="#14924b" if row["wrong"] == 0 else "#d1342f", linewidth=1.2)
        axes.set_title(
            f"{row['case']}: {row['wrong']} wrong loops in {len(SEEDS)} drives, worst {row['worst_m']:.1f} m",
            fontsize=9,
        )
        axes.set_aspect("equal")
    return figure


@study
def main() -> None:
    """Rows, table and picture of docs/studies/doppelganger.md."""
    ways: tuple[Way, ...] = ("appearance", "robust", "gate", "gate and step")
    cases = {f"{way}, {s} deg": partial(case, way, s) for s in (0.1, 0.3, 1.0) for way in ways}
    rows = results("doppelganger", cases, list(SEEDS))
    shown = [
        Column("way", "loops"), Column("sigma_deg", "drift, deg in a metre"), Column("wrong", "wrong loops believed, all seeds"),
        Column("right_share", "true loops used", "{:.0%}"), Column("rms_m", "rms error, median, m", "{:.3f}"),
        Column("worst_m", "worst seed, m", "{:.3f}"),
    ]  # fmt: skip
    publish("doppelganger", [table(rows, shown)], draw(rows))
