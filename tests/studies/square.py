"""A square of four legs of ten metres, each turn two degrees short: where a closed loop puts the missing eight."""

from collections.abc import Callable
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, so3_log
from mapserver.survey.pose_graph.pose_graph import PoseEdge, optimize_pose_graph
from mapserver.survey.pose_graph.sim3_pose_graph import SimilarityEdge, optimize_similarities
from studies.study import Column, Row, publish, results, rms, table

LEGS, METRES = 4, 10  # a keyframe at every metre, and one after each turn on the spot
SHORT_DEG, GROWTH = 2.0, 0.05
_QUIET, _LOOSE, _ALIKE, _SIGMA_M = 0.02, 2.0, 1.0, 0.01  # standard deviations of a step: degrees, metres


def steps(turn_deg: float) -> list[tuple[Array, bool]]:
    """The drive's steps, a_from_b (4, 4), and whether each is a turn."""
    ahead = se3(np.eye(3), np.array([1.0, 0.0, 0.0]))
    turn = se3(so3_exp(np.array([0.0, 0.0, np.radians(turn_deg)])), np.zeros(3))
    return ([(ahead, False)] * METRES + [(turn, True)]) * LEGS


def driven(moves: list[tuple[Array, bool]]) -> Array:
    """(K, 4, 4) from the first keyframe on."""
    places = [np.eye(4)]
    for move, _ in moves:
        places.append(places[-1] @ move)
    return np.array(places)


def heading_deg(a_from_b: Array) -> float:
    """The turn about the vertical."""
    return float(np.degrees(so3_log(a_from_b[:3, :3])[2]))


def end_error_m(turn_deg: float) -> float:
    """How far a polygon with these turns misses its beginning. Closed form: a geometric series of unit complex numbers."""
    half = np.radians(turn_deg) / 2
    return float(METRES * abs(np.sin(LEGS * half) / np.sin(half)))


def closed(quiet_deg: float, loose_deg: float, loop_deg: float = 0.1) -> Row:
    """The graph with one loop from the last keyframe to the first; sigmas of the rotation of a metre ahead, of a turn, of the loop."""
    truth, moves = driven(steps(90.0)), steps(90.0 - SHORT_DEG)
    start, edges = driven(moves), []
    for k, (move, is_turn) in enumerate(moves):
        sigma = np.radians(loose_deg if is_turn else quiet_deg)
        edges.append(PoseEdge(k, k + 1, move, np.diag([sigma**2] * 3 + [_SIGMA_M**2] * 3), is_loop=False))
    # The first and the last keyframe are one place, and face the same way.
    last, sure = len(start) - 1, np.diag([np.radians(loop_deg) ** 2] * 3 + [_SIGMA_M**2] * 3)
    edges.append(PoseEdge(0, last, np.eye(4), sure, is_loop=True))
    found = optimize_pose_graph(start, edges)
    given = [
        heading_deg(se3_inverse(a) @ b) - heading_deg(move)
        for a, b, (move, _) in zip(found.map_from_body[:-1], found.map_from_body[1:], moves, strict=True)
    ]
    turns, straights = (
        [g for g, m in zip(given, moves, strict=True) if m[1]],
        [g for g, m in zip(given, moves, strict=True) if not m[1]],
    )
    # Of the missing angle a step takes the share that its variance has of all; positions decide the rest.
    loose, quiet = LEGS * loose_deg**2, LEGS * METRES * quiet_deg**2 + loop_deg**2
    return {
        "loop": "believed" if found.loop_weights[0] > 0.5 else "refused",
        "end_m": float(np.linalg.norm(found.map_from_body[-1, :3, 3])),
        "rms_m": rms(np.linalg.norm(found.map_from_body[:, :3, 3] - truth[:, :3, 3], axis=1)),
        "in_turns_deg": sum(turns),
        "in_straights_deg": sum(straights),
        "by_variance_deg": LEGS * SHORT_DEG * loose / (loose + quiet),
        "path": found.map_from_body[:, :2, 3].round(4).tolist(),
    }


def raw() -> Row:
    """What odometry alone says."""
    places, truth = driven(steps(90.0 - SHORT_DEG)), driven(steps(90.0))
    return {
        "loop": "none",
        "end_m": float(np.linalg.norm(places[-1, :3, 3])),
        "closed_form_m": end_error_m(90.0 - SHORT_DEG),
        "rms_m": rms(np.linalg.norm(places[:, :3, 3] - truth[:, :3, 3], axis=1)),
        "path": places[:, :2, 3].round(4).tolist(),
    }


def scaled(with_scale: bool) -> Row:
    """One camera, whose turns are right and whose metres grow by 5 % on the way; closed as rigid bodies, or as similarities."""
    moves, truth = steps(90.0), driven(steps(90.0))
    scale = np.exp(np.log1p(GROWTH) * np.arange(len(truth)) / (len(truth) - 1))
    moves = [(se3(m[:3, :3], m[:3, 3] * s), t) for (m, t), s in zip(moves, scale[:-1], strict=True)]
    start = driven(moves)
    cov = np.diag([np.radians(0.1) ** 2] * 3 + [0.02**2] * 3 + [0.01**2 if with_scale else 1e-12])
    edges = [SimilarityEdge(k, k + 1, m, 1.0, cov, is_loop=False) for k, (m, _) in enumerate(moves)]
    # The revisit compares the same points in the lengths of both ends; a rigid graph has no place for the ratio.
    ratio = float(scale[-1] / scale[0]) if with_scale else 1.0
    edges.append(SimilarityEdge(len(start) - 1, 0, np.eye(4), ratio, cov, is_loop=False))
    places = optimize_similarities(start, edges).map_from_body[:, :3, 3]
    errors = np.linalg.norm(places - truth[:, :3, 3], axis=1)
    return {
        "loop": "similarity" if with_scale else "rigid",
        "end_m": float(np.linalg.norm(places[-1])),
        "before_m": float(np.linalg.norm(start[-1, :3, 3])),
        "rms_m": rms(errors),
        "path": places[:, :2].round(4).tolist(),
    }


CASES: dict[str, Callable[[], Row]] = {
    "odometry alone": raw,
    "turns are doubted": partial(closed, _QUIET, _LOOSE),
    "all steps alike": partial(closed, _ALIKE, _ALIKE),
    "no step is doubted": partial(closed, _QUIET, _QUIET),
    "5 % of scale, rigid": partial(scaled, with_scale=False),
    "5 % of scale, similarities": partial(scaled, with_scale=True),
}


def draw(rows: list[Row]) -> Figure:
    """The paths beside the square."""
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    truth = driven(steps(90.0))[:, :2, 3]
    for axes, chosen in zip(figure.subplots(1, 3), (rows[:1], rows[1:4], rows[4:]), strict=True):
        axes.plot(*truth.T, color="#e5e7eb", linewidth=7, label="the square")
        for row, color in zip(
            chosen, ("#d1342f" if len(chosen) == 1 else "#2563eb", "#c77700", "#14924b"), strict=False
        ):
            axes.plot(*np.array(row["path"]).T, color=color, linewidth=1.4, label=row["case"])
        axes.set_aspect("equal")
        axes.legend(loc="center", fontsize=8, frameon=False)
        axes.set_xlabel("x, m")
    return figure


def main() -> None:
    """Rows, tables and picture of docs/studies/square.md."""
    rows = results("square", CASES)
    shown = [
        Column("case", "case"), Column("loop", "loop"), Column("end_m", "end to beginning, m", "{:.3f}"),
        Column("closed_form_m", "closed form, m", "{:.3f}"), Column("rms_m", "rms error, m", "{:.3f}"),
        Column("in_turns_deg", "given to turns, deg", "{:.2f}"), Column("in_straights_deg", "to straights, deg", "{:.2f}"),
        Column("by_variance_deg", "to turns by variance alone, deg", "{:.2f}"),
    ]  # fmt: skip
    publish("square", [table(rows, shown)], draw(rows))


if __name__ == "__main__":
    main()
