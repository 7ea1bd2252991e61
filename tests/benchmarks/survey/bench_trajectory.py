"""Maps from another system's poses beside the map of our own odometry: truth with noise and drift, written in every wrong way.

`python tests/benchmarks/survey/bench_trajectory.py RECORDING [CASE...]` prints a table and JSON. The file never says which way it was
written: a case is built by the reading that was found, or asked for, with the option that then decides it.
"""

import argparse
import json
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from fleetmap.errors import UsageError
from fleetmap.geometry import Array, quat_wxyz_from_rotation, se3, se3_exp, se3_inverse, so3_exp
from fleetmap.recordings import Recording, open_recording
from mapserver import BuildOptions, build_map
from mapserver.build.trajectory import OtherTrajectory

RATIO_LIMIT = 1.10
NOISE_RAD, NOISE_M = 1e-3, 3e-3  # of every pose
WALK_RAD, WALK_M = 2e-3, 1e-2  # after one metre: a hundredth of the way
SEED = 5


@dataclass(frozen=True, slots=True)
class Wrong:
    """A way of writing poses; the right answers, for where they are asked for."""

    frame: str = "body"
    direction: str = "map-from-pose"
    quaternion: str = "xyzw"
    stamps: str = "s"
    scale: float = 1.0
    kept: Callable[[int], bool] = lambda _: True


CASES = {
    "noise and drift": Wrong(),
    "of the camera": Wrong(frame="camera"),
    "inverted": Wrong(direction="pose-from-map"),
    "inverted, of the camera": Wrong(frame="camera", direction="pose-from-map"),
    "quaternions wxyz": Wrong(quaternion="wxyz"),
    "nanoseconds": Wrong(stamps="ns"),
    "unknown scale": Wrong(frame="camera", scale=0.37),
    "every third missing": Wrong(kept=lambda number: number % 3 != 2),
}


@dataclass(frozen=True, slots=True)
class Row:
    """One map. asked: what the build asked for; ratio: its error over that of our own odometry's map."""

    case: str
    ate_m: float
    ratio: float
    asked: str
    said: str


def guess(recording: Recording, rng: np.random.Generator) -> tuple[list[int], Array]:
    """Stamps (N,) of the frames with a truth, and other_from_body (N, 4, 4): the truth with noise and drift in a tilted frame."""
    truth = recording.ground_truth
    assert truth is not None
    stamps = [stamp for stamp in recording.frame_stamps_ns.tolist() if truth.at(stamp) is not None]
    true = np.array([truth.at(stamp) for stamp in stamps])
    walked = [se3(so3_exp(np.array([0.4, -0.3, 0.2])), np.array([3.0, 1.0, 0.5]))]
    for before, after in pairwise(true):
        step = se3_inverse(before) @ after
        spread = np.sqrt(np.linalg.norm(step[:3, 3])) * np.repeat([WALK_RAD, WALK_M], 3)
        walked.append(walked[-1] @ step @ se3_exp(spread * rng.normal(size=6)))
    noise = np.repeat([NOISE_RAD, NOISE_M], 3)
    return stamps, np.array([other_from_body @ se3_exp(noise * rng.normal(size=6)) for other_from_body in walked])


def write(file: Path, recording: Recording, wrong: Wrong) -> None:
    """The file of a case."""
    stamps, other_from_body = guess(recording, np.random.default_rng(SEED))
    mounting = recording.calibration.cameras[0].body_from_cam
    written = other_from_body @ (mounting if wrong.frame == "camera" else np.eye(4))
    written[:, :3, 3] /= wrong.scale
    if wrong.direction != "map-from-pose":
        written = se3_inverse(written)
    lines = []
    for number, (stamp, matrix) in enumerate(zip(stamps, written, strict=True)):
        w, x, y, z = quat_wxyz_from_rotation(matrix[:3, :3])
        turn = (x, y, z, w) if wrong.quaternion == "xyzw" else (w, x, y, z)
        time = str(stamp) if wrong.stamps == "ns" else f"{stamp // 10**9}.{stamp % 10**9:09d}"
        if wrong.kept(number):
            lines.append(" ".join([time, *(f"{value:.7f}" for value in (*matrix[:3, 3], *turn))]))
    file.write_text("\n".join(lines) + "\n", "ascii")


def bench(path: Path, names: Iterable[str] = CASES) -> list[Row]:
    """Our own map first, then one for each case."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        own_m = build_map(path, Path(folder) / "maps", "own").report["ate_rmse_m"]
        rows.append(Row("our own odometry", own_m, 1.0, "", ""))
        for number, name in enumerate(names):
            wrong, file = CASES[name], Path(folder) / "poses.txt"
            with open_recording(path) as recording:
                write(file, recording, wrong)
            other, asked = OtherTrajectory(file, "tum"), ""
            for _ in range(2):
                try:
                    done = build_map(path, Path(folder) / "maps", f"case-{number}", BuildOptions(trajectory=other))
                except UsageError as error:
                    items = [item for item in (*other.said(), "scale") if f"--trajectory-{item} " in str(error)]
                    asked = ", ".join(items)
                    other = replace(other, **{item: getattr(wrong, item) for item in items})
                    continue
                said = [
                    words for words in next(iter(done.report["findings"].values())) if words.startswith("trajectory ")
                ]
                ate_m = done.report["ate_rmse_m"]
                rows.append(Row(name, ate_m, ate_m / own_m, asked, said[0]))
                break
            print(json.dumps(asdict(rows[-1])), flush=True)
    return rows


def show(rows: list[Row]) -> None:
    """The table."""
    for row in rows:
        print(f"{row.case:26s} {1000 * row.ate_m:7.2f} mm  {row.ratio:5.3f}  {row.asked or '-':20s} {row.said}")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("cases", nargs="*", choices=[[], *CASES])
    given = parser.parse_args()
    show(bench(given.recording, given.cases or CASES))


if __name__ == "__main__":
    main()
