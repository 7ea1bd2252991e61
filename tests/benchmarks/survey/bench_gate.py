"""The loop gate at site scale: 44 aisles that look the same, features without pictures, the survey's own loop closing.

`PYTHONPATH=tests python tests/benchmarks/survey/bench_gate.py [--bays N] [--every M] [--drift-scale S] [--out FILE.json]`. Blocks of four
aisles are driven up and down, two of the four twice; in the end the robot returns to the first aisle, kilometres after it was there.
Odometry is the truth with errors drawn from the covariances that the gate is told.
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
import argparse
import json
import platform
import time
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from unittest.mock import patch

import numpy as np

from benchmarks.back_end.bench_aliasing import replace_layout
from benchmarks.common.estimator_loop import blank
from fleetmap.bow import Vocabulary
from fleetmap.features import orb
from fleetmap.geometry import Array, se3, se3_exp, se3_inverse
from fleetsim.motion.routes import Route
from fleetsim.recorder import Order, Session, prepare
from fleetsim.scenarios import SCENARIOS, Run, Scenario, find_scenario
from fleetsim.scene.layout import Layout
from mapserver.survey.keyframes.keyframes import Keyframe, MemoryImageStore, PosedKeyframes
from mapserver.survey.loops.loops import LoopCloser, LoopVerdict
from mapserver.survey.pose_graph.graph_marginals import CHI2_6_0999, GraphMarginals
from mapserver.survey.pose_graph.pose_graph import PoseEdge
from mapserver.survey.settings import LoopSettings, SurveySettings
from mapserver.survey.survey_inputs import SurveyConfig
from support.estimator.landmarks import LandmarkField
from support.estimator.simulated_run import EstimatorSession
from support.worlds.vocabulary_training import train_vocabulary

NAME = "site-identical"
END_M = 2.7
TRUE_EDGE_M = 0.5  # an accepted loop that is farther from the truth is wrong
REVISIT_M, REVISIT_RAD = 1.25, 0.2
ALIAS_X_M = 3.0
# Odometry's errors grow with the square root of the way: rad and m after one metre. Roll and pitch are held by gravity.
WALK = np.array([2e-5, 2e-5, 1.5e-4, 4e-3, 4e-3, 1e-3])
MIN_ALIASED, MIN_CLOSED_SHARE = 100_000, 0.95
BAYS, EVERY_M = 70, 2.0


@dataclass(frozen=True, slots=True)
class Gated:
    """What became of the candidates and of the revisits.

    aliased: candidates in another aisle that look like the true place: the same way along the aisle, facing the same.
    Revisits are sure where the position gate holds one aisle only, unsure where it holds more.
    """

    aisles: int
    floor_m2: float
    path_m: float
    keyframes: int
    candidates: int
    aliased: int
    accepted: int
    wrong: int
    sure_revisits: int
    sure_closed: int
    unsure_revisits: int
    unsure_ambiguous: int
    unsure_closed: int
    learned: int
    ms_per_keyframe: float

    @property
    def closed_share(self) -> float:
        """Of the sure revisits."""
        return self.sure_closed / max(self.sure_revisits, 1)


def identical_site(bays: int) -> Layout:
    """The site's layout with nothing that tells its aisles apart."""
    plain = replace_layout(find_scenario("site").layout, has_landmarks=False, are_aisles_identical=True)
    fields = {name: getattr(plain, name) for name in plain.__struct_fields__}
    return Layout(**(fields | {"bays": bays}))


def tour(layout: Layout) -> Route:
    """Even aisles up, odd ones down; in every block of four the second and the third are driven twice."""
    order = [block + k for block in range(0, layout.aisles, 4) for k in (0, 1, 2, 1, 2, 3)] + [0]
    ends = (END_M, layout.length_m - END_M)
    points = [(end, layout.aisle_y_m(a)) for a in order for end in (ends if a % 2 == 0 else ends[::-1])]
    return Route(tuple(points))


def prepare_tour(layout: Layout) -> Session:
    """The drive, without its pictures."""
    scenario = Scenario("44 identical aisles", layout, {"survey": Run("surveyor", (tour(layout),), rate_hz=5.0)})
    with patch.dict(SCENARIOS, {NAME: lambda: scenario}):
        return prepare(Order(NAME))


def chosen_frames(map_from_body: Array, every_m: float) -> list[int]:
    """Frames that far, or 0.4 rad, apart."""
    frames = [0]
    for n in range(1, len(map_from_body)):
        since = se3_inverse(map_from_body[frames[-1]]) @ map_from_body[n]
        turned = np.arccos(np.clip((np.trace(since[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
        if np.linalg.norm(since[:3, 3]) >= every_m or turned > 0.4:
            frames.append(n)
    return frames


def keyframe(session: EstimatorSession, number: int, frame: int) -> Keyframe:
    """What the survey would have made of the picture."""
    found, shown = session.features(frame), blank(session, frame)
    disparity = found.pixels[:, 0] - found.pixels[:, 2]
    disparity = np.where(disparity > 0.5, disparity, np.nan)
    features = orb.Features(
        found.pixels[:, :2].copy(), found.octaves, np.zeros(len(found.rows), np.float32), found.descriptors
    )
    return Keyframe(
        number, shown.stamp_ns, features, np.column_stack([disparity, np.full(len(disparity), 0.2)]),
        session.camera.point_from_pixel(features.pixels, disparity), MemoryImageStore(), 0,
    )  # fmt: skip


def drifted(truth: Array, rng: np.random.Generator, scale: float = 1.0) -> tuple[Array, list[PoseEdge]]:
    """Where odometry believes the keyframes to be, and its edges."""
    believed, edges = [truth[0]], []
    for k, (a, b) in enumerate(pairwise(truth)):
        i_from_j = se3_inverse(a) @ b
        sigma = scale * WALK * np.sqrt(max(float(np.linalg.norm(i_from_j[:3, 3])), 0.05))
        measured = se3_exp(rng.normal(size=6) * sigma) @ i_from_j
        edges.append(PoseEdge(k, k + 1, measured, np.diag(sigma**2), is_loop=False))
        believed.append(believed[-1] @ measured)
    return np.array(believed), edges


def site_vocabulary(keyframes: list[Keyframe]) -> Vocabulary:
    """Trained on a part of what was seen."""
    some = keyframes[:: max(1, len(keyframes) // 60)]
    images = np.repeat(np.arange(len(some)), [len(k.features) for k in some])
    return train_vocabulary(
        np.concatenate([k.features.descriptors for k in some]), 10, 4, np.random.default_rng(0), images
    )


def true_place(truth: Array, i: int, min_gap: int) -> int | None:
    """The nearest earlier keyframe that a revisit by keyframe i should close with."""
    if i < min_gap:
        return None
    before = truth[: i - min_gap + 1]
    away = np.linalg.norm(before[:, :3, 3] - truth[i, :3, 3], axis=1)
    away[before[:, :3, 0] @ truth[i, :3, 0] < np.cos(REVISIT_RAD)] = np.inf
    return int(np.argmin(away)) if away.min() < REVISIT_M else None


def holds_one_aisle(marginals: GraphMarginals, truth: Array, i: int, j: int, layout: Layout) -> bool:
    """Whether the same picture taken one aisle beside the true place would be refused by position."""
    for side in (-layout.pitch_m, layout.pitch_m):
        if not 0.0 < truth[i, 1, 3] + side < layout.width_m:
            continue
        beside = se3(np.eye(3), np.array([0.0, side, 0.0])) @ truth[i]
        edge = PoseEdge(i, j, se3_inverse(beside) @ truth[j], np.diag([1e-5] * 3 + [1e-3] * 3), is_loop=True)
        if marginals.innovation_squared(edge) <= CHI2_6_0999:
            return False
    return True


def bench(bays: int, every_m: float, per_place: int = 2, seed: int = 0, drift_scale: float = 1.0) -> Gated:
    """Drives the tour once; with `drift_scale` above 1 the odometry is so much worse, and says so, and the survey is told how far
    apart the aisles are."""
    layout = identical_site(bays)
    repeats_every_m = layout.pitch_m if drift_scale > 1 else 0.0
    settings = SurveySettings(loops=LoopSettings(per_place=per_place, repeats_every_m=repeats_every_m))
    simulated = prepare_tour(layout)
    session = EstimatorSession(simulated)
    frames = chosen_frames(session.map_from_body, every_m)
    truth = session.map_from_body[frames]
    keyframes = []
    for n, frame in enumerate(frames):
        if n % 400 == 399:  # landmarks of aisles left behind would fill the memory
            session = EstimatorSession(simulated, field=LandmarkField(simulated.world))
        keyframes.append(keyframe(session, n, frame))
        if n % 500 == 499:
            print(f"{n + 1} of {len(frames)} keyframes made", flush=True)
    vocabulary = site_vocabulary(keyframes)
    believed, edges = drifted(truth, np.random.default_rng(seed), drift_scale)
    marginals = GraphMarginals(believed, edges)
    matched = {(k, k + step) for step in (1, 2) for k in range(len(keyframes) - step)}
    posed = PosedKeyframes(keyframes, believed, session.body_from_cam, session.camera)
    closer = LoopCloser(posed, SurveyConfig(settings, vocabulary), marginals, matched)
    sure: dict[int, bool] = {}
    spent_s = 0.0
    for i in range(len(keyframes)):
        j = true_place(truth, i, settings.loops.min_gap_keyframes)
        if j is not None:
            sure[i] = holds_one_aisle(marginals, truth, i, j, layout)
        begun = time.process_time()
        closer.close(i)
        spent_s += time.process_time() - begun
        if i % 500 == 499:
            print(f"{i + 1} of {len(keyframes)} keyframes closed, {len(closer.loops.edges)} loops", flush=True)
    return judged(layout, truth, closer, sure, 1e3 * spent_s / len(keyframes), marginals.learned)


def judged(
    layout: Layout, truth: Array, closer: LoopCloser, sure: dict[int, bool], ms: float, learned: int
) -> Gated:  # fmt: skip
    """The loops against the truth."""
    right, wrong = set(), 0
    for edge in closer.loops.edges:
        off = edge.i_from_j @ se3_inverse(truth[edge.j]) @ truth[edge.i]
        is_right = np.linalg.norm(off[:3, 3]) < TRUE_EDGE_M
        wrong += not is_right
        right |= {edge.i} if is_right else set()
    pairs = np.array([(r.i, j) for r in closer.loops.records for j in (r.j, *r.also)]).reshape(-1, 2)
    apart = np.abs(truth[pairs[:, 0], :3, 3] - truth[pairs[:, 1], :3, 3])
    facing = np.einsum("na,na->n", truth[pairs[:, 0], :3, 0], truth[pairs[:, 1], :3, 0])
    aliased = (apart[:, 1] > 0.5 * layout.pitch_m) & (apart[:, 0] < ALIAS_X_M) & (facing > np.cos(REVISIT_RAD))
    ambiguous = {r.i for r in closer.loops.records if r.verdict is LoopVerdict.AMBIGUOUS}
    surely, unsurely = ({i for i, is_sure in sure.items() if is_sure is wanted} for wanted in (True, False))
    path_m = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    return Gated(
        layout.aisles, layout.length_m * layout.width_m, path_m, len(truth), len(pairs), int(aliased.sum()),
        len(closer.loops.edges), wrong, len(surely), len(surely & right), len(unsurely), len(unsurely & ambiguous - right),
        len(unsurely & right), learned, ms,
    )  # fmt: skip


def show(found: Gated) -> None:
    """Prints the figures."""
    for name, value in asdict(found).items():
        print(f"{name:18s} {value:12.1f}" if isinstance(value, float) else f"{name:18s} {value:12d}")
    print(f"{'sure and closed':18s} {found.closed_share:12.3f}")


def main() -> None:
    """Prints the figures; writes them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bays", type=int, default=BAYS)
    parser.add_argument("--every", type=float, default=EVERY_M)
    parser.add_argument("--per-place", type=int, default=2)
    parser.add_argument("--drift-scale", type=float, default=1.0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    found = bench(options.bays, options.every, options.per_place, drift_scale=options.drift_scale)
    show(found)
    if options.out is not None:
        head = {"machine": platform.machine(), "python": platform.python_version(), "closed_share": found.closed_share}
        options.out.write_text(json.dumps(head | asdict(found), indent=2) + "\n")


if __name__ == "__main__":
    main()
