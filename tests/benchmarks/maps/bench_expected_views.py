"""Views of the map that renders against frames that its build left out: PSNR, SSIM, what is unknown, CPU and bytes.

    PYTHONPATH=tests python tests/benchmarks/maps/bench_expected_views.py SCENARIO:SEED ... [--frames ::] [--picture FILE.png] [--keep DIR]
    PYTHONPATH=tests python tests/benchmarks/maps/bench_expected_views.py RECORDING ...

A build of the recording's frames is stored; frames that became no keyframe are drawn 320 pixels wide from the surfels of the store, where
the build says that they were taken, and compared with what the camera saw, in grey. Nothing is refined. All: unknown pixels count, filled
from their surroundings. Known: those alone that the map knows. Exposed: known, after one factor for the whole picture, as exposure is not
in the map.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from unittest.mock import patch

import cv2
import msgspec
import numpy as np

from fleetmap.recordings import FrameSelection, open_recording
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import SensorSet
from fleetsim.commands import record_order
from fleetsim.recorder import Order
from mapserver import BuildOptions, MapStore, build_map
from mapserver.build import layers
from mapserver.build.build import BuildRequest
from mapserver.library import BuiltMap, settings_for
from mapserver.quality.probes import held_out_frames
from mapserver.surfels.expected_view import expected_view, pinhole, resized
from mapserver.surfels.picture_likeness import Grey, psnr_db, ssim
from mapserver.surfels.surfel_map import Surfels, surfels_of
from mapserver.surfels.survey_surfels import grow_surfels

WIDTH_PX, VIEWS = 320, 60


@dataclass(frozen=True, slots=True)
class ViewFigures:
    """Means over the views; build_cpu_s: what the surfels cost; view_cpu_s: the median of a view."""

    psnr_all_db: float
    psnr_known_db: float
    psnr_exposed_db: float
    ssim_all: float
    ssim_known: float
    unknown: float
    view_cpu_s: float
    build_cpu_s: float
    surfels: int
    bytes_per_m: float


def measure(recording: Path, work: Path, frames: str = "::", picture: Path | None = None) -> ViewFigures:
    """Builds a recording and compares; prints the figures."""
    spent_s = []

    def timed(*arguments: object) -> object:
        begun_s = time.process_time()
        grown = grow_surfels(*arguments)  # type: ignore[arg-type]
        spent_s.append(time.process_time() - begun_s)
        return grown

    options = BuildOptions(frames=frames)
    settings = settings_for(BuildRequest((recording,), "hall", work / "store", options))
    with patch.object(layers, "grow_surfels", timed):
        options = replace(options, settings=msgspec.structs.replace(settings, surfel_map=True))
        built = build_map(recording, work / "store", "hall", options)
    with MapStore.open(work / "store") as maps:
        manifest = maps.manifest("hall", built.version)
        surfels = surfels_of(manifest, maps.blob)
    said = built.report["surfels"]
    rows, shown = _compared(recording, frames, built, surfels)
    if picture is not None:
        cv2.imwrite(str(picture), np.vstack(shown))
    means = np.mean(rows, axis=0)
    path_m, median_s = float(built.report["path_m"]), float(np.median([row[-1] for row in rows]))
    figures = ViewFigures(*means[:6].tolist(), median_s, spent_s[0], len(surfels), said["bytes"] / path_m)
    words = ", ".join(f"{name} {value:.4g}" for name, value in asdict(figures).items())
    print(
        f"{recording.name}: {len(rows)} views, {built.report['keyframes']} keyframes, {path_m:.1f} m: {words}",
        flush=True,
    )
    return figures


def _compared(
    recording: Path, frames: str, built: BuiltMap, surfels: Surfels
) -> tuple[list[tuple[float, ...]], list[Grey]]:
    """Figures of each view, and some views beside what was seen and their difference."""
    survey, rows, shown = built.built.taken[0].survey, list[tuple[float, ...]](), list[Grey]()
    keyframes = [keyframe.frame_index for keyframe in survey.odometry.keyframes]
    numbers = held_out_frames(keyframes, built.map.trajectory_estimated, VIEWS)
    camera = resized(pinhole(survey.state.camera), WIDTH_PX)
    with open_recording(recording) as opened:
        selected = FrameSelection.parse(frames).apply(opened)
        has_depth = opened.sensor_set is SensorSet.RGBD
        rectifier = Rectifier(opened.calibration, has_depth=has_depth, pinhole=survey.state.camera)
        for number in numbers:
            left = rectifier.rectify(opened.read_frame(int(selected[number]))).left
            wanted = np.asarray(
                cv2.resize(left, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA), np.uint8
            )
            place = built.trajectory.frame_from_body[number] @ survey.state.body_from_cam
            begun_s = time.process_time()
            view = expected_view(surfels, camera, place)
            spent_s = time.process_time() - begun_s
            known = ~view.unknown
            if not known.any():
                raise AssertionError(f"frame {number}: nothing is known where the build says that it was taken")
            factor = float(np.median(wanted[known] / np.maximum(view.picture[known], 1.0)))
            exposed = np.clip(view.picture * factor, 0, 255).astype(np.uint8)
            likeness = (
                psnr_db(view.picture, wanted),
                psnr_db(view.picture, wanted, known),
                psnr_db(exposed, wanted, known),
            )
            alike = ssim(view.picture, wanted), ssim(view.picture, wanted, known)
            rows.append((*likeness, *alike, float(view.unknown.mean()), spent_s))
            if len(rows) % 15 == 5:
                bare = np.where(view.unknown, 0, view.picture).astype(np.uint8)
                shown.append(np.hstack([wanted, view.picture, bare]))
    return rows, shown


def recorded(hall: str, folder: Path) -> Path:
    """SCENARIO:SEED as a recording in `folder`, or the recording of that path."""
    if ":" not in hall:
        return Path(hall)
    scenario, _, seed = hall.partition(":")
    path = folder / f"{scenario}-{seed}.mcap"
    if not path.exists():
        record_order(Order(scenario, seed=int(seed)), path, "mcap")
    return path


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("halls", nargs="+", metavar="SCENARIO:SEED|RECORDING")
    parser.add_argument("--frames", default="::")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--keep", type=Path, help="folder for recordings and stores")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as made:
        work = options.keep or Path(made)
        for hall in options.halls:
            own = work / hall.replace(":", "-").replace("/", "_")
            own.mkdir(exist_ok=True, parents=True)
            measure(recorded(hall, work), own, options.frames, options.picture)


if __name__ == "__main__":
    main()
