"""Settings of the odometry; the same for every recording of a sensor set."""

from typing import Annotated

from msgspec import Meta

from fleetmap.config import Section


class TrackerSettings(Section, frozen=True):
    """Points to follow from frame to frame."""

    max_points: int = 180
    min_distance_px: float = 22.0
    window_px: Annotated[int, Meta(ge=3, le=15)] = 15
    pyramid_levels: int = 3
    back_check_px: float = 0.5
    max_gap_s: float = 0.35
    match_features: int = 800
    ransac_px: float = 2.0
    min_inliers: int = 12
    min_inliers_known_rotation: int = 8
    memory_frames: int = 5


class FilterSettings(Section, frozen=True):
    """Noise and window of the multi-state constraint filter.

    The scales widen the data sheet's densities where measurements are weighed: vibration above the IMU's bandwidth folds
    into what it reports. noise_share to wheel_yaw_scale_sigma describe the errors as they are, for what is reported.
    """

    clones: Annotated[int, Meta(ge=3)] = 11
    chunk_frames: int = 9
    chunk_frames_without_imu: int = 3
    pixel_sigma_px: float = 0.6
    disparity_sigma_px: float = 0.35
    noise_share: float = 0.28
    slip_along_share: float = 0.025
    slip_across_share: float = 0.013
    track_disparity_sigma_px: float = 0.14
    disparity_offset_sigma_px: float = 0.02
    depth_scale_sigma: float = 0.0042
    pair_error_memory_s: float = 20.0
    still_sigma_mps: float = 0.01
    still_flow_px: float = 0.3
    still_window_s: float = 0.4
    use_wheels: bool = True
    wheel_sigma_scale: float = 3.0
    wheel_slip_mps: float = 0.05
    wheel_speed_scale_sigma: float = 0.005
    wheel_yaw_scale_sigma: float = 0.01
    descriptor_sigma_scale: float = 2.5
    chi_square_share: float = 0.99
    gyro_noise_scale: float = 2.0
    accel_noise_scale: float = 5.0
    keyframe_rotation_rad: float = 0.05
    keyframe_parallax: float = 0.03
    free_rotation_sigma_rad: float = 0.15
    free_translation_sigma_m: float = 1.5
    seen_motion_scale: float = 10.0
    time_offset_sigma_s: float = 0.02
    real_start_share: float = 0.2
    real_gyro_bias_sigma_radps: float = 0.0003
    initial_velocity_sigma_mps: float = 1.0
    initial_tilt_sigma_rad: float = 0.01
    initial_gyro_bias_sigma_radps: float = 0.005
    initial_accel_bias_sigma_mps2: float = 0.1


class StartSettings(Section, frozen=True):
    """How the filter finds gravity and biases."""

    steady_window_s: float = 0.8
    steady_gyro_sigma_radps: float = 0.015
    steady_gyro_mean_radps: float = 0.15
    steady_accel_sigma_mps2: float = 0.1
    moving_frames: int = 20
    moving_duration_s: float = 1.0
    moving_gap_s: float = 0.5
    max_gravity_error_mps2: float = 0.6


class MonocularSettings(Section, frozen=True):
    """How one camera alone finds its way, and when the IMU may say how long that way is."""

    first_depth: float = 5.0  # the unit of length: how far away half of what the first two views share is taken to be
    first_parallax_px: float = 18.0
    first_min_points: int = 40
    min_angle_deg: float = 1.0
    point_angle_deg: float = 0.6
    view_parallax_px: float = 14.0
    view_overlap: float = 0.75
    window_views: int = 8
    sigma_px: float = 0.6
    max_error_px: float = 2.5
    min_points: int = 15
    drift_share: float = 0.03
    sample_interval_s: float = 0.2
    metric_samples: int = 10
    metric_max_samples: int = 30
    max_scale_sigma_share: float = 0.08
    still_px: float = 0.3


class OdometrySettings(Section, frozen=True):
    """All of it."""

    tracker: TrackerSettings = TrackerSettings()
    filter: FilterSettings = FilterSettings()
    start: StartSettings = StartSettings()
    monocular: MonocularSettings = MonocularSettings()
