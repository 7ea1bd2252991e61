"""Settings of relocalization, shared by robots and by the server, which predicts the robots' results."""

from typing import NamedTuple

from fleetmap.config import Section
from fleetmap.features.settings import OrbSettings, StereoSettings

STRONG_INLIERS = 60  # inliers with which a fix may determine a place regardless of missing landmarks


class FixSettings(Section, frozen=True):
    """Settings for the fix of one frame."""

    min_inliers: int = 15  # of a pose
    min_cells: int = 6  # of the image with inliers
    min_recall: float = 0.13
    top_places: int = 8  # most similar places that are tried
    top_places_found: int = 1  # the same while a consistent pose is known
    alias_votes_share: float = 0.2  # also try every place with at least this share of the best place's votes
    most_aliases: int = 64  # aliases that are tried
    max_distance: int = 75  # bits of 256
    ratio: float = 0.9  # best over second best distance
    guided_distance: int = 70  # bits, near the predicted pixel
    guided_ratio: float = 0.95  # best over second best distance there
    guided_radius_px: float = 12.0  # smallest search radius
    max_radius_px: float = 60.0  # above this uncertainty the search starts from similar places
    feature_sigma_px: float = 0.8  # at the finest image scale
    disparity_sigma_px: float = 0.2  # at every scale
    ransac_px: float = 5.0  # inlier distance
    rotation_sigma_rad: float = 0.03  # of the rotation that gravity and odometry predict
    covariance_scale: float = 1.2  # factor on the fix's own covariance: residuals are not quite independent
    floor_m: float = 0.002  # smallest sigma of a fix, besides the error of the map: what many matches share
    floor_rad: float = 0.0003  # the same of its rotation
    max_view_angle_deg: float = 75.0  # outside the directions from which a landmark was seen


class RelocalizerSettings(NamedTuple):
    """Settings of a relocalizer: features, disparities, fixes, and the seed of its RANSAC."""

    seed: int = 0
    stereo: StereoSettings = StereoSettings()
    orb: OrbSettings = OrbSettings(count=1000)
    fix: FixSettings = FixSettings()
