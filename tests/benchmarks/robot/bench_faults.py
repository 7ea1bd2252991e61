"""What the localizer says while something is broken, and how soon all is well again: one line for each fault of the simulator.

Recordings and map are kept in the work folder, where bench_localization.py finds the same. A row is right when the status within a second
of the fault's beginning is one of those that are promised, nothing fails silently, and the robot tracks again soon after the fault's end.
"""

from typing import NamedTuple

import numpy as np

from benchmarks.common.recorded_runs import Options, Results, benchmark, played, recorded, surveyed
from fleetmap.failure_definition import ERROR_LIMIT_M
from fleetmap.messages import Status
from fleetsim.scenarios import SCENARIOS
from locclient.replay import run_metrics
from locclient.replay.run_result import ReplayResult

TRACKING, DEGRADED = {Status.TRACKING}, {Status.DEGRADED, Status.LOST}
# Robot of the scenario `faults`: statuses of which one must be said within WITHIN_S, cause that must be named ("" for none).
EXPECTED: dict[str, tuple[set[Status], str]] = {
    "dark": (DEGRADED, "dark"),
    "frozen": (DEGRADED, "frozen"),
    "person": (DEGRADED | TRACKING, ""),
    "dropped": (DEGRADED | TRACKING, ""),
    "imu-gap": (DEGRADED | TRACKING, ""),
    "imu-spike": (TRACKING, ""),
    "slip": (TRACKING, ""),
    "glare": (DEGRADED | TRACKING, ""),
    "kidnapped": ({Status.AMBIGUOUS, Status.LOST}, ""),
}
WITHIN_S, RECOVERY_S, RECOVERY_M = 1.0, 5.0, 20.0


class Outcome(NamedTuple):
    """How a fault went: seconds from its first frame until an expected status with the cause named, None for never; until tracking
    after its end, and the way driven meanwhile."""

    fault: str
    said_s: float | None
    recovered_s: float | None
    recovered_m: float | None
    silent_failures: int | None
    truth_outside_share: float

    @property
    def is_right(self) -> bool:
        """As promised."""
        soon = self.said_s is not None and self.said_s <= WITHIN_S
        if self.recovered_s is None or self.recovered_m is None:
            return False
        back = self.recovered_m <= RECOVERY_M if self.fault == "kidnapped" else self.recovered_s <= RECOVERY_S
        return soon and back and not self.silent_failures


def window_s(fault: str, result: ReplayResult) -> tuple[float, float]:
    """When the fault is in force, from the first frame on; a kidnapped robot's is the moment at which the truth jumps."""
    run = SCENARIOS["faults"]().run(fault)[1]
    if run.faults:
        return run.faults[0].start_s, run.faults[0].end_s
    positions = [truth[:3, 3] for truth in result.truths if truth is not None]
    jump = int(np.argmax(np.linalg.norm(np.diff(positions, axis=0), axis=1))) + 1
    moment_s = (result.frames[jump].stamp_ns - result.frames[0].stamp_ns) * 1e-9
    return moment_s, moment_s


def outcome(fault: str, result: ReplayResult) -> Outcome:
    """What was said about it."""
    statuses, cause = EXPECTED[fault]
    begin_s, end_s = window_s(fault, result)
    times_s = [(frame.stamp_ns - result.frames[0].stamp_ns) * 1e-9 for frame in result.frames]
    told_s = next(t for t in times_s if t >= begin_s)  # without frames there is nothing to estimate
    said = [
        t - told_s
        for t, e in zip(times_s, result.estimates, strict=True)
        if t >= told_s and e.status in statuses and (not cause or e.cause == cause)
    ]
    good = [
        k
        for k, (t, frame) in enumerate(zip(times_s, result.frames, strict=True))
        if t >= end_s
        and frame.status is Status.TRACKING
        and frame.error_m is not None
        and frame.error_m < ERROR_LIMIT_M
    ]
    first = next(k for k, t in enumerate(times_s) if t >= end_s)
    way = [truth[:3, 3] for truth in result.truths[first : good[0] + 1] if truth is not None] if good else []
    outside = [run_metrics.is_outside_its_bound(frame) for frame in result.frames]
    return Outcome(
        fault,
        said[0] if said else None,
        times_s[good[0]] - end_s if good else None,
        float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()) if good else None,
        run_metrics.silent_failures(result.frames),
        float(np.mean(outside)),
    )


@benchmark(EXPECTED)
def main(arguments: Options) -> Results:
    store, found = surveyed(arguments.work), []
    for name in arguments.only:
        recording = recorded(arguments.work, ("--robot", name, "--day", "1"), "faults")
        found.append(outcome(name, played(recording, store)))
    return {"faults": {o.fault: o._asdict() | {"is_right": o.is_right} for o in found}}
