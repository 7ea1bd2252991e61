"""Drives of one situation under one configuration: the localizer in the loop, judged by the definition of a failure."""

import copy
from dataclasses import replace
from functools import lru_cache
from math import inf
from typing import NamedTuple

import msgspec
import numpy as np

from benchmarks.common import estimator_loop
from benchmarks.robot.aliased_starts import WHOLE_SITE, RememberingSession, prior_at
from fleetmap.geometry import Array, rotation_angle_rad
from fleetmap.sensors.samples import ImuSamples, PositionPrior
from locclient.localization.estimate import Estimate
from locclient.localization.settings import LocalizerSettings
from locclient.replay import run_metrics
from locclient.replay.run_metrics import FrameRecord
from studies.robot_days.site import LAYOUT, Trip, driven, surveyed_view
from studies.robot_days.situations import SITUATIONS, Prior

_DOCK_SIGMA_M, _TOLD_SIGMA_M = 0.05, 0.5
_SILENT_S = 1.0
_COUNTED_S = 3.0  # an event that begins later than so long before the end is not counted, nor a failure that it might have led to


class Configuration(NamedTuple):
    """The whole system but for what is taken away. day: nights since the survey on every trip, None for each trip's own."""

    settings: LocalizerSettings = WHOLE_SITE
    has_imu: bool = True
    day: int | None = None


def _tracks(**changes: float) -> LocalizerSettings:
    return msgspec.structs.replace(WHOLE_SITE, track=msgspec.structs.replace(WHOLE_SITE.track, **changes))


_TAKES_BEST = {
    "competitor_share": inf, "competitor_recall_share": inf, "strong_alias_share": inf, "confirming_fixes": 1, "confirming_distance_m": 0.0,
}  # fmt: skip
FULL = "the whole system"
CONFIGURATIONS = {
    FULL: Configuration(),
    "no IMU, no wheels": Configuration(has_imu=False),
    "map 7 nights old": Configuration(day=7),
    "no AMBIGUOUS": Configuration(_tracks(**_TAKES_BEST)),
    "no covariance gate": Configuration(_tracks(innovation_limit=inf)),
}


class Drive(NamedTuple):
    """One drive's outcome. kinds: how many failures of each kind; one failure may be of two."""

    hours: float
    failures: int
    silent: int
    kinds: dict[str, int]
    errors_m: Array


@lru_cache(maxsize=1)
def _session(situation: str, seed: int, number: int, day: int) -> tuple[Trip, RememberingSession]:
    trip = SITUATIONS[situation].trip_of(seed, number)
    return trip, driven(seed, day, trip)


def _prior(session: RememberingSession, kind: Prior, rng: np.random.Generator) -> PositionPrior | None:
    """What the robot is told where it begins; a person who names the wrong aisle knows it to half a metre otherwise."""
    if kind == "none":
        return None
    if kind == "dock":
        return prior_at(session, _DOCK_SIGMA_M, rng)
    prior = prior_at(session, _TOLD_SIGMA_M, rng)
    own = int(LAYOUT.chunk_at(*prior.map_from_base[:2, 3])[1])
    other = int(rng.choice([aisle for aisle in range(LAYOUT.aisles) if aisle != own]))
    prior.map_from_base[1, 3] += LAYOUT.aisle_y_m(other) - LAYOUT.aisle_y_m(own)
    return replace(prior, is_revisable=True)


def _without_imu(session: RememberingSession) -> RememberingSession:
    blind = copy.copy(session)
    nominal = replace(session.session.nominal, imu=None)
    blind.session = replace(session.session, imu=ImuSamples.empty(), nominal=nominal)
    return blind


def judged(estimates: list[Estimate], map_from_body: Array, stamps_ns: list[int]) -> Drive:
    """Failures of the estimates against the truth."""
    moved_m = np.linalg.norm(np.diff(map_from_body[:, :3, 3], axis=0, prepend=map_from_body[:1, :3, 3]), axis=1)
    lasted_s = np.diff(np.array(stamps_ns) * 1e-9, prepend=stamps_ns[0] * 1e-9 - 1.0)
    speeds = moved_m / lasted_s
    frames = [_record(e, t, float(v)) for e, t, v in zip(estimates, map_from_body, speeds, strict=True)]
    kinds = {
        "silent": run_metrics.silent_failures(frames) or 0,
        "overconfident": len(run_metrics._episodes(frames, run_metrics.is_outside_its_bound, _SILENT_S)),
        "not found": len(run_metrics.not_found(frames)),
    }
    failures = run_metrics.position_failures(frames)
    kinds["blind"] = int(failures > 0 and not any(kinds.values())) * failures
    errors = np.array([f.error_m for f in frames if f.error_m is not None and f.status == "TRACKING"])
    hours = (stamps_ns[-1] - stamps_ns[0]) / 3.6e12
    return Drive(hours, failures, kinds["silent"], kinds, errors)


def _record(estimate: Estimate, truth: Array, speed_mps: float) -> FrameRecord:
    error_map_m, error_rad = None, None
    if estimate.map_from_body is not None:
        error_map_m = estimate.map_from_body[:3, 3] - truth[:3, 3]
        error_rad = rotation_angle_rad(estimate.map_from_body[:3, :3].T @ truth[:3, :3])
    return FrameRecord(
        estimate.stamp_ns, estimate.status, estimate.fix is not None, estimate.cov_rot_trans, error_map_m, error_rad,
        0.0, 0.0, {}, speed_mps,
    )  # fmt: skip


def row_of(situation: str, seed: int, number: int, configuration: Configuration) -> dict[str, object]:
    """A situation's drive of that number under a configuration, as it is kept; equal arguments give equal rows.

    exposure: hours, or events where the situation has some.
    """
    about = SITUATIONS[situation]
    day = configuration.day or about.day(number)
    trip, session = _session(situation, seed, number, day)
    prior = _prior(session, about.prior, np.random.default_rng([seed, 7004, number]))
    seen = session if configuration.has_imu else _without_imu(session)
    view, has_wheels = surveyed_view(seed), configuration.has_imu
    estimates = estimator_loop.run_localizer(seen, view, prior, has_wheels=has_wheels, settings=configuration.settings)
    found = judged(estimates, session.map_from_body, session.stamps_ns)
    events = len(trip.movers) or sum(fault.start_s < 3600 * found.hours - _COUNTED_S for fault in trip.faults) or 1
    hours = round(found.hours, 5)
    return {
        "situation": situation, "seed": seed, "day": day, "hours": hours,
        "exposure": hours if about.kind == "hours" else events,
        "failures": found.failures, "silent": found.silent,
        "kinds": ", ".join(f"{kind} {count}" for kind, count in found.kinds.items() if count),
        "p99_mm": round(1e3 * float(np.percentile(found.errors_m, 99)), 1) if len(found.errors_m) else None,
    }  # fmt: skip
