"""How fast a survey is built, and how much memory a long one takes.

    python tests/benchmarks/bench_build.py [--recording FILE] [--minutes M] [--threads N] [--out FILE.json]

The speed is that of the five aisles, recorded on the way unless --recording names them, after a build of a short piece that loads
the compiled kernels. It is told for 20 frames a second whatever the recording's rate is: frames / 20 Hz / seconds, which is less than
what the recording itself would give, as half of a build goes by keyframes. The long recording is the same drive again and again,
left and entered where place, heading and velocity agree, stamps going on. So every lap is a revisit of all laps before: the worst case
for whatever grows with revisits.
"""

import argparse
import json
import os
import platform
import sys
import tempfile
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import bench_survey
from fleetmap.recordings import Recording, open_recording
from fleetmap.recordings.copying import copy_to_mcap
from fleetmap.recordings.images import StoredFrame, decode_frame
from fleetmap.samples import CameraFrame, ImuSamples, Trajectory

SPEED_LIMIT, MEMORY_LIMIT_MB = 3.0, 2000.0
_RATE_HZ = 20.0
FIVE_AISLES = next(case for case in bench_survey.CASES if case.name == "five-aisles")


@dataclass(frozen=True)
class _Laps:
    """The frames of a recording, the last ones again and again: index (F,) of each, and by how much its stamp is later (F,)."""

    recording: Recording
    index: NDArray[np.int64]
    later_ns: NDArray[np.int64]

    def stored(self, index: int) -> StoredFrame:
        frame = self.recording.stored_frame(int(self.index[index]))
        return replace(frame, stamp_ns=frame.stamp_ns + int(self.later_ns[index]))

    def frame(self, index: int) -> CameraFrame:
        return decode_frame(self.stored(index))

    def hash_into(self, digest: Any) -> None:
        self.recording.frames.hash_into(digest)

    def close(self) -> None:
        self.recording.close()


def repeated(recording: Recording, laps: int) -> Recording:
    """The recording up to where it is best left for an earlier place, and from there on again, `laps` times in all."""
    stamps_ns, truth = recording.frame_stamps_ns, recording.ground_truth
    assert truth is not None
    first, last = _seam(truth, stamps_ns)
    start_ns, lap_ns = int(stamps_ns[first]), int(stamps_ns[last] - stamps_ns[first])
    lap = np.arange(first, last)
    index = np.concatenate([np.arange(first), *([lap] * laps)])
    later_ns = np.repeat(np.arange(laps), [last, *([last - first] * (laps - 1))]) * lap_ns

    def again(stamps: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of other samples, and their stamps."""
        begun = np.flatnonzero(stamps < start_ns)
        inside = np.flatnonzero((stamps >= start_ns) & (stamps < start_ns + lap_ns))
        shifted = [stamps[inside] + number * lap_ns for number in range(laps)]
        return np.concatenate([begun, *([inside] * laps)]), np.concatenate([stamps[begun], *shifted])

    imu_rows, imu_ns = again(recording.imu.stamps_ns)
    truth_rows, truth_ns = again(truth.stamps_ns)
    wheel_rows, wheel_ns = again(np.array([sample.stamp_ns for sample in recording.wheel], np.int64))
    return replace(
        recording,
        frames=_Laps(recording, index, later_ns),
        frame_stamps_ns=stamps_ns[index] + later_ns,
        imu=ImuSamples(imu_ns, recording.imu.gyro_radps[imu_rows], recording.imu.accel_mps2[imu_rows]),
        wheel=tuple(
            replace(recording.wheel[row], stamp_ns=stamp_ns)
            for row, stamp_ns in zip(wheel_rows.tolist(), wheel_ns.tolist(), strict=True)
        ),
        ground_truth=Trajectory(truth_ns, truth.frame_from_body[truth_rows]),
    )


def _seam(truth: Trajectory, stamps_ns: NDArray[np.int64]) -> tuple[int, int]:
    """An early and a late frame between which the drive can jump: alike in place, heading and velocity."""
    nearest = np.clip(np.searchsorted(truth.stamps_ns, stamps_ns), 0, len(truth) - 1)
    places = truth.frame_from_body[nearest]
    seconds = (truth.stamps_ns[nearest] - truth.stamps_ns[nearest[0]]) * 1e-9
    state = np.hstack([places[:, :3, 3], np.gradient(places[:, :3, 3], seconds, axis=0), 3.0 * places[:, :3, 0]])
    half = len(stamps_ns) // 2
    apart = np.linalg.norm(state[:half, None] - state[None, half:], axis=2)
    first, last = np.unravel_index(np.argmin(apart), apart.shape)
    return int(first), half + int(last)


def build(recording: Path, folder: Path, frames: str, threads: int) -> dict[str, Any]:
    """The report of a build in a process of its own, its figures beside it."""
    report = folder / f"{recording.stem}.json"
    bench_survey.run(
        "mapserver.cli", "build", recording, "--site", recording.stem, "--store", folder / "store", "--report", report,
        "--frames", frames, "--threads", str(threads),
    )  # fmt: skip
    found: dict[str, Any] = json.loads(report.read_text("utf-8"))
    keys = ("frames", "keyframes", "duration_s", "seconds", "realtime_factor", "ate_rmse_m", "peak_rss_mb", "stage_s")
    return {key: found[key] for key in keys} | {"times_20_hz": found["frames"] / _RATE_HZ / found["seconds"]}


def measure(recording: Path | None, minutes: float, threads: int) -> dict[str, Any]:
    """Figures of the five aisles, and of the same for so many minutes (0 for none)."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        source = recording or bench_survey.recording_of(FIVE_AISLES, folder)
        assert source is not None
        for name in ("warm", "short"):  # links, as a site bears its recording's name
            (folder / f"{name}.mcap").symlink_to(source.resolve())
        build(folder / "warm.mcap", folder, ":100", threads)
        rows = {"five aisles": build(folder / "short.mcap", folder, "::", threads)}
        if minutes > 0:
            with open_recording(source) as opened:
                laps = int(np.ceil(60.0 * minutes / rows["five aisles"]["duration_s"])) + 1
                whole = repeated(opened, laps)
                copy_to_mcap(whole, folder / "long.mcap")
                enough = np.searchsorted(whole.frame_stamps_ns, whole.frame_stamps_ns[0] + int(60e9 * minutes))
            rows[f"{minutes:g} minutes"] = build(folder / "long.mcap", folder, f":{enough}", threads)
    return rows


def show(rows: dict[str, Any], threads: int) -> None:
    """Table and JSON."""
    print(f"{'recording':14} {'frames':>6} {'keyframes':>9} {'seconds':>8} {'x time':>7} {'x 20 Hz':>8} {'MB':>6}")
    for name, row in rows.items():
        print(
            f"{name:14} {row['frames']:6} {row['keyframes']:9} {row['seconds']:8.1f} {row['realtime_factor']:7.2f} "
            f"{row['times_20_hz']:8.2f} {row['peak_rss_mb']:6.0f}"
        )
        print("  " + ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in row["stage_s"].items()))
    machine = {
        "machine": platform.processor() or platform.machine(), "cores": os.cpu_count(), "load": os.getloadavg()[0],
        "threads": threads, "versions": {name: metadata.version(name) for name in bench_survey.LIBRARIES},
        "command": " ".join(sys.argv), "limits": {"times_20_hz": SPEED_LIMIT, "peak_rss_mb": MEMORY_LIMIT_MB},
    }  # fmt: skip
    print(json.dumps(machine | {"builds": rows}))


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    rows = measure(given.recording, given.minutes, given.threads)
    show(rows, given.threads)
    if given.out is not None:
        given.out.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
