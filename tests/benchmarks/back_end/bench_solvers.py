"""Solvers in one run: pose graphs with and without wrong loops; local and global bundle adjustment beside gtsam's.

Without `--only` a quarter of an hour. The reference problems lie beside the project, in `../shared/data`.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import gtsam
import numpy as np
from scipy.stats import chi2

from benchmarks.common.recorded_runs import Options, Results, benchmark
from fleetmap.geometry import Array, align_points, se3, se3_inverse, se3_log, so3_exp, transform_points
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.bundle_rounds import bundle_problem
from mapserver.survey.bundle.problem import BundleProblem
from mapserver.survey.pose_graph.pose_graph import PoseEdge, optimize_pose_graph
from mapserver.survey.settings import BundleSettings, SurveySettings
from support.problems.g2o import parse_g2o
from support.recordings.realdata import DATA
from support.worlds.bundle_gtsam import gtsam_graph
from support.worlds.bundle_scene import disturbed
from support.worlds.corridor_scene import scene
from support.worlds.pose_graph_scene import driven

Figures = dict[str, float]
T = TypeVar("T")
GRAPHS = ("sphere2500", "parking-garage", "sphere_bignoise_vertex3")
HUBER = 2.5
TOLERANCE = 1e-4  # of the cost: with none, gtsam ends by trying ever smaller steps, which would be unfair to it


def timed(work: Callable[[], T]) -> tuple[float, T]:
    """CPU seconds of this process, and what the work gave."""
    begun = time.process_time()
    result = work()
    return time.process_time() - begun, result


def pose_graphs() -> dict[str, Figures]:
    """Cost from the file's own start against the best of several starts; then with a tenth of random wrong loops.

    off_clean: root mean square distance of the keyframes from where they are without wrong loops, after SE(3) alignment as
    everywhere (else the edges of the one keyframe that is held would decide), as a share of the extent (the diagonal of the
    box around all of them) and of the way that joins them in order.
    """
    found = {}
    for name in GRAPHS:
        map_from_body, edges = parse_g2o((DATA / "pose_graphs" / f"{name}.g2o").read_text())
        seconds, own = timed(lambda: optimize_pose_graph(map_from_body, edges, robust=False))  # noqa: B023
        following = {e.i: e.i_from_j for e in edges if e.j == e.i + 1}
        odometry = driven([following[k] for k in range(len(map_from_body) - 1)], map_from_body[0])
        rng = np.random.default_rng(4)
        shifts = [se3(so3_exp(0.1 * rng.normal(size=3)), rng.normal(size=3)) for _ in map_from_body]
        starts = odometry, own.map_from_body @ np.array(shifts)
        costs = [optimize_pose_graph(start, edges, robust=False).cost for start in starts]
        best = min([own.cost, *costs])
        found[name] = {"cost": own.cost, "above_best": own.cost / best - 1.0, "cpu_s": seconds}
        found[name] |= _with_wrong_loops(map_from_body, edges, own.map_from_body)
    return found


def _with_measured_noise(edges: list[PoseEdge], clean: Array) -> list[PoseEdge]:
    """Their covariances are right up to a common factor: what the better 0.7 of the loops leave over at the optimum tells it."""
    loops = [edge for edge in edges if edge.is_loop]
    off = [se3_log(edge.i_from_j @ se3_inverse(clean[edge.j]) @ clean[edge.i]) for edge in loops]
    squared = [float(r @ np.linalg.solve(edge.cov_rot_trans, r)) for r, edge in zip(off, loops, strict=True)]
    factor = float(np.quantile(squared, 0.7)) / float(chi2.ppf(0.7, 6))
    return [replace(edge, cov_rot_trans=factor * edge.cov_rot_trans) for edge in edges]


def _with_wrong_loops(map_from_body: Array, edges: list[PoseEdge], clean: Array) -> Figures:
    rng = np.random.default_rng(0)
    right = sum(edge.is_loop for edge in edges)
    extent_m = float(np.linalg.norm(np.ptp(clean[:, :3, 3], axis=0)))
    way_m = float(np.linalg.norm(np.diff(clean[:, :3, 3], axis=0), axis=1).sum())
    edges = _with_measured_noise(edges, clean)
    wrong: list[PoseEdge] = []
    while len(wrong) < right // 10:
        i, j = (int(k) for k in rng.integers(0, len(map_from_body), 2))
        if abs(i - j) > 1:
            i_from_j = se3(so3_exp(rng.normal(size=3)), rng.normal(size=3) * extent_m / 6)
            wrong.append(PoseEdge(i, j, i_from_j, edges[-1].cov_rot_trans, is_loop=True))
    seconds, robust = timed(lambda: optimize_pose_graph(map_from_body, [*edges, *wrong]))
    kept = robust.loop_weights >= 0.5
    places, wanted = robust.map_from_body[:, :3, 3], clean[:, :3, 3]
    aligned = transform_points(align_points(wanted, places)[0], places)
    rms_m = float(np.sqrt(((aligned - wanted) ** 2).sum(axis=1).mean()))
    return {
        "loops_right": right, "right_kept": float(kept[:right].sum()), "loops_wrong": len(wrong),
        "wrong_kept": float(kept[right:].sum()), "off_clean_share_of_extent": rms_m / extent_m,
        "off_clean_share_of_way": rms_m / way_m, "robust_cpu_s": seconds,
    }  # fmt: skip


def corridor(keyframes: int, landmarks: int, observations: int, fixed: int) -> BundleProblem:
    """A drive along two walls with noisy sightings, so many of them, at random."""
    problem = bundle_problem(scene(keyframes, 2, drift=0.0, landmarks=landmarks).state, SurveySettings(), None)
    chosen = np.random.default_rng(2).permutation(len(problem.obs_landmark))[:observations]
    problem = problem.observed(np.sort(chosen))
    problem.fixed[:fixed] = True
    return problem


def _held_by_priors(problem: BundleProblem) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Held keyframes by tight priors: equality constraints would send gtsam from Cholesky to QR, many times slower."""
    graph, values = gtsam_graph(replace(problem, fixed=np.zeros_like(problem.fixed)), HUBER)
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    for k in np.flatnonzero(problem.fixed).tolist():
        graph.add(gtsam.PriorFactorPose3(gtsam.symbol("x", k), gtsam.Pose3(problem.map_from_body[k]), tight))
    return graph, values


def adjustment(keyframes: int, landmarks: int, observations: int, fixed: int, repeats: int) -> Figures:
    """Up to five iterations of each solver from one start; gtsam's time without and with making its graph."""
    true = corridor(keyframes, landmarks, observations, fixed)
    start = disturbed(true, seed=3, rot_rad=0.003, trans_m=0.01, points_m=0.02)
    settings = BundleSettings(max_iterations=5, relative_cost_tolerance=TOLERANCE, huber_sigmas=HUBER)
    optimize(start, settings)  # compiles
    ours_s, theirs_s, making_s = [], [], []
    for _ in range(repeats):
        seconds, ours = timed(lambda: optimize(start, settings))
        ours_s.append(seconds)
        seconds, (graph, values) = timed(lambda: _held_by_priors(start))
        making_s.append(seconds)
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(5)
        parameters.setRelativeErrorTol(TOLERANCE)
        parameters.setAbsoluteErrorTol(0.0)
        seconds, optimum = timed(
            lambda: gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()  # noqa: B023
        )
        theirs_s.append(seconds)
    theirs = graph.error(optimum)
    ours_median, theirs_median = float(np.median(ours_s)), float(np.median(theirs_s))
    return {
        "keyframes": keyframes, "landmarks": len(np.unique(start.obs_landmark)), "observations": len(start.obs_pixels),
        "cost": ours.costs[-1], "gtsam_cost": theirs, "above_gtsam": ours.costs[-1] / theirs - 1.0,
        "ms": 1e3 * ours_median, "gtsam_ms": 1e3 * theirs_median, "gtsam_making_ms": 1e3 * float(np.median(making_s)),
        "times_faster": theirs_median / ours_median,
    }  # fmt: skip


SECTIONS: dict[str, Callable[[], object]] = {
    "local adjustment": lambda: adjustment(30, 2000, 8000, 15, 5),
    "pose graphs": pose_graphs,
    "global adjustment": lambda: adjustment(1000, 60_000, 360_000, 1, 1),
}


@benchmark(SECTIONS)
def main(options: Options) -> Results:
    return {name: SECTIONS[name]() for name in options.only}
