"""Markers measured in a map: where they stand, and the scale of a map that is wrong by a per cent."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, se3, so3_exp, so3_log
from fleetmap.messages import Placement
from fleetmap.plugins.markers import Marker, MarkerList
from fleetmap.recordings import format_calibration, read_calibration
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, Trajectory
from mapserver.plugins.markers.measurement import measure_markers, scale_by, scaled
from support.painted_markers import facing, painted

SIZE_M, STEP_NS = 0.2, 100_000_000
THERE = {5: facing(np.array([12.0, 1.4, 0.4]), np.pi), 6: facing(np.array([1.0, 1.5, 0.3]), -np.pi / 2)}
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def rig() -> RigCalibration:
    intrinsics = np.array([420.0, 420.0, 319.5, 239.5])
    pair = [se3(FORWARD, np.array([0.0, y_m, 0.0])) for y_m in (0.0, -0.1)]
    return RigCalibration(
        tuple(CameraCalibration("radial-tangential", 640, 480, intrinsics, np.zeros(4), at) for at in pair)
    )


def survey(stretch: float, last_m: float = 10.0) -> tuple[Any, Trajectory]:
    """A drive along x that looks ahead, then to its side; its estimated path is longer than the true one by `stretch`."""
    truth = [se3(np.eye(3), np.array([x_m, 0.0, 0.0])) for x_m in np.linspace(5.0, last_m, 12)]
    truth += [se3(so3_exp(np.array([0.0, 0.0, 1.5])), np.array([x_m, 0.0, 0.0])) for x_m in np.linspace(0.5, 1.5, 6)]
    rng = np.random.default_rng(0)
    camera = Rectifier(rig()).camera
    images = [painted(camera, map_from_body @ se3(FORWARD, np.zeros(3)), THERE, SIZE_M, rng) for map_from_body in truth]
    stamps = STEP_NS * np.arange(len(truth))
    frames = [CameraFrame(stamp_ns, image, image) for stamp_ns, image in zip(stamps.tolist(), images, strict=True)]
    shown = {"frame_stamps_ns": stamps, "read_frame": frames.__getitem__}
    recording = SimpleNamespace(name="drive", calibration=rig(), **shown)
    estimated = np.array(truth)
    estimated[:, :3, 3] *= stretch
    return recording, Trajectory(stamps, estimated)


def known() -> MarkerList:
    """In a frame of its own."""
    motion = se3(so3_exp(np.array([0.1, 0.2, 2.0])), np.array([5.0, 1, 2]))
    moved = {number: motion @ at for number, at in THERE.items()}
    rows = [Marker(id=n, size_m=SIZE_M, map_from_marker=Placement.of(at)) for n, at in moved.items()]
    return MarkerList(markers=tuple(rows))


def test_markers_are_where_they_stand() -> None:
    measured = measure_markers(*survey(1.0), SIZE_M, "APRILTAG_36h11").by_id
    assert sorted(measured) == [5, 6]
    for number, marker in measured.items():
        found: Array = marker.map_from_marker.target_from_source
        assert np.linalg.norm(found[:3, 3] - THERE[number][:3, 3]) < 4 * marker.sigma_m < 0.2
        assert np.linalg.norm(so3_log(found[:3, :3].T @ THERE[number][:3, :3])) < 0.1


@pytest.mark.parametrize("stretch", [1.01, 0.99])
def test_known_distances_give_the_scale_and_a_calibration_with_it(tmp_path: Path, stretch: float) -> None:
    scale = scale_by(measure_markers(*survey(stretch), SIZE_M, "APRILTAG_36h11"), known())
    assert scale * stretch == pytest.approx(1.0, abs=1e-3)
    file = tmp_path / "scaled.yaml"
    file.write_text(format_calibration(scaled(rig(), scale)))
    assert Rectifier(read_calibration(file)).camera.baseline_m == pytest.approx(0.1 * scale, rel=1e-6)


def test_too_little_is_said() -> None:
    with pytest.raises(RecordingError, match="two of the known markers"):
        scale_by(measure_markers(*survey(1.0), SIZE_M, "APRILTAG_36h11"), MarkerList(markers=known().markers[:1]))
    recording, trajectory = survey(1.0)
    with pytest.raises(RecordingError, match="drive past them"):
        measure_markers(recording, trajectory, SIZE_M, "ARUCO_ORIGINAL")
