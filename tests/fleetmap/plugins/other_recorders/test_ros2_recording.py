"""A drive that ROS's own nodes sent and recorded becomes a map: messages whose bytes this project did not make."""

import json
from pathlib import Path

import numpy as np

from fleetmap.geometry import align_points, transform_points
from fleetmap.recordings import open_recording
from fleetmap.recordings.tum import read_tum
from fleetmap.sensors.samples import SensorSet
from mapserver.cli import app
from support.recordings.painted_room import standing_first, write_ride
from support.recordings.recording_samples import FRAME_NS
from support.room_site import run
from support.ros2.environment import needs_ros, ros_program


@needs_ros
def test_a_map_of_what_ros_recorded(tmp_path: Path) -> None:
    way, ride, bag = standing_first(3.5, 1.5), tmp_path / "ride.mcap", tmp_path / "bag"
    write_ride(ride, way, 3.5, SensorSet.STEREO_INERTIAL)
    with ros_program("-m", "support.ros2.recorded_drive", str(ride), str(bag)) as recorded:
        assert recorded.wait(120) == 0
    with open_recording(bag) as theirs, open_recording(ride) as sent:
        assert theirs.issues == ()
        np.testing.assert_array_equal(theirs.frame_stamps_ns, sent.frame_stamps_ns)
        np.testing.assert_array_equal(theirs.imu.accel_mps2, sent.imu.accel_mps2)
        np.testing.assert_array_equal(theirs.read_frame(7).right, sent.read_frame(7).right)
        assert str(theirs.wheel) == str(sent.wheel)

    run(app, "doctor", bag, "--json", tmp_path / "doctor.json")
    judged = json.loads((tmp_path / "doctor.json").read_text())
    assert (judged["format"], judged["sensor_set"]) == ("mcap", "stereo-inertial")
    assert {finding["verdict"] for finding in judged["findings"]} == {"ok", "not judged"}

    files = ["--trajectory-out", tmp_path / "estimate.tum"]
    run(app, "build", bag, "--site", "lab", "--store", tmp_path / "store", *files)
    estimate = read_tum(tmp_path / "estimate.tum")
    truth_m = np.array([way(n * FRAME_NS * 1e-9)[:3, 3] for n in range(len(estimate.stamps_ns))])
    truth_from_map, _ = align_points(truth_m, estimate.positions_m)
    error_m = np.linalg.norm(transform_points(truth_from_map, estimate.positions_m) - truth_m, axis=1)
    assert len(error_m) == 70
    assert error_m.max() < 0.02
