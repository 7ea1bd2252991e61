"""Robots whose IMU falls silent, and robots too slow for their frames: TRACKING only within three sigmas of the truth.

On N sites (5) a drive of the next day is replayed with 12 gaps of 0.25, 0.5 or 1 s in the IMU's samples, half of them at a time, with and
without wheels, or with a gyro that repeats its sample for 0.5 s; with 0, 25, 50 or 75 % of its frames missing at random; and begun on the
way, without wheels and a coarse position, for 40 frames each.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.common.recorded_runs import Options, Results, benchmark, recorded, replayed, surveyed
from fleetmap.messages import Status
from fleetmap.recordings import Recording, open_recording
from fleetmap.sensors.samples import ImuSamples
from fleetmap.sources.source import ReplaySource
from locclient.replay.run_metrics import FrameRecord

_GAPS_S, _SHARES = (0.25, 0.5, 1.0), (0.0, 0.25, 0.5, 0.75)
_FIRST_S, _EVERY_S, _PLACES = 2.0, 1.5, 12
CASES = {
    **{f"gaps of {gap_s:g} s{aid}": (gap_s, aid) for gap_s in _GAPS_S for aid in ("", ", no wheels")},
    **{f"{share:.0%} of frames dropped": (share, None) for share in _SHARES},
    "frozen gyro for 0.5 s": (0.5, "frozen"),
    "starts in motion, no wheels": (0.0, "starts"),
}
_STARTS, _START_FRAMES = range(60, 200, 7), 40


def _with_gaps(recording: Recording, gap_s: float, half: int, *, is_frozen: bool) -> Recording:
    imu = recording.imu
    times_s = (imu.stamps_ns - recording.frame_stamps_ns[0]) * 1e-9 - _FIRST_S - half * _EVERY_S
    places, since_s = np.divmod(times_s, 2 * _EVERY_S)
    kept = (places < 0) | (2 * places >= _PLACES) | (since_s >= gap_s)
    if is_frozen:
        newest = np.maximum.accumulate(np.where(kept, np.arange(len(imu)), 0))
        return replace(recording, imu=replace(imu, gyro_radps=imu.gyro_radps[newest]))
    return replace(recording, imu=ImuSamples(imu.stamps_ns[kept], imu.gyro_radps[kept], imu.accel_mps2[kept]))


def _drives(recording: Recording, case: str, seed: int) -> Iterator[ReplaySource]:
    """The replays of one case."""
    amount, aid = CASES[case]
    count = len(recording.frame_stamps_ns)
    if aid is None:
        kept = np.random.default_rng([seed, int(100 * amount)]).random(count) >= amount
        yield ReplaySource(recording, np.flatnonzero(kept), reverse=False)
        return
    if aid == "starts":
        for first in _STARTS:
            yield ReplaySource(
                replace(recording, wheel=[], priors=[]), np.arange(first, first + _START_FRAMES), reverse=False
            )
        return
    for half in range(2):
        with_wheels = replace(recording, wheel=[]) if aid == ", no wheels" else recording
        spoiled = _with_gaps(with_wheels, amount, half, is_frozen=aid == "frozen")
        yield ReplaySource(spoiled, np.arange(count), reverse=False)


def _is_beyond(frame: FrameRecord) -> bool:
    if frame.error_map_m is None or frame.cov_rot_trans is None:
        return False
    sigma_m = np.sqrt(np.linalg.eigvalsh(frame.cov_rot_trans[3:, 3:])[-1])
    return bool(np.linalg.norm(frame.error_map_m) > 3.0 * sigma_m)


@benchmark(CASES, seed=1, sites=5)
def main(arguments: Options) -> Results:
    frames: dict[str, list[FrameRecord]] = {name: [] for name in arguments.only}
    for seed in range(arguments.seed, arguments.seed + arguments.sites):
        store = surveyed(arguments.work, seed)
        path = recorded(arguments.work, ("--robot", "tote-1", "--day", "1", "--seed", str(seed)))
        with open_recording(path) as recording:
            for case in frames:
                for source in _drives(recording, case, seed):
                    frames[case] += replayed(source, store).frames
    figures = {}
    for case, found in frames.items():
        tracking = [frame for frame in found if frame.status is Status.TRACKING]
        figures[case] = {
            "tracking_share": len(tracking) / len(found),
            "tracking_beyond": sum(map(_is_beyond, tracking)),
            "largest_m": max(frame.error_m or 0.0 for frame in tracking),
        }
    return {"figures": figures}
