"""CPU time, memory and error of a map beside ORB-SLAM3's of the same pairs, on the same machine, in turns.

ORB-SLAM3 (GPL) is a program apart: its wheel lies in an environment of its own and is given files. Its start and the loading of its
vocabulary are not counted, of `mapserver build` all is.
"""

import os
import subprocess
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from benchmarks.common.recorded_runs import SITE, kept_folder, recorded, tool
from fleetmap.bow.vocabulary import Vocabulary, default_vocabulary
from fleetmap.geometry import se3_inverse
from fleetmap.recordings import Recording, open_recording
from fleetmap.recordings.tum import read_tum
from fleetmap.sensors.calibration import CameraCalibration
from fleetmap.sensors.samples import Trajectory
from mapserver.evaluation.trajectory_error import absolute_trajectory_error
from studies.study import Column, Row, environment, publish, results, study, table
from support.recordings.realdata import DATA

PROGRAM = Path(__file__).with_name("orb_slam3_program.py")
WHEELS = "orb-slam3", "pyorbslam3==0.1.1", f"opencv-python-headless=={version('opencv-python-headless')}"
_TURNS = int(os.environ.get("TURNS") or 3)
_WITHOUT_DENSE = "import sys; sys.modules['mapserver.plugins.dense_maps'] = None; "  # as if its folder were deleted
# Its authors' for EuRoC; the viewer's are asked for and not used.
_VIEWER = "KeyFrameSize KeyFrameLineWidth GraphLineWidth PointSize CameraSize CameraLineWidth ViewpointX ViewpointY ViewpointZ ViewpointF"
_SETTINGS = {
    "File.version": '"1.0"', "Camera.type": '"PinHole"', "Camera.RGB": 1, "Stereo.ThDepth": 60.0, "ORBextractor.nFeatures": 1200,
    "ORBextractor.scaleFactor": 1.2, "ORBextractor.nLevels": 8, "ORBextractor.iniThFAST": 20, "ORBextractor.minThFAST": 7,
    **{f"Viewer.{key}": 1.0 for key in _VIEWER.split()},
}  # fmt: skip


class Ran(NamedTuple):
    """A run of one system: CPU seconds with those of its children, largest memory of one process in 10^6 bytes, error in mm."""

    cpu_s: float
    rss_mb: float
    ate_mm: float


def vocabulary_text(tree: Vocabulary) -> str:
    """Our vocabulary as ORB-SLAM3 reads one: branching, levels, L1 norm, tf-idf; of each node parent, leaf or not, 32 bytes and weight.

    ORB-SLAM3 compares features below the same node four levels above the words: of its authors' six levels the second, of our four
    the root. So six are said.
    """
    parents = np.repeat(np.arange(len(tree.centres)), tree.child_count)
    is_leaf = tree.child_count == 0
    weights = np.zeros(len(is_leaf))
    weights[is_leaf] = tree.idf
    numbers = np.column_stack([parents, is_leaf[1:], tree.centres[1:].astype("<u8").view(np.uint8)]).tolist()
    lines = [f"{' '.join(map(str, row))} {weight:.6f}" for row, weight in zip(numbers, weights[1:], strict=True)]
    return "\n".join(["10 6 0 0", *lines])


def lens_of(camera: CameraCalibration) -> list[float]:
    """fx, fy, cx, cy, k1, k2, p1, p2; ValueError of another model."""
    if camera.model != "radial-tangential" or len(camera.distortion) > 4:
        raise ValueError(f"a {camera.model} lens is not put into the settings of other programs here")
    return np.append([*camera.intrinsics_px, *camera.distortion], np.zeros(4 - len(camera.distortion))).tolist()


def settings_text(recording: Recording) -> str:
    """The settings file of a recording's pair; it rectifies by itself."""
    pair = [recording.calibration.cameras[number] for number in recording.calibration.views[0]]
    size = {"Camera.width": pair[0].width_px, "Camera.height": pair[0].height_px}
    rate = {"Camera.fps": round(1e9 / float(np.median(np.diff(recording.frame_stamps_ns))))}
    left_from_right = se3_inverse(pair[0].body_from_cam) @ pair[1].body_from_cam
    mounting = f"!!opencv-matrix\n  rows: 4\n  cols: 4\n  dt: f\n  data: {left_from_right.ravel().tolist()}"
    lenses = {}
    for number, camera in enumerate(pair, start=1):
        keys = "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"
        lenses |= {f"Camera{number}.{key}": value for key, value in zip(keys, lens_of(camera), strict=True)}
    settings = _SETTINGS | size | rate | lenses | {"Stereo.T_c1_c2": mounting}
    return "%YAML:1.0\n" + "".join(f"{key}: {value}\n" for key, value in settings.items())


def export(recording: Recording, folder: Path) -> None:
    """Writes what the program reads; the images as they are stored."""
    (folder / "vocabulary.txt").write_text(vocabulary_text(default_vocabulary()))
    (folder / "settings.yaml").write_text(settings_text(recording))
    begin_ns = recording.frame_stamps_ns[0]
    (folder / "stamps.txt").write_text(
        "\n".join(f"{1e-9 * (stamp - begin_ns):.9f}" for stamp in recording.frame_stamps_ns)
    )
    export_images(recording, range(len(recording)), folder)


def export_images(recording: Recording, frames: Iterable[int], folder: Path) -> None:
    """Writes the images of these frames as they are stored."""
    for number in frames:
        stored = recording.stored_frame(number)
        for side, image in (("left", stored.left), ("right", stored.right)):
            assert image is not None and image.encoding == "file"
            (folder / side).mkdir(parents=True, exist_ok=True)
            (folder / side / f"{number:06d}.png").write_bytes(image.data)


def measured(command: Sequence[str | Path]) -> tuple[float, float]:
    """CPU seconds and largest memory, in 10^6 bytes, of a command and its children; RuntimeError with its last words where it fails."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        words = process.stdout.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{command[0]} ended with {process.returncode}: {words[-2000:]}")
    return used.ru_utime + used.ru_stime, 1.024e-3 * used.ru_maxrss


def ate_mm(world_from_left: Trajectory, recording: Recording, pairs: int) -> float:
    """Root mean square of the left camera's position errors over so many pairs, rigidly aligned; infinite where one has no pose.

    Of rectification's turn of the camera nothing is seen.
    """
    truth = recording.ground_truth
    true = Trajectory(truth.stamps_ns, truth.frame_from_body @ body_from_left(recording))
    found = absolute_trajectory_error(world_from_left, true, frames=pairs)
    return 1e3 * found.rmse_m if len(world_from_left) > 0.99 * pairs else float("inf")


def body_from_left(recording: Recording) -> np.ndarray:
    return recording.calibration.cameras[recording.calibration.views[0][0]].body_from_cam


def orb_slam3(recording: Recording, files: Path) -> Ran:
    """A run of ORB-SLAM3."""
    cpu_s, rss_mb = measured([environment(*WHEELS) / "bin" / "python", PROGRAM, files])
    found = read_tum(files / "poses.tum")
    moved = Trajectory(found.stamps_ns + recording.frame_stamps_ns[0], found.frame_from_body)
    return Ran(cpu_s - float((files / "begun.txt").read_text()), rss_mb, ate_mm(moved, recording, len(recording)))


def mapserver(recording: Recording, *, with_dense: bool) -> Ran:
    """A build into a new store, with its checks."""
    program, flag, main = tool("mapserver")
    with TemporaryDirectory() as scratch:
        out = Path(scratch) / "out.tum"
        to_store = ["--site", SITE, "--store", f"{scratch}/store", "--trajectory-out", str(out)]
        main = main if with_dense else _WITHOUT_DENSE + main
        cpu_s, rss_mb = measured([program, flag, main, "build", str(recording.path), *to_store])
        found = read_tum(out)
    left = Trajectory(found.stamps_ns, found.frame_from_body @ body_from_left(recording))
    return Ran(cpu_s, rss_mb, ate_mm(left, recording, len(recording)))


def case(name: str, path: Callable[[], Path], most: float, most_dense: float) -> Row:
    """Rounds of the three in turns; medians, and those of the rounds' ratios."""
    with open_recording(path()) as recording, TemporaryDirectory() as scratch:
        export(recording, Path(scratch))
        ours = partial(mapserver, recording, with_dense=False), partial(mapserver, recording, with_dense=True)
        rounds = [[run() for run in (*ours, partial(orb_slam3, recording, Path(scratch)))] for _ in range(_TURNS)]
        row: Row = {"recording": name, "pairs": len(recording), "most": most, "most_dense": most_dense, "turns": _TURNS}
    for system, runs in zip(("bare", "dense", "orb"), zip(*rounds, strict=True), strict=True):
        for key, values in zip(Ran._fields, zip(*runs, strict=True), strict=True):
            row[f"{system}_{key}"] = round(median(values), 2)
    for number, system in enumerate(("bare", "dense")):
        row[f"{system}_ratio"] = round(median(runs[number].cpu_s / runs[2].cpu_s for runs in rounds), 3)
    return row


def _simulated(scenario: str) -> Path:
    kept_folder().mkdir(parents=True, exist_ok=True)
    return recorded(kept_folder(), ("--seed", "1"), scenario)


CASES: dict[str, Callable[[], Row]] = {
    "five-aisles": partial(case, "five aisles", partial(_simulated, "five-aisles"), 0.75, 0.85),
    "small-loop": partial(case, "small loop", partial(_simulated, "small-loop"), 0.75, 0.85),
    "euroc_mh01_start": partial(case, "EuRoC MH_01, first 15 s", lambda: DATA / "euroc_mh01_start", 0.9, 1.0),
}
COLUMNS = [
    Column("recording", "recording"), Column("pairs", "pairs"), Column("orb_cpu_s", "ORB-SLAM3, CPU s", "{:.1f}"),
    Column("bare_cpu_s", "build without grid and surfels", "{:.1f}"), Column("bare_ratio", "of ORB-SLAM3's", "**{:.2f}**"),
    Column("most", "at most"), Column("dense_cpu_s", "whole build", "{:.1f}"), Column("dense_ratio", "of ORB-SLAM3's", "**{:.2f}**"),
    Column("most_dense", "at most"), Column("orb_ate_mm", "ORB-SLAM3, mm", "{:.1f}"), Column("bare_ate_mm", "build, mm", "{:.1f}"),
    Column("orb_rss_mb", "ORB-SLAM3, MB", "{:.0f}"), Column("bare_rss_mb", "build, MB", "{:.0f}"), Column("turns", "turns"),
]  # fmt: skip


@study
def main() -> None:
    """The table of docs/studies/orb_slam3.md. TURNS=5: so many rounds of a recording."""
    environment(*WHEELS)
    publish("orb_slam3", [table(results("orb_slam3", CASES), COLUMNS)], None)
