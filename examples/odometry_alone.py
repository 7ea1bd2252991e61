"""Run the odometry over a recording, without a map: python examples/odometry_alone.py RECORDING OUT.tum

Works with any cameras, with or without IMU. Writes the trajectory as TUM text. If evo is installed and the recording has
ground truth, prints the error and saves a plot beside the trajectory.
"""

import sys
from pathlib import Path

import numpy as np

from fleetmap import FleetmapError, OdometrySettings, Recording, Trajectory, make_odometry, open_recording, write_tum
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import SensorSet, wheel_between

LEAD_NS = 30_000_000  # IMU and wheels are fed a little ahead of each frame


def run_odometry(recording: Recording) -> Trajectory:
    """Return the estimated odom_from_body at every frame."""
    rectifier = Rectifier(recording.calibration, has_depth=recording.sensor_set is SensorSet.RGBD)
    odometry = make_odometry(rectifier.rig, OdometrySettings())
    odom_from_body, fed_ns = [], -(2**62)
    for index in range(len(recording)):
        frame = recording.read_frame(index)
        # 1. Feed the inertial samples and wheel odometry up to the frame, on the IMU's clock.
        until_ns = frame.stamp_ns + int(rectifier.imu_minus_cam_s * 1e9) + LEAD_NS
        odometry.handle_imu(recording.imu.between(fed_ns, until_ns))
        odometry.handle_wheel(wheel_between(recording.wheel, fed_ns, until_ns))
        fed_ns = until_ns
        # 2. Feed the frame.
        estimate = odometry.handle_stereo(rectifier.rectify(frame))
        # 3. Once gravity is estimated, the frame `odom` is rotated: rotate earlier estimates with it.
        if estimate.new_odom_from_old_odom is not None:
            odom_from_body = [estimate.new_odom_from_old_odom @ earlier for earlier in odom_from_body]
        odom_from_body.append(estimate.odom_from_body)
        for earlier, revised in estimate.revised:
            odom_from_body[earlier] = revised
    return Trajectory(recording.frame_stamps_ns, np.array(odom_from_body))


def compare_with_evo(estimated: Path) -> None:
    """Print the absolute trajectory error after alignment and save a plot of both trajectories."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        from evo.core import metrics, sync
        from evo.tools import file_interface, plot
        from matplotlib import pyplot
    except ImportError:
        print("evo is not installed: no plot (pip install evo)")
        return
    read = file_interface.read_tum_trajectory_file
    reference, result = sync.associate_trajectories(read(estimated.with_suffix(".truth.tum")), read(estimated))
    result.align(reference)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((reference, result))
    print(f"absolute trajectory error: {error.get_statistic(metrics.StatisticsType.rmse):.3f} m rmse")
    figure = pyplot.figure()
    plot.trajectories(figure, {"ground truth": reference, "odometry": result}, plot.PlotMode.xy)
    figure.savefig(estimated.with_suffix(".png"))


def main(path: str, out: str) -> None:
    """Run the odometry, write the trajectory, compare it with the ground truth."""
    with open_recording(path) as recording:
        trajectory = run_odometry(recording)
        write_tum(Path(out), trajectory)
        length_m = np.linalg.norm(np.diff(trajectory.positions_m, axis=0), axis=1).sum()
        print(f"{out}: {len(recording)} frames, {length_m:.1f} m")
        if recording.ground_truth is not None:
            write_tum(Path(out).with_suffix(".truth.tum"), recording.ground_truth)
            compare_with_evo(Path(out))


if __name__ == "__main__":
    try:
        main(*sys.argv[1:3])
    except FleetmapError as error:  # its text names the next step
        sys.exit(f"error: {error}")
