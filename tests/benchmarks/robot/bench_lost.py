"""Robots that lose their place: carried, in the dark, at a wrong speed, with frames that do not arrive. Nothing may fail silently.

Each case has N runs (50), every second one with an IMU alone or with nothing beside the cameras, in four aisles that look the same but for
their ends; without pictures, but for dropped frames: those are of a rendered drive, kept in the work folder, since matches across a gap are
of pictures. Half of these drop frames at random, half in bursts of up to a second.
"""

from dataclasses import replace
from functools import lru_cache, partial
from math import inf
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.common import estimator_loop
from benchmarks.common.recorded_runs import Options, Results, benchmark, recorded, replayed, surveyed
from benchmarks.robot.aliased_starts import within_budget
from fleetmap.messages import Status
from fleetmap.recordings import open_recording
from fleetmap.relocalization.map_view import MapView
from fleetmap.sensors.samples import ImuSamples
from fleetmap.sources.source import ReplaySource
from fleetsim.motion import Route
from fleetsim.recorder import Order, Session
from fleetsim.scenarios import Run, Scenario
from fleetsim.scene.layout import Layout
from fleetsim.sensors import Fault
from locclient.localization.estimate import Estimate
from locclient.replay import run_metrics
from studies.robot_days.drives import judged
from support.estimator.landmarks import LandmarkField
from support.estimator.simulated_run import EstimatorSession, unpictured
from support.recordings.spoiled_recording import without_imu

LAYOUT = Layout(aisles=4, bays=8, are_aisles_identical=True)
_NAME, _END_M, _BEGIN_S, _AFTER_S = "lost", 2.7, 8.0, 12.0
_LEFT_M, _RIGHT_M = _END_M, LAYOUT.length_m - _END_M
_AIDS = {"carried": ("wheels", "IMU alone"), "pushed": ("wheels", "IMU alone")}  # of every second run
_DROPPED = "of frames dropped"
_SHARES, _SHORTEST_BURST, _LONGEST_BURST, _HEAD = (0.1, 0.3, 0.5, 0.7), 3, 16, 30


class Outcome(NamedTuple):
    """Of one run: failures by `fleetmap.failure_definition`, the share of frames TRACKING, the cause `carried`, and seconds from the first
    pull to LOST, inf if it was never said."""

    failures: int
    silent: int
    tracking_share: float
    says_carried: bool
    lost_s: float | None = None


def _route(rng: np.random.Generator, length_m: float) -> Route:
    """From the middle of an aisle to its end, into another one, and so on."""
    aisle, at_right = int(rng.integers(LAYOUT.aisles)), bool(rng.integers(2))
    points = [(float(rng.uniform(_LEFT_M + 8.0, _RIGHT_M - 8.0)), LAYOUT.aisle_y_m(aisle))]
    while length_m > 0.0:
        end_m = _RIGHT_M if at_right else _LEFT_M
        aisle = int(rng.choice([other for other in range(LAYOUT.aisles) if other != aisle]))
        points += [(end_m, points[-1][1]), (end_m, LAYOUT.aisle_y_m(aisle))]
        length_m -= abs(end_m - points[-3][0]) + abs(points[-1][1] - points[-2][1])
        at_right = not at_right
    return Route((*points, (points[-1][0] + (8.0 if at_right else -8.0), points[-1][1])))


def _prepared(seed: int, day: int, name: str, run: Run) -> Session:
    return unpictured(Order(_NAME, seed, day), Scenario("robots that lose their place", LAYOUT, {name: run}))


@lru_cache(maxsize=1)
def _map(seed: int) -> tuple[MapView, LandmarkField]:
    """The map of a survey of every aisle both ways, and the landmarks of the next day."""
    points: list[tuple[float, float]] = []
    for out, back in ((0, 1), (2, 3), (1, 0), (3, 2)):
        y_m, back_m = LAYOUT.aisle_y_m(out), LAYOUT.aisle_y_m(back)
        points += [] if points and points[-1] == (_LEFT_M, y_m) else [(_LEFT_M, y_m)]
        points += [(_RIGHT_M, y_m), (_RIGHT_M, back_m), (_LEFT_M, back_m)]
    survey = EstimatorSession(
        _prepared(seed, 0, "survey", Run("surveyor", (Route(tuple(points)),), 5.0, is_sharp=True))
    )
    (tile,), vocabulary = estimator_loop.survey_map(survey, np.random.default_rng(seed), every_m=0.8)
    tile = within_budget(tile, survey.camera, survey.body_from_cam)
    return MapView([tile], vocabulary, survey.camera.focal_px), LandmarkField(
        _prepared(seed, 1, "robot", Run("runner", (_route(np.random.default_rng(0), 1.0),))).world
    )


def _driven(
    seed: int, session: Session, *, has_imu: bool, has_wheels: bool
) -> tuple[Outcome, EstimatorSession, list[Estimate]]:
    view, field = _map(seed)
    if not has_imu:
        session = replace(session, imu=ImuSamples.empty(), nominal=replace(session.nominal, imu=None))
    run = EstimatorSession(session, field=field)
    estimates = estimator_loop.run_localizer(run, view, has_wheels=has_wheels)
    found = judged(estimates, run.map_from_body, run.stamps_ns)
    share = float(np.mean([e.status is Status.TRACKING for e in estimates]))
    return Outcome(found.failures, found.silent, share, any(e.cause == "carried" for e in estimates)), run, estimates


def _carried(seed: int, number: int) -> Outcome:
    """Lifted in one aisle, set down anywhere; every second run without wheels."""
    rng = np.random.default_rng([seed, 1, number])
    session = _prepared(seed, 1, f"carried-{number}", Run("runner", (_route(rng, 4.0), _route(rng, 6.0))))
    outcome, run, estimates = _driven(seed, session, has_imu=True, has_wheels=number % 2 == 0)
    heights_m = run.map_from_body[:, 2, 3]
    pulled = int(np.argmax(heights_m > heights_m[:_HEAD].max() + 0.005))
    said = [e.stamp_ns for e in estimates[pulled:] if e.status in (Status.LOST, Status.AMBIGUOUS)]
    return outcome._replace(lost_s=(said[0] - run.stamps_ns[pulled]) * 1e-9 if said else inf)


def _dark(seed: int, number: int) -> Outcome:
    """2 to 300 s without light, while it drives on; every second run without IMU."""
    rng = np.random.default_rng([seed, 2, number])
    dark_s = float(np.exp(rng.uniform(np.log(2.0), np.log(300.0))))
    fault = Fault("camera-dark", _BEGIN_S, _BEGIN_S + dark_s)
    session = _prepared(
        seed, 1, f"dark-{number}", Run("runner", (_route(rng, 1.5 * (dark_s + _BEGIN_S + _AFTER_S)),), faults=(fault,))
    )
    times_s = tuple(t for t in session.frame_times_s if t < fault.end_s + _AFTER_S)
    return _driven(seed, replace(session, frame_times_s=times_s), has_imu=number % 2 == 0, has_wheels=False)[0]


def _pushed(seed: int, number: int) -> Outcome:
    """The IMU feels a push of 1 to 3 m/s that the robot never had."""
    rng = np.random.default_rng([seed, 3, number])
    session = _prepared(seed, 1, f"pushed-{number}", Run("runner", (_route(rng, 12.0),)))
    imu, angle_rad = session.imu, float(rng.uniform(0.0, 2.0 * np.pi))
    times_s = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9
    push_mps2 = float(rng.uniform(1.0, 3.0)) / 0.2 * np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
    accel = imu.accel_mps2 + ((times_s > _BEGIN_S) & (times_s < _BEGIN_S + 0.2))[:, None] * push_mps2
    pushed = replace(session, imu=ImuSamples(imu.stamps_ns, imu.gyro_radps, accel))
    return _driven(seed, pushed, has_imu=True, has_wheels=number % 2 == 0)[0]


def _kept(count: int, share: float, in_bursts: bool, rng: np.random.Generator) -> NDArray[np.int64]:
    """Numbers of the frames that arrive."""
    kept = np.ones(count, bool) if in_bursts else rng.random(count) >= share
    first = _HEAD if in_bursts else count
    while first < count:
        burst = int(rng.integers(_SHORTEST_BURST, _LONGEST_BURST))
        kept[first : first + burst] = False
        first += burst + max(1, round(burst * (1 - share) / share * rng.uniform(0.5, 1.5)))
    kept[:_HEAD] = True
    return np.flatnonzero(kept)


def _dropped(work: Path, share: float, seed: int, number: int) -> Outcome:
    rng, store = np.random.default_rng([seed, 4, int(100 * share), number]), surveyed(work)
    with open_recording(recorded(work, ("--robot", "runner-1", "--day", "1"))) as recording:
        frames = _kept(len(recording.frame_stamps_ns), share, number % 4 >= 2, rng)
        seen = without_imu(recording) if number % 2 else recording
        result = replayed(ReplaySource(seen, frames, reverse=False), store)
    tracking = float(np.mean([frame.status is Status.TRACKING for frame in result.frames]))
    says_carried = any(e.cause == "carried" for e in result.estimates)
    silent = run_metrics.silent_failures(result.frames) or 0
    return Outcome(run_metrics.position_failures(result.frames), silent, tracking, says_carried)


def _figures(found: list[Outcome]) -> dict[str, float]:
    lost_s = [outcome.lost_s for outcome in found if outcome.lost_s is not None]
    return {
        "runs": len(found), "silent": sum(o.silent for o in found), "failures": sum(o.failures for o in found),
        "tracking_share": float(np.mean([o.tracking_share for o in found])), "says_carried": sum(o.says_carried for o in found),
        **({"lost_s_max": max(lost_s)} if lost_s else {}),
    }  # fmt: skip


CASES = {"carried": _carried, "dark for 2 to 300 s": _dark, "pushed": _pushed}
LOSSES = {f"{share:.0%} {_DROPPED}": share for share in _SHARES}


@benchmark([*CASES, *LOSSES], runs=50, seed=900)
def main(arguments: Options) -> Results:
    cases = CASES | {name: partial(_dropped, arguments.work, share) for name, share in LOSSES.items()}
    figures = {}
    for name in arguments.only:
        found = [cases[name](arguments.seed, number) for number in range(arguments.runs)]
        for half, aids in enumerate(_AIDS.get(name, ("IMU", "no IMU"))):
            figures[f"{name}, {aids}"] = _figures(found[half::2])
    dropped = {name: row for name, row in figures.items() if _DROPPED in name}
    return {"figures": figures, "dropped": dropped}
