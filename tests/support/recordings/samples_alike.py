"""Whether two recordings hold the same."""

import numpy as np

from fleetmap.recordings import Recording


def assert_same(first: Recording, second: Recording) -> None:
    """The same samples to the bit."""
    assert first.sensor_set == second.sensor_set
    np.testing.assert_array_equal(first.frame_stamps_ns, second.frame_stamps_ns)
    for name in ("stamps_ns", "gyro_radps", "accel_mps2"):
        np.testing.assert_array_equal(getattr(first.imu, name), getattr(second.imu, name))
    for index in (3, 0, 1, 1):
        ours, theirs = first.read_frame(index), second.read_frame(index)
        np.testing.assert_array_equal(ours.left, theirs.left)
        assert ours.right is not None
        np.testing.assert_array_equal(ours.right, theirs.right)
    for ours_camera, other in zip(first.calibration.cameras, second.calibration.cameras, strict=True):
        np.testing.assert_array_equal(ours_camera.body_from_cam, other.body_from_cam)
        np.testing.assert_array_equal(ours_camera.intrinsics_px, other.intrinsics_px)
