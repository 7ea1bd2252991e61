"""Poses that the tracker carries along with the odometry."""

from typing import cast

import numpy as np

from fleetmap.geometry import se3, so3_exp
from fleetmap.odometry import OdometryEstimate, OdometryStatus
from fleetmap.relocalization.frame_features import FrameFeatures
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.sensors.rectification import MountedCamera, StereoCamera
from locclient.localization.pose_hypothesis import Motion, PoseHypothesis
from locclient.localization.pose_tracker import PoseTracker
from locclient.localization.settings import LocalizerSettings

STEP = se3(so3_exp(np.array([0.0, 0.0, 0.1])), np.array([0.07, 0.0, 0.0]))


def odometry(frame: int) -> OdometryEstimate:
    odom_from_body = np.linalg.matrix_power(STEP, frame)
    return OdometryEstimate(
        frame, frame, odom_from_body, 1e-8 * np.eye(6), np.zeros(3), np.zeros(3), np.zeros(3), OdometryStatus.TRACKING,
        np.arange(50), 5.0, 1.0, False, True, None, previous_from_body=STEP,
    )  # fmt: skip


def test_the_frame_of_a_long_search_moves_once_with_each_frame() -> None:
    """Kept to be pooled with later ones while its own search goes on; the odometry drops it meanwhile."""
    camera = MountedCamera(StereoCamera(500.0, 320.0, 240.0, 0.1, 640, 480), np.eye(4))
    tracker = PoseTracker(LocalizerSettings(), [camera], np.eye(4))
    tracker.propagate(odometry(0), {}, has_broken=False)
    tracker.confirmed = PoseHypothesis.at(odometry(0), np.eye(4), 1e-6 * np.eye(6))
    tracker.begin_query(odometry(0))
    tracker.keep_frame(cast("FrameFeatures", None))
    motion = Motion(STEP, 1e-8 * np.eye(6), is_last=True)
    tracker.propagate(odometry(1), {0: motion}, has_broken=False)
    fix = Fix(np.eye(4), 1e-6 * np.eye(6), inliers=100, image_coverage=9)
    ((_, present),) = tracker.observations([fix])
    np.testing.assert_allclose(present.now_map_from_body, STEP, atol=1e-12)
    np.testing.assert_allclose(tracker.confirmed.now_map_from_body, STEP, atol=1e-12)
