"""Settings of relocalization: the same for a robot and for the server that judges what robots will see."""

from typing import NamedTuple

from fleetmap.config import Section
from fleetmap.features.orb import OrbSettings
from fleetmap.features.stereo import StereoSettings


class FixSettings(Section, frozen=True):
    """How one frame is placed in the map."""

    min_inliers: int = 15
    min_cells: int = 6
    min_hit_share: float = 0.13
    top_places: int = 8
    top_places_found: int = 1
    twin_votes_share: float = 0.2
    most_twins: int = 64
    max_distance: int = 75
    ratio: float = 0.9
    guided_distance: int = 70
    guided_ratio: float = 0.95
    guided_radius_px: float = 12.0
    max_radius_px: float = 60.0
    feature_sigma_px: float = 0.8
    disparity_sigma_px: float = 0.2
    ransac_px: float = 5.0
    rotation_sigma_rad: float = 0.03
    covariance_scale: float = 4.0
    floor_m: float = 0.01
    floor_rad: float = 0.002
    max_view_angle_deg: float = 75.0


class RelocalizerSettings(NamedTuple):
    """What a relocalizer needs: features, disparities, how a frame is placed, and the seed of its RANSAC."""

    seed: int = 0
    stereo: StereoSettings = StereoSettings()
    orb: OrbSettings = OrbSettings(count=1000)
    fix: FixSettings = FixSettings()
