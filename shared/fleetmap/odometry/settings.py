"""Settings of the odometry; the same for every recording of a sensor set."""

from typing import Annotated

from msgspec import Meta

from fleetmap.config import Section


class TrackerSettings(Section, frozen=True):
    """Points to follow from frame to frame."""

    max_points: int = 180  # tracked at a time
    min_distance_px: Annotated[float, Meta(ge=0.1)] = 22.0  # between tracked points
    window_px: Annotated[int, Meta(ge=3, le=15)] = 15  # of the optical flow
    pyramid_levels: int = 3  # of the optical flow
    back_check_px: float = 0.5  # forward-backward error of the flow
    max_gap_s: float = 0.35  # between frames; after a longer gap points are matched by descriptor
    match_features: int = 800  # per frame, for matching by descriptor
    ransac_px: float = 2.0  # inlier distance from the common motion
    min_inliers: int = 12  # of a motion
    min_inliers_known_rotation: int = 8  # of a motion whose rotation the gyro gives
    memory_frames: int = 5  # before a gap that are matched with those after it


class FilterSettings(Section, frozen=True):
    """Noise and window of the multi-state constraint filter.

    The scales widen the data sheet's densities where measurements are weighed: vibration above the IMU's bandwidth folds
    into what it reports. noise_share to wheel_yaw_scale_sigma describe the true errors, for the reported covariance.
    """

    clones: Annotated[int, Meta(ge=3)] = 11  # past states in the window
    chunk_frames: int = 9  # longer tracks are used in chunks of this length
    chunk_frames_without_imu: int = 3  # shorter, because nothing else bounds the motion
    pixel_sigma_px: float = 0.6  # of a tracked point; larger than its true error, for unmodelled errors
    disparity_sigma_px: float = 0.35  # of its disparity, equally
    noise_share: float = 0.28  # of these two: the part of the true error that is independent from image to image
    slip_along_share: float = 0.025  # drift of the flow along a point's image motion, as a share of it
    slip_across_share: float = 0.013  # drift across it
    track_disparity_sigma_px: float = 0.14  # constant error of one point's disparities
    disparity_offset_sigma_px: float = 0.02  # constant error of all disparities
    depth_scale_sigma: float = 0.0042  # the same as a share of the disparity
    pair_error_memory_s: float = 20.0  # correlation time of these two
    still_sigma_mps: float = 0.01  # velocity of a body at rest
    still_flow_px: float = 0.3  # largest image motion of a body at rest
    still_window_s: float = 0.4  # shortest rest
    use_wheels: bool = True
    wheel_sigma_scale: float = 3.0  # factor on a sample's own sigmas, for weighting
    wheel_slip_mps: float = 0.05  # sideways and upwards, which wheels do not measure
    wheel_speed_scale_sigma: float = 0.005  # of one robot's wheels
    wheel_yaw_scale_sigma: float = 0.01  # of one robot's wheels
    descriptor_sigma_scale: float = 2.5  # factor for points matched by descriptor
    chi_square_share: float = 0.99  # of correct tracks that pass the gate
    gyro_noise_scale: float = 2.0  # factor on the calibration's noise, for vibration above the IMU's bandwidth
    accel_noise_scale: float = 5.0  # factor on the calibration's noise, for vibration above the IMU's bandwidth
    keyframe_rotation_rad: float = 0.05  # a past state with less rotation since the one before is dropped first
    keyframe_parallax: float = 0.03  # the same for translation, as a share of the scene's depth
    free_rotation_sigma_rad: float = 0.15  # between frames without an IMU
    free_translation_sigma_m: float = 1.5  # between frames without an IMU
    # Without an IMU: gate of the state, in sigmas of the motion that all points of two frames show
    seen_motion_scale: float = 10.0
    time_offset_sigma_s: float = 0.02  # of the calibrated time between camera and IMU
    real_start_share: float = 0.2  # true errors of the start, as a share of the sigmas below
    real_gyro_bias_sigma_radps: float = 0.0003  # true error of the start's gyro bias
    initial_velocity_sigma_mps: float = 1.0  # at the start
    initial_tilt_sigma_rad: float = 0.01  # at the start
    initial_gyro_bias_sigma_radps: float = 0.005  # at the start
    initial_accel_bias_sigma_mps2: float = 0.1  # at the start


class StartSettings(Section, frozen=True):
    """Static and dynamic initialization: gravity and biases."""

    steady_window_s: float = 0.8  # rest that gives gravity and gyro biases at once
    steady_gyro_sigma_radps: float = 0.015  # largest spread at rest
    steady_gyro_mean_radps: float = 0.15  # largest mean at rest
    steady_accel_sigma_mps2: float = 0.1  # largest spread at rest
    moving_frames: int = 20  # of vision for a start in motion
    moving_duration_s: float = 1.0  # that they must span
    moving_gap_s: float = 0.5  # largest gap between them
    max_gravity_error_mps2: float = 0.6  # between measured and standard gravity


class MonocularSettings(Section, frozen=True):
    """Visual odometry of one camera, and the initialization of its scale by the IMU."""

    first_depth: float = 5.0  # the unit of length: assumed median depth of the points common to the first two frames
    first_parallax_px: float = 18.0  # median image motion between the first two frames
    first_min_points: int = 40  # common to the first two frames
    min_angle_deg: float = 1.0  # median angle between the rays of the first two frames
    point_angle_deg: float = 0.6  # between two rays that triangulate a point
    view_parallax_px: float = 14.0  # median image motion that makes a new view
    view_overlap: float = 0.75  # share of the last view's points below which a new view is made
    window_views: int = 8  # adjusted together
    sigma_px: float = 0.6  # of a tracked point
    max_error_px: float = 2.5  # of an inlier
    min_points: int = 15  # that must locate a frame
    drift_share: float = 0.03  # growth of the covariance, as a share of the way
    sample_interval_s: float = 0.2  # between the frames that are aligned with the IMU
    metric_samples: int = 10  # such frames that the scale needs
    metric_max_samples: int = 30  # such frames used at most
    max_scale_sigma_share: float = 0.08  # relative sigma of the scale above which the start waits for more motion
    still_px: float = 0.3  # median image motion below which the image stands still


class OdometrySettings(Section, frozen=True):
    """All settings of the odometry."""

    tracker: TrackerSettings = TrackerSettings()
    filter: FilterSettings = FilterSettings()
    start: StartSettings = StartSettings()
    monocular: MonocularSettings = MonocularSettings()
