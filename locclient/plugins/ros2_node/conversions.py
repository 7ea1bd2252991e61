"""Values of the localizer's messages: motion, initial poses, frames of the cameras; without ROS itself."""

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, se3_inverse, so3_log
from fleetmap.odometry.estimate import OdometryStatus
from fleetmap.recordings.ros2 import messages
from fleetmap.recordings.ros2.messages import FrameLink
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import UNSAID_SIGMAS, PositionPrior
from locclient.localization.estimate import Estimate
from locclient.localization.place import transport_cov
from locclient.outputs import OutputSection
from locclient.robot.continuous_odom import PublishedPose

# Odometry sigmas between two frames, tracking and not: radians, metres, share of the distance.
_MEASURED, _GUESSED = (0.0005, 0.001, 0.02), (0.02, 0.05, 0.1)


def motion_between(
    before: tuple[Estimate, PublishedPose], after: tuple[Estimate, PublishedPose], base_from_body: Array
) -> tuple[Array, Array, Array, Array]:
    """Return a frame's odom_from_base (4, 4) with its covariance (6, 6), and the mean velocity of the base since the frame before, in its
    own axes (6,), linear m/s, then angular rad/s, with its covariance (6, 6); all in the order of ROS, translation first."""
    (earlier, then), (estimate, now) = before, after
    odometry, seconds = estimate.odometry, (estimate.stamp_ns - earlier.stamp_ns) * 1e-9
    step = se3_inverse(then.odom_from_base) @ now.odom_from_base
    twist = np.concatenate([step[:3, 3], so3_log(step[:3, :3])]) / seconds
    turn_rad, floor_m, share = _GUESSED if odometry.status is OdometryStatus.DEGRADED else _MEASURED
    sigma_m = floor_m + share * float(np.linalg.norm(step[:3, 3]))
    twist_cov = np.diag([(sigma_m / seconds) ** 2] * 3 + [(turn_rad / seconds) ** 2] * 3)
    # The odometry's frame may be rotated against the published one.
    published_from_odometry = (now.odom_from_base @ base_from_body)[:3, :3] @ odometry.odom_from_body[:3, :3].T
    both = np.kron(np.eye(2), published_from_odometry)
    lever_m = now.odom_from_base[:3, :3] @ base_from_body[:3, 3]
    covariance = transport_cov(both @ odometry.cov_rot_trans @ both.T, -lever_m)
    return now.odom_from_base, covariance[messages.HALVES_SWAPPED], twist, twist_cov


def decode_initial_pose(data: bytes, map_frame: str) -> PositionPrior:
    """geometry_msgs/PoseWithCovarianceStamped of an operator: a prior from now on, independent of its stamp.

    RecordingError for another frame, a pose or covariance that is not finite, and an invalid covariance.
    """
    _, frame_id = messages.header_of(data)
    if frame_id.lstrip("/") != map_frame:
        raise RecordingError(f"an initial pose in the frame {frame_id!r} is not used; give it in {map_frame!r}")
    try:
        prior = messages.decode_prior(data)
    except ValueError as error:
        raise RecordingError(f"an initial pose is not used: {error}; give a finite pose and a quaternion") from error
    cov = prior.cov_rot_trans
    if not np.isfinite(cov).all():
        raise RecordingError(
            "an initial pose is not used: its covariance holds NaN or infinity; give variances, or zeros"
        )
    if not np.allclose(cov, cov.T, atol=1e-6) or np.linalg.eigvalsh((cov + cov.T) / 2)[0] < -1e-6:
        raise RecordingError(
            "an initial pose is not used: its covariance is not symmetric and positive; check its order"
        )
    said = np.diag(cov) > 0
    cov = np.where(np.outer(said, said), (cov + cov.T) / 2, 0.0) + np.diag(np.where(said, 0.0, UNSAID_SIGMAS**2))
    return PositionPrior(0, prior.map_from_base, cov, is_revisable=True)


def sensor_links(section: OutputSection, calibration: RigCalibration) -> list[FrameLink]:
    """Return base -> body and body -> each camera, under names that no URDF uses: PREFIXbody, PREFIXcam0_optical and so on."""
    body = f"{section.sensor_frames}body"
    links = [FrameLink(section.base_frame, body, calibration.base_from_body)]
    for number, camera in enumerate(calibration.cameras):
        links.append(FrameLink(body, f"{section.sensor_frames}cam{number}_optical", camera.body_from_cam))
    return links
