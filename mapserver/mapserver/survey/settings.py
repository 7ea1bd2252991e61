"""Settings of a survey: one set for each sensor set, none for a single recording."""

from typing import Literal

from fleetmap.config import Section
from fleetmap.features.orb import OrbSettings
from fleetmap.features.patch_align import AlignSettings
from fleetmap.features.stereo import StereoSettings
from fleetmap.odometry import OdometrySettings
from mapserver.survey.bundle.bundle_adjustment import BundleSettings


class KeyframeSettings(Section, frozen=True):
    """When a frame becomes a keyframe."""

    policy: Literal["overlap", "every", "every-nth"] = "overlap"
    every_nth: int = 5
    min_overlap: float = 0.6
    max_rotation_deg: float = 12.0
    max_parallax: float = 0.12
    max_interval_s: float = 2.0
    min_sharpness: float = 0.5
    break_overlap: float = 0.3


class PairSettings(Section, frozen=True):
    """Which keyframes are matched with each other, and how."""

    previous: int = 6
    covisible: int = 10
    min_overlap: float = 0.15
    max_distance: int = 70
    ratio: float = 0.85
    guided_distance: int = 60
    guided_radius_px: float = 6.0
    search_px: float = 8.0
    min_inliers: int = 12
    match_sigma_px: float = 1.5


class LoopSettings(Section, frozen=True):
    """Which revisits are looked for and believed."""

    top: int = 8
    depth: int = 128
    per_place: int = 8
    min_gap_keyframes: int = 8
    max_innovation: float = 22.458  # 0.999 of chi-square with 6 degrees of freedom
    view_range_depths: float = 1.0
    repeats_every_m: float = (
        0.0  # how far apart aisles that look alike are, where the site's people know it; 0 where they do not
    )
    min_inliers: int = 15
    alone_inliers: int = 30
    min_cells: int = 6
    rotation_sigma_limit_rad: float = 0.12


class NoiseSettings(Section, frozen=True):
    """What the bundle adjustment believes of its measurements."""

    aligned_sigma_px: float = 0.35
    descriptor_sigma_px: float = 0.9
    disparity_sigma_px: float = 0.2
    cut_sigmas: float = 4.0
    turn_floor_px: float = 0.02
    turn_sigmas: float = 3.0
    accel_noise_scale: float = 5.0
    gyro_noise_scale: float = 2.0
    walk_scale: float = 1.0


class SingleCameraSettings(Section, frozen=True):
    """How the survey of one camera places features and lets the scale wander."""

    depth_views: int = 5
    match_sigma_px: float = 1.0
    min_angle_deg: float = 0.8
    max_depth_sigma_share: float = 0.12
    scale_walk: float = 0.01


class VocabularySettings(Section, frozen=True):
    """The tree trained on a site's first survey."""

    branching: int = 10
    levels: int = 4
    max_descriptors: int = 200_000


class BudgetSettings(Section, frozen=True):
    """How much of a survey robots get."""

    landmarks_per_m: float = 65.0
    min_landmarks: int = 2000
    view_landmarks: int = 120
    view_distinct_landmarks: int = 60
    tile_landmarks: int = 5500


class CullSettings(Section, frozen=True):
    """What a finished survey does not hand on, and what takes no part in adjusting it."""

    duplicate_m: float = 0.05
    duplicate_distance: int = 50
    min_parallax_deg: float = 0.5
    redundant_share: float = 0.9
    redundant_observers: int = 3
    repeated_share: float = 0.7
    repeated_visits: int = 3


class SessionSettings(Section, frozen=True):
    """How a survey is found in the map, what may move there, and when landmarks come and go."""

    fix_keyframes: int = 60
    top_places: int = 6
    min_inliers: int = 20
    min_cells: int = 6
    min_fixes: int = 4
    agreement_m: float = 0.3
    agreement_share: float = 0.02  # of the way between two fixes: what the survey's own shape may be off by
    agreement_deg: float = 3.0
    rival_share: float = 0.5
    search_px: float = 15.0
    guided_px: float = 6.0
    max_view_angle_deg: float = 35.0
    anchor_sigma_m: float = 0.01
    anchor_sigma_deg: float = 0.1
    still_m: float = 0.005
    significance: float = 25.902  # 0.99999 of chi-square with 3 degrees of freedom: a site has 10,000s of landmarks
    fade_probability: float = 0.001
    look_weight: float = 0.7  # looks of one survey resemble each other: each counts for less than one
    min_confirmations: int = 3
    covered_share: float = 0.2
    new_place_landmarks: int = 40


class SurveySettings(Section, frozen=True):
    """All of it."""

    seed: int = 0
    odometry: OdometrySettings = OdometrySettings()
    orb: OrbSettings = OrbSettings(count=1200)
    stereo: StereoSettings = StereoSettings()
    align: AlignSettings = AlignSettings()
    keyframes: KeyframeSettings = KeyframeSettings()
    pairs: PairSettings = PairSettings()
    loops: LoopSettings = LoopSettings()
    monocular: SingleCameraSettings = SingleCameraSettings()
    noise: NoiseSettings = NoiseSettings()
    bundle: BundleSettings = BundleSettings(max_iterations=20, relative_cost_tolerance=1e-6)
    rough_bundle: BundleSettings = BundleSettings(max_iterations=20, relative_cost_tolerance=1e-3)
    final_bundle: BundleSettings = BundleSettings(
        max_iterations=20, relative_cost_tolerance=1e-4, huber_sigmas=0.7, cutoff_sigmas=2.5
    )
    vocabulary: VocabularySettings = VocabularySettings()
    budget: BudgetSettings = BudgetSettings()
    cull: CullSettings = CullSettings()
    sessions: SessionSettings = SessionSettings()
    local_window: int = 20
    min_observations: int = 2
    join_sigma_m: float = 0.1
