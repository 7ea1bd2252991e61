"""Verdicts on failures of known causes: how well they tell a wrong robot, a changed building and a look-alike apart, and how sure.

`PYTHONPATH=tests python -m benchmarks.robot.bench_verdicts [--seed SEED] [--sites N] [--runs N] [--only CAUSE] [--fit 1] [--out F]`.
N runs (20) of eleven causes on each of N sites (4), at the estimator's level; sites of odd seeds have aisles that are all alike, where
alone look-alikes are. Not every robot fails: about 600 do. `--fit 1` prints the weights of the model, fitted on the failures in
failed_robots.csv; sites of these are not judged.
"""

import csv
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.special import logsumexp
from scipy.stats import rankdata

from benchmarks.common.recorded_runs import Options, Results, benchmark
from benchmarks.robot.failed_robots import CAUSES, LOOKALIKES, TRUTHS, fail
from fleetmap.errors import UsageError
from fleetmap.geometry import Array
from fleetmap.messages import FailureReport, encode_message
from mapserver.plugins.failure_verdicts.model import SAYS, VERDICTS, Verdict, verdict

_CONFIDENT = 0.95
_PRIOR_SIGMA = 4.0  # of a weight, by which a figure's whole range changes the log odds
Judged = tuple[str, FailureReport]


def failures(seed: int, sites: int, runs: int, causes: Sequence[str]) -> list[Judged]:
    """Causes, and the reports of the robots that failed by them."""
    found = []
    for site in range(seed, seed + sites):
        for number in range(runs):
            for cause in causes:
                report = None if cause in LOOKALIKES and site % 2 == 0 else fail(cause, site, number)
                found += [] if report is None else [(cause, report)]
    return found


def fitted(causes: Sequence[str], found: Array) -> Array:
    """(3, 1 + figures) the weights of the most likely model of figures (N, figures), each cause counted alike."""
    known, names = np.column_stack([np.ones(len(found)), found]), list(causes)
    truths = np.array([VERDICTS.index(TRUTHS[cause]) for cause in names])
    counted = np.array([len(names) / len(set(names)) / names.count(name) for name in names])

    def loss(flat: Array) -> float:
        odds, sigmas = known @ flat.reshape(3, -1).T, np.tile([1.0] + found.shape[1] * [_PRIOR_SIGMA], 3)
        missed = logsumexp(odds, axis=1) - odds[np.arange(len(truths)), truths]
        return float(counted @ missed + 0.5 * ((flat / sigmas) ** 2).sum())

    return np.asarray(minimize(loss, np.zeros(3 * known.shape[1]), method="L-BFGS-B").x.reshape(3, -1))


def summary(found: Sequence[Judged], said: Sequence[Verdict]) -> dict[str, float]:
    """Areas under the curve of each verdict against the others, and shares of what was said."""
    truths = [TRUTHS[cause] for cause, _ in found]
    of = {"failures": float(len(found)), "evidence_bytes_max": max(len(encode_message(r.evidence)) for _, r in found)}
    for name in VERDICTS:
        is_own = np.array([truth == name for truth in truths])
        ranks = rankdata([getattr(each, name) for each in said])
        own, others = is_own.sum(), (~is_own).sum()
        of[f"auc_{name}"] = float((ranks[is_own].sum() - own * (own + 1) / 2) / (own * others)) if own * others else 1.0
    is_wrong = [each.says not in (truth, "unknown") for each, truth in zip(said, truths, strict=True)]
    is_sure = [max(each.robot, each.building, each.lookalike) > _CONFIDENT for each in said]
    of["confident_share"], of["wrong_share"] = float(np.mean(is_sure)), float(np.mean(is_wrong))
    of["confident_wrong"] = float(np.sum(np.logical_and(is_sure, is_wrong)))
    of["unknown_share"] = float(np.mean([each.says == "unknown" for each in said]))
    return of


def kept() -> tuple[list[str], Array, set[int]]:
    """Causes, figures and sites of the failures that the weights were fitted on: what `fail` gives for each site, number and cause."""
    with Path(__file__).with_name("failed_robots.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    figures = np.array([np.fromstring(row["figures"], sep=" ") for row in rows])
    return [row["cause"] for row in rows], figures, {int(row["site"]) for row in rows}


@benchmark(CAUSES, seed=981, sites=4, runs=20, fit=0)
def main(arguments: Options) -> Results:
    *fitted_on, sites = kept()
    if arguments.fit:
        return {"weights": fitted(*fitted_on).round(2).tolist()}
    if known := sites.intersection(range(arguments.seed, arguments.seed + arguments.sites)):
        raise UsageError(
            f"the weights were fitted on failures of sites {sorted(known)}: judge others, by --seed and --sites"
        )
    found = failures(arguments.seed, arguments.sites, arguments.runs, arguments.only)
    said = [verdict(report) for _, report in found]
    pairs = Counter((cause, each.says) for (cause, _), each in zip(found, said, strict=True))
    causes = {cause: {says: pairs[cause, says] for says in SAYS} for cause in arguments.only}
    return {"figures": summary(found, said), "causes": causes}
