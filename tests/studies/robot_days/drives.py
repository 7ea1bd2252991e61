"""Drives of one situation under one configuration: the localizer in the loop, judged by the definition of a failure."""

import copy
import zlib
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from benchmarks.common import estimator_loop
from benchmarks.robot.aliased_starts import RememberingSession, prior_at
from fleetmap.geometry import Array, rotation_angle_rad
from fleetmap.sensors.samples import ImuSamples, PositionPrior
from locclient.localization.estimate import Estimate
from locclient.replay import run_metrics
from locclient.replay.run_metrics import FrameRecord
from studies.robot_days.configurations import Configuration
from studies.robot_days.site import LAYOUT, driven, surveyed_site
from studies.robot_days.situations import SITUATIONS, Prior

_DOCK_SIGMA_M, _TOLD_SIGMA_M = 0.05, 0.5
_SILENT_S = 1.0
DRIVES = 2  # of a batch


@dataclass(frozen=True, slots=True)
class Drive:
    """One drive's outcome. kinds: how many failures of each kind; one failure may be of two."""

    hours: float
    failures: int
    silent: int
    kinds: dict[str, int]
    errors_m: Array


@dataclass(frozen=True, slots=True)
class Batch:
    """Drives of one situation at one site. number: of the batch, from 0."""

    situation: str
    seed: int
    number: int

    def day(self, configuration: Configuration) -> int:
        """Nights since the survey."""
        days = SITUATIONS[self.situation].days
        return configuration.day or days[self.number % len(days)]

    def generator(self, number: int) -> np.random.Generator:
        """What is random in the batch's drive of that number."""
        return np.random.default_rng([self.seed, zlib.crc32(self.situation.encode()), self.number, number])


@lru_cache(maxsize=DRIVES)
def _session(batch: Batch, number: int, day: int) -> RememberingSession:
    trip = SITUATIONS[batch.situation].trip(batch.generator(number))
    return driven(batch.seed, day, trip, f"{batch.situation}-{batch.number}-{number}")


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


def drive(batch: Batch, number: int, configuration: Configuration) -> Drive:
    """The batch's drive of that number; equal arguments give equal outcomes."""
    session = _session(batch, number, batch.day(configuration))
    prior = _prior(session, SITUATIONS[batch.situation].prior, batch.generator(1000 + number))
    seen = session if configuration.has_imu else _without_imu(session)
    view, has_wheels = surveyed_site(batch.seed).view, configuration.has_imu
    estimates = estimator_loop.run_localizer(seen, view, prior, has_wheels=has_wheels, settings=configuration.settings)
    return judged(estimates, session.map_from_body, session.stamps_ns)


def judged(estimates: list[Estimate], map_from_body: Array, stamps_ns: list[int]) -> Drive:
    """Failures of the estimates against the truth."""
    moved_m = np.linalg.norm(np.diff(map_from_body[:, :3, 3], axis=0, prepend=map_from_body[:1, :3, 3]), axis=1)
    lasted_s = np.diff(np.array(stamps_ns) * 1e-9, prepend=stamps_ns[0] * 1e-9 - 1.0)
    speeds = moved_m / lasted_s
    frames = [_record(e, t, float(v)) for e, t, v in zip(estimates, map_from_body, speeds, strict=True)]
    kinds = {
        "silent": run_metrics.silent_failures(frames) or 0,
        "overconfident": len(run_metrics._episodes(frames, run_metrics._is_overconfident, _SILENT_S)),
        "not found": len(run_metrics.not_found(frames)),
    }
    failures = run_metrics.position_failures(frames)
    kinds["blind"] = int(failures > 0 and not any(kinds.values())) * failures
    errors = np.array([f.error_m for f in frames if f.error_m is not None and f.status == "TRACKING"])
    return Drive((stamps_ns[-1] - stamps_ns[0]) / 3.6e12, failures, kinds["silent"], kinds, errors)


def _record(estimate: Estimate, truth: Array, speed_mps: float) -> FrameRecord:
    error_map_m, error_rad = None, None
    if estimate.map_from_body is not None:
        error_map_m = estimate.map_from_body[:3, 3] - truth[:3, 3]
        error_rad = rotation_angle_rad(estimate.map_from_body[:3, :3].T @ truth[:3, :3])
    return FrameRecord(
        estimate.stamp_ns, estimate.status, estimate.fix is not None, estimate.cov_rot_trans, error_map_m, error_rad,
        0.0, 0.0, {}, speed_mps,
    )  # fmt: skip


def row_of(batch: Batch, configuration: Configuration, count: int = DRIVES) -> dict[str, object]:
    """A batch's first drives under a configuration, as they are kept. exposure: hours, or events where the situation has some."""
    drives = [drive(batch, number, configuration) for number in range(count)]
    events, errors = SITUATIONS[batch.situation].events, np.concatenate([d.errors_m for d in drives])
    hours = round(sum(d.hours for d in drives), 4)
    kinds = {kind: sum(d.kinds[kind] for d in drives) for kind in drives[0].kinds}
    return {
        "situation": batch.situation,
        "seed": batch.seed,
        "day": batch.day(configuration),
        "hours": hours,
        "exposure": len(drives) * events if events else hours,
        "failures": " ".join(str(d.failures) for d in drives),
        "silent": " ".join(str(d.silent) for d in drives),
        "kinds": ", ".join(f"{kind} {count}" for kind, count in kinds.items() if count),
        "p99_mm": round(1e3 * float(np.percentile(errors, 99)), 1) if len(errors) else None,
    }
