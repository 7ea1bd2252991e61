"""Settings of a survey: one set for each sensor set, none for a single recording."""

from math import inf
from typing import Literal

from fleetmap.config import Section
from fleetmap.features.settings import AlignSettings, OrbSettings, StereoSettings
from fleetmap.odometry.settings import OdometrySettings

MIN_SEEN = 8  # least landmarks of a keyframe that is not blind


class KeyframeSettings(Section, frozen=True):
    """Selection of keyframes."""

    policy: Literal["overlap", "every", "every-nth"] = "overlap"
    every_nth: int = 5
    min_overlap: float = 0.6
    max_rotation_deg: float = 12.0
    max_parallax: float = 0.12
    max_interval_s: float = 2.0
    min_sharpness: float = 0.5  # frames below this share of the recent median are skipped
    break_overlap: float = 0.3  # share of shared points below which even a blurred frame is taken


class PairSettings(Section, frozen=True):
    """Selection of keyframe pairs, and their matching."""

    previous: int = 6  # keyframes that each one is matched with
    covisible: int = 10  # further keyframes, those with the largest predicted overlap
    min_overlap: float = 0.15  # predicted share of common view
    max_distance: int = 70  # bits of 256
    ratio: float = 0.85  # best over second best distance
    guided_distance: int = 60  # bits, near the predicted position
    guided_radius_px: float = 6.0  # with the motion known from matches
    search_px: float = 8.0  # with the motion predicted only
    min_inliers: int = 12  # of one rigid motion
    match_sigma_px: float = 1.5  # of a match before refinement


class LoopSettings(Section, frozen=True):
    """Search for revisits, and what they must fulfil."""

    top: int = 8
    depth: int = 128  # earlier keyframes, by similarity, that pass through the position gate
    per_place: int = 8  # accepted candidates of one place
    min_gap_keyframes: int = 8
    max_innovation: float = 22.458  # 0.999 of chi-square with 6 degrees of freedom
    view_range_depths: float = 1.0  # largest distance between keyframes with common view, in median scene depths
    # Distance of aisles that look alike, if known; else 0.
    repeats_every_m: float = 0.0
    min_inliers: int = 15  # of one rigid motion
    alone_inliers: int = 30  # the same without a neighbouring keyframe that confirms the revisit
    min_cells: int = 6  # of 48 image cells with inliers
    rotation_sigma_limit_rad: float = 0.12  # the graph's rotation guides matching where it is known this well


class NoiseSettings(Section, frozen=True):
    """Assumed noise of measurements in the bundle adjustment."""

    aligned_sigma_px: float = 0.35  # of a feature that patch alignment refined
    descriptor_sigma_px: float = 0.9  # of one that it could not refine, at the finest image scale
    disparity_sigma_px: float = 0.2
    cut_sigmas: float = 4.0  # observations farther off are removed between adjustments
    # Of the estimated stereo yaw with an exact calibration: depth edges of long aisles cause 0.03 px, most scenes 0.01
    turn_floor_px: float = 0.03
    turn_sigmas: float = 3.0  # significance at which that yaw is corrected
    accel_noise_scale: float = 5.0  # factor on the calibration's noise, for vibration above the IMU's bandwidth
    gyro_noise_scale: float = 2.0  # factor on the calibration's noise, for vibration above the IMU's bandwidth
    walk_scale: float = 1.0  # factor on the calibration's bias walks


class BundleSettings(Section, frozen=True):
    """Effort of bundle adjustment. Widths are in sigmas of an observation's residual."""

    max_iterations: int = 10  # Levenberg-Marquardt steps
    huber_sigmas: float = 2.5  # where the loss turns from quadratic to linear
    cutoff_sigmas: float = inf  # observations farther off have no influence
    lambda_start: float = 1e-4  # first damping
    relative_cost_tolerance: float = 1e-4  # relative gain of the last step
    dense_unknowns: int = 700  # reduced systems up to this size are solved by dense Cholesky, larger ones by sparse


class SingleCameraSettings(Section, frozen=True):
    """Depths and scale drift in the survey of one camera."""

    depth_views: int = 5  # keyframes before and after each that triangulate its features
    match_sigma_px: float = 1.0  # of a matched feature
    min_angle_deg: float = 0.8  # smallest angle between two rays that triangulate
    max_depth_sigma_share: float = 0.12  # of the depth
    scale_walk: float = 0.01  # sigma of the scale's logarithm per keyframe, where nothing observes the scale


class BudgetSettings(Section, frozen=True):
    """Share of a survey that robots get."""

    landmarks_per_m: float = 65.0
    min_landmarks: int = 2000
    view_landmarks: int = 120
    view_distinctive_landmarks: int = 60
    tile_landmarks: int = 5500


class CullSettings(Section, frozen=True):
    """Parts removed from a finished survey, and parts left out of its adjustment."""

    # Candidates for one landmark; it also needs overlapping 3 sigma regions, no keyframe that sees both, and
    duplicate_m: float = 0.05
    duplicate_distance: int = 50  # at most so many differing descriptor bits
    min_parallax_deg: float = 0.5  # over all keyframes and the baseline
    redundant_share: float = 0.9  # a keyframe is redundant if this share of its landmarks is seen by
    redundant_observers: int = 3  # so many others at the same scale or a finer one
    # A keyframe is left out of the global adjustment if this share of its tracks is seen on
    repeated_share: float = 0.7
    repeated_visits: int = 3  # so many other visits; it is placed among its landmarks afterwards


class SessionSettings(Section, frozen=True):
    """Localization of a survey in the map, allowed motion there, and addition and removal of landmarks."""

    fix_keyframes: int = 60  # spread over the survey, that are localized in the map
    top_places: int = 6  # candidates for each of them
    min_inliers: int = 20  # landmarks of the map that a keyframe must see
    min_cells: int = 6  # of 48 image cells with inliers
    min_fixes: int = 4  # keyframes that must agree on the alignment
    min_places: int = 3  # a metre from each other, at which those keyframes stand
    join_error_rate: float = 0.001  # of joining a foreign survey, and of calling one foreign that is not
    search_px: float = 15.0  # around predicted landmarks at first
    guided_px: float = 6.0  # around them after the first joint adjustment
    max_view_angle_deg: float = 35.0  # outside the directions from which a landmark was seen
    anchor_sigma_m: float = 0.01  # of published keyframes
    anchor_sigma_deg: float = 0.1  # of published keyframes
    still_m: float = 0.005  # added to covariances when shifts are judged
    significance: float = 25.902  # 0.99999 of chi-square with 3 degrees of freedom: a site has 10,000s of landmarks
    fade_probability: float = 0.001
    look_weight: float = 0.7  # looks of one survey resemble each other: each counts for less than one
    min_confirmations: int = 3
    covered_share: float = 0.2  # an image cell lacks landmarks below this share of the survey's own
    new_place_landmarks: int = 40  # new landmarks that make a new keyframe a place


class SegmentSettings(Section, frozen=True):
    """Division of a long survey into segments, which are tracked and adjusted in parallel."""

    seconds: float = 120.0  # of a segment, at least; 0: never cut. A survey shorter than two of them stays whole
    overlap_s: float = 10.0  # before its first frame, in which its odometry starts

    def __post_init__(self) -> None:
        if self.seconds and not 0 < self.overlap_s <= self.seconds / 2:
            raise ValueError(
                f"an overlap of {self.overlap_s} s is invalid: give a value above 0 and at most half of a segment of {self.seconds} s"
            )


class SurveySettings(Section, frozen=True):
    """All settings of a survey."""

    seed: int = 0
    occupancy_grid: bool = True
    surfel_map: bool = True
    survey_pictures: bool = True
    odometry: OdometrySettings = OdometrySettings()
    orb: OrbSettings = OrbSettings(count=1200)
    stereo: StereoSettings = StereoSettings()
    align: AlignSettings = AlignSettings()
    keyframes: KeyframeSettings = KeyframeSettings()
    segments: SegmentSettings = SegmentSettings()
    pairs: PairSettings = PairSettings()
    loops: LoopSettings = LoopSettings()
    monocular: SingleCameraSettings = SingleCameraSettings()
    noise: NoiseSettings = NoiseSettings()
    bundle: BundleSettings = BundleSettings(max_iterations=20, relative_cost_tolerance=1e-6)
    # Outliers converge slowly: they are cut after a few steps, and the rest converges without them.
    rough_bundle: BundleSettings = BundleSettings(max_iterations=8, relative_cost_tolerance=1e-3)
    final_bundle: BundleSettings = BundleSettings(
        max_iterations=20, relative_cost_tolerance=1e-4, huber_sigmas=0.7, cutoff_sigmas=2.5
    )
    budget: BudgetSettings = BudgetSettings()
    cull: CullSettings = CullSettings()
    sessions: SessionSettings = SessionSettings()
    local_window: int = 20  # keyframes adjusted together while the chain grows
    min_observations: int = 2  # keyframes that must see a landmark
    # Odometry's sigma across a blackout up to which components are joined; else the largest one is the map
    join_sigma_m: float = 0.1
