"""Poses that the tracker carries along with the odometry."""

from typing import cast

import numpy as np
import pytest

from fleetmap.features import orb
from fleetmap.geometry import se3, se3_inverse, so3_exp
from fleetmap.odometry import OdometryEstimate, OdometryStatus
from fleetmap.relocalization.frame_features import FrameFeatures
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.sensors.rectification import MountedCamera, StereoCamera
from locclient.localization.held_maps import HeldMaps
from locclient.localization.place import Place
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
    tracker = PoseTracker(LocalizerSettings(), [camera], np.eye(4), HeldMaps())
    tracker.propagate(odometry(0), {}, has_broken=False)
    tracker.confirmed = PoseHypothesis.at(odometry(0), Place(np.eye(4), 1e-6 * np.eye(6)))
    tracker.begin_query(odometry(0))
    tracker.keep_frame(cast("FrameFeatures", None))
    motion = Motion(STEP, 1e-8 * np.eye(6), is_last=True)
    tracker.propagate(odometry(1), {0: motion}, has_broken=False)
    fix = Fix(np.eye(4), 1e-6 * np.eye(6), inliers=100, image_coverage=9)
    ((_, present),) = tracker.observations([fix])
    np.testing.assert_allclose(present.now.map_from_body, STEP, atol=1e-12)
    np.testing.assert_allclose(tracker.confirmed.now.map_from_body, STEP, atol=1e-12)


@pytest.mark.parametrize("base_m", [0.0, 0.08])
def test_frames_of_a_single_or_depth_camera_count_beside_a_pair_by_their_bearings(base_m: float) -> None:
    """And a pair's frame beside a single camera; one of another pinhole does not count."""
    pair, other = (StereoCamera(500.0, 320.0, 240.0, base, 640, 480) for base in (0.1, base_m))
    wide = StereoCamera(300.0, 320.0, 240.0, 0.0, 640, 480)
    turned = se3(so3_exp(np.array([0.0, 0.0, 1.5])), np.zeros(3))
    mounted = [MountedCamera(pair, np.eye(4)), MountedCamera(other, turned), MountedCamera(wide, turned)]
    seen = FrameFeatures(cast("orb.Features", None), np.array([[10.0, 20.0, 5.0], [30.0, 40.0, np.nan]]))
    for kept, queried, expected in ((1, 0, True), (0, 1, True), (2, 0, False)):
        tracker = PoseTracker(LocalizerSettings(), mounted, np.eye(4), HeldMaps())
        tracker.propagate(odometry(0), {}, has_broken=False)
        tracker.confirmed = PoseHypothesis.at(odometry(0), Place(np.eye(4), 1e-6 * np.eye(6)))
        tracker.begin_query(odometry(0), kept)
        tracker.keep_frame(seen)
        tracker.begin_query(odometry(0), queried)
        found = tracker.earlier_frames()
        assert len(found) == expected
        for each in found:
            assert np.isnan(each.features.pixels[:, 2]).all()
            np.testing.assert_array_equal(each.features.pixels[:, :2], seen.pixels[:, :2])
            motion = se3_inverse(mounted[kept].body_from_cam) @ mounted[queried].body_from_cam
            np.testing.assert_allclose(each.cam_from_query, motion, atol=1e-12)
    assert np.isfinite(seen.pixels[0, 2])
