"""Settings of the localization client; the same for every robot."""

from fleetmap.config import Section
from fleetmap.features.orb import OrbSettings
from fleetmap.features.stereo import StereoSettings
from fleetmap.odometry import OdometrySettings
from fleetmap.relocalization.settings import FixSettings, RelocalizerSettings
from locclient.localization.image_quality import ImageQualitySettings


class TrackSettings(Section, frozen=True):
    """When an estimate may be believed."""

    fix_interval_s: float = 0.2
    settled_interval_s: float = 0.4
    settled_fixes: int = 10
    search_after_failed: int = 1
    confirming_fixes: int = 3
    confirming_distance_m: float = 1.0
    strong_inliers: int = 60
    strong_share: float = 0.55
    strong_twin_share: float = 0.5
    tight_prior_sigma_m: float = 0.6
    innovation_limit: float = 22.458
    hypothesis_distance_m: float = 0.5
    hypothesis_angle_deg: float = 6.0
    rival_share: float = 0.6
    rival_hit_share: float = 0.8
    rival_least_share: float = 0.25
    is_whole_site_mapped: bool = False
    telling_evidence: float = 4.0
    evidence_kept_share: float = 0.8
    max_misses: int = 4
    drift_share: float = 0.01
    drift_floor_m: float = 0.005
    degraded_after_s: float = 0.9
    degraded_radius_m: float = 0.3
    lost_radius_m: float = 3.0
    kidnap_fixes: int = 3
    map_sigma_m: float = 0.02
    map_sigma_rad: float = 0.006


class LocalizerSettings(Section, frozen=True):
    """All of it."""

    seed: int = 0
    odometry: OdometrySettings = OdometrySettings()
    stereo: StereoSettings = StereoSettings()
    orb: OrbSettings = OrbSettings(count=1000)
    fix: FixSettings = FixSettings()
    track: TrackSettings = TrackSettings()
    sight: ImageQualitySettings = ImageQualitySettings()

    @property
    def relocalizer(self) -> RelocalizerSettings:
        """The part of it that places one frame in a map."""
        return RelocalizerSettings(self.seed, self.stereo, self.orb, self.fix)
