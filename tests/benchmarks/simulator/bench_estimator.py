"""The estimator-level simulation against the rendered one: speed, odometry and localization on the same drive.

`PYTHONPATH=tests python tests/benchmarks/simulator/bench_estimator.py [--frames N] [--out FILE.json]`; about three minutes.
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
import argparse
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.common import estimator_loop, rendered_map
from fleetmap.geometry import Array
from fleetmap.odometry import Odometry, OdometryEstimate, OdometrySettings
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetsim.recorder import Order, Session, prepare
from locclient.localization.estimate import Estimate
from support.estimator.simulated_run import EstimatorSession

Figures = dict[str, float]


def rendered_frames(session: Session, count: int) -> Iterator[RectifiedFrame]:
    """The first frames of a session, rendered and rectified."""
    rectifier = Rectifier(session.nominal)
    for number, frame in enumerate(session.frames()):
        if number == count:
            return
        yield rectifier.rectify(frame)


def rendered_odometry(session: Session, frames: list[RectifiedFrame]) -> list[OdometryEstimate]:
    """The odometry's estimates over pictures."""
    rectifier = Rectifier(session.nominal)
    odometry = Odometry(session.nominal, rectifier.camera, rectifier.body_from_cam, 0.0, OdometrySettings())
    estimates, last_ns = [], 0
    for frame in frames:
        odometry.handle_imu(session.imu.between(last_ns, frame.stamp_ns + 1))
        last_ns = frame.stamp_ns + 1
        estimates.append(odometry.handle_stereo(frame))
    return estimates


def odometry_figures(estimates: list[OdometryEstimate], map_from_body: Array) -> Figures:
    """Inlier share, tracks, errors of the motion over one second."""
    errors = estimator_loop.relative_errors_m(estimates, map_from_body)
    moving = [e for e in estimates if e.inertial]
    return {
        "inlier_share": float(np.mean([e.inlier_share for e in moving])),
        "tracks": float(np.mean([len(e.track_ids) for e in moving])),
        "error_1s_mm_median": float(np.median(errors) * 1e3),
        "error_1s_mm_rms": float(np.sqrt(np.mean(errors**2)) * 1e3),
    }


def cpu_s(work: Callable[[], object]) -> float:
    """CPU seconds of the work."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def measure_everything(session: EstimatorSession) -> None:
    """Every frame's flow and features, the way a robot would ask for them."""
    ids, begun = np.zeros(0, np.uint64), np.zeros((0, 2))
    for frame in range(len(session)):
        pixels, kept = session.follow(frame, ids, begun)
        ids, begun = ids[kept], begun[kept]
        if len(ids) < 150:
            fresh, fresh_begun = session.corners(frame, pixels[kept], 180 - len(ids), 22.0)
            ids, begun = np.concatenate([ids, fresh]), np.concatenate([begun, fresh_begun])
        session.features(frame)


def speeds(robot: EstimatorSession, survey: EstimatorSession) -> Figures:
    """Times real time on one core: generating, with odometry, with localization in a map."""
    tiles, vocabulary = estimator_loop.survey_map(survey, np.random.default_rng(0))
    view = estimator_loop.map_view(robot, tiles, vocabulary)
    duration_s = robot.session.frame_times_s[-1]
    runs: dict[str, Callable[[], object]] = {
        "generate": lambda: measure_everything(robot),
        "odometry": lambda: estimator_loop.run_odometry(robot),
        "odometry and localization": lambda: estimator_loop.run_localizer(robot, view),
    }
    estimator_loop.run_localizer(robot, view, frames=60)  # compiles
    measure_everything(robot)
    return {name: duration_s / cpu_s(run) for name, run in runs.items()}


def compare_odometry(robot: str, day: int, count: int) -> tuple[Figures, Figures]:
    """Figures of a robot's first frames, rendered and not."""
    session = prepare(Order("small-loop", robot=robot, day=day))
    simulated = EstimatorSession(session)
    frames = list(rendered_frames(session, count))
    session.renderer.close()
    rendered = odometry_figures(rendered_odometry(session, frames), simulated.map_from_body)
    return rendered, odometry_figures(estimator_loop.run_odometry(simulated, count), simulated.map_from_body)


def localization_figures(estimates: list[Estimate], map_from_body: Array) -> Figures:
    """Share of frames with a place, inliers of a fix, errors."""
    errors = estimator_loop.position_errors_m(estimates, map_from_body)
    return {
        "placed_share": len(errors) / len(estimates),
        "fix_inliers": float(np.mean([e.fix.inliers for e in estimates if e.fix is not None])),
        "error_mm_median": float(np.median(errors) * 1e3),
        "error_mm_p95": float(np.percentile(errors, 95) * 1e3),
    }


def compare_localization() -> tuple[Figures, Figures]:
    """Figures of the next-day robot, rendered and not, in maps made the same way from true places with 10 mm of noise."""
    survey, robot = prepare(Order("small-loop")), prepare(Order("small-loop", robot="tote-1", day=1))
    simulated = EstimatorSession(robot)
    tiles, vocabulary = rendered_map.survey_map(survey, np.random.default_rng(0), 0.01)
    frames = list(rendered_frames(robot, len(simulated)))
    for session in (survey, robot):
        session.renderer.close()
    rendered = rendered_map.run_localizer(robot, frames, tiles, vocabulary)
    tiles, vocabulary = estimator_loop.survey_map(EstimatorSession(survey), np.random.default_rng(0))
    estimates = estimator_loop.run_localizer(simulated, estimator_loop.map_view(simulated, tiles, vocabulary))
    truth = simulated.map_from_body
    return localization_figures(rendered, truth), localization_figures(estimates, truth)


def report(name: str, rendered: Figures, simulated: Figures) -> dict[str, Figures]:
    """Prints figures side by side and returns them."""
    print(f"\n{name}: {'rendered':>32s} {'estimator':>10s} {'ratio':>7s}")
    for figure, value in rendered.items():
        print(f"  {figure:36s} {value:10.3f} {simulated[figure]:10.3f} {simulated[figure] / value:7.2f}")
    return {"rendered": rendered, "estimator": simulated}


def measure_speeds() -> Figures:
    """Times real time on one core of the small loop's next-day robot in the survey's map."""
    sessions = [prepare(Order("small-loop", robot="tote-1", day=1)), prepare(Order("small-loop"))]
    for session in sessions:
        session.renderer.close()
    return speeds(*(EstimatorSession(session) for session in sessions))


def main() -> None:
    """Prints both runs' figures side by side; writes them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    result: dict[str, object] = {}
    for robot, day in (("survey", 0), ("tote-1", 1)):
        result[robot] = report(robot, *compare_odometry(robot, day, options.frames))
    result["localization"] = report("localization", *compare_localization())
    found = measure_speeds()
    result["times_real_time"] = found
    print("\ntimes real time on one core:", {name: round(value, 1) for name, value in found.items()})
    if options.out is not None:
        options.out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
