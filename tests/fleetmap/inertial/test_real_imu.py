"""Preintegration of a real IMU between ground-truth states of a flight."""

import numpy as np

from fleetmap.geometry import rotation_from_quat_wxyz, se3, so3_log
from fleetmap.inertial import preintegrate
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples
from support.recordings.realdata import real_data
from support.worlds.inertial_motion import predicted


def test_two_seconds_of_flight_end_where_the_truth_does() -> None:
    """The truth's frame leans 0.23 degrees against gravity, a constant 0.04 m/s^2 that is taken out first."""
    folder = real_data("euroc_v101_keyframes") / "mav0"
    rows = np.loadtxt(folder / "imu0" / "data.csv", delimiter=",", skiprows=1)
    imu = ImuSamples(_stamps(folder / "imu0" / "data.csv"), rows[:, 1:4].copy(), rows[:, 4:7].copy())
    truth_file = folder / "state_groundtruth_estimate0" / "data.csv"
    stamps, truth = _stamps(truth_file), np.loadtxt(truth_file, delimiter=",", skiprows=1)
    off_rad, off_mps, off_m, dts_s, gaps_s = [], [], [], [], []
    for i in range(100, len(stamps) - 60, 30):
        j = int(np.searchsorted(stamps, stamps[i] + 2_000_000_000))
        first, last = truth[i], truth[j]
        summed = preintegrate(imu, int(stamps[i]), int(stamps[j]), first[11:14], first[14:17], ImuNoise())
        map_from_body = se3(rotation_from_quat_wxyz(first[4:8]), first[1:4])
        there, velocity = predicted(summed, map_from_body, first[8:11], first[11:14], first[14:17])
        off_rad.append(np.linalg.norm(so3_log(rotation_from_quat_wxyz(last[4:8]).T @ there[:3, :3])))
        off_m.append(there[:3, 3] - last[1:4])
        off_mps.append(velocity - last[8:11])
        dts_s.append(summed.dt_s)
        gaps_s.append(summed.max_gap_s)
    dt_s, lean_mps2 = np.array(dts_s)[:, None], np.mean(np.array(off_mps) / np.array(dts_s)[:, None], axis=0)
    assert np.linalg.norm(lean_mps2) < 0.05
    assert np.median(off_rad) < np.radians(0.3)
    assert np.median(np.linalg.norm(off_mps - lean_mps2 * dt_s, axis=1)) < 0.06
    assert np.median(np.linalg.norm(off_m - 0.5 * lean_mps2 * dt_s**2, axis=1)) < 0.06
    assert max(gaps_s) < 0.011


def _stamps(path):  # type: ignore[no-untyped-def]
    return np.array([line.split(",")[0] for line in path.read_text().splitlines()[1:]], dtype=np.int64)
