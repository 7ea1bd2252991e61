"""Settings of the localization client; the same for every robot."""

from typing import Annotated

import msgspec

from fleetmap.config import Section
from fleetmap.features.settings import OrbSettings, StereoSettings
from fleetmap.odometry.settings import OdometrySettings
from fleetmap.relocalization.settings import STRONG_INLIERS, FixSettings, RelocalizerSettings
from locclient.localization.image_quality import ImageQualitySettings


class TrackSettings(Section, frozen=True):
    """Tracking: map queries, confirmation, competitors, drift, status."""

    fix_interval_s: float = 0.2
    settled_interval_s: float = 0.4
    settled_fixes: int = 10  # successful fixes in a row before the longer interval
    search_after_failed: int = 1  # failed fixes at the prediction before a global search
    confirming_fixes: int = 3  # that must agree before tracking begins
    confirming_distance_m: float = 1.0  # motion between them
    strong_inliers: int = STRONG_INLIERS
    strong_share: float = 0.55  # inlier share of a fix that is accepted at once
    # Votes of another place, relative to the best one's, that forbid it; chance reaches 0.36
    strong_alias_share: float = 0.5
    tight_prior_sigma_m: float = 0.6  # a prior this tight confirms the first fix
    # Error rate of operators' poses, which are weighed against aliases of the place. An assumption
    wrong_prior_share: float = 0.05
    near_prior_sigma_m: float = 2.1  # 3.7 sigmas exclude the look-alikes that the map server searches, 8 m away
    # Squared Mahalanobis distance from the prediction: 0.999 of chi-square, 6 degrees of freedom
    innovation_limit: float = 22.458
    hypothesis_distance_m: float = 0.5  # within which fixes support one hypothesis
    hypothesis_angle_deg: float = 6.0  # within which fixes support one hypothesis
    competitor_share: float = 0.6  # a competitor with this share of the best one's inliers makes the pose ambiguous
    competitor_recall_share: float = 0.8  # so does one with this share of its landmark recall
    competitor_least_share: float = 0.25  # and at least this share of its inliers
    is_whole_site_mapped: bool = False
    telling_evidence: float = 6.0  # a sequential test at this limit errs in one case of 400 (Wald 1945)
    evidence_kept_share: float = 0.8  # decay of a hypothesis's inliers from fix to fix
    max_misses: int = 4  # contradicting fixes in a row that end a hypothesis
    drift_share: float = 0.005  # odometry error beyond its own covariance, as a share of the distance
    drift_floor_m: float = 0.001  # the same from fix to fix
    drift_rad: float = 0.0003  # the same of the rotation
    degraded_after_s: float = 0.9
    degraded_radius_m: float = 0.3
    lost_radius_m: float = 3.0
    kidnap_fixes: int = 3
    # Probability that a pose's error exceeds its protection level, for each fix; see docs/warranty.md
    protection_risk: Annotated[float, msgspec.Meta(ge=1e-9, le=0.1)] = 1e-5


class LocalizerSettings(Section, frozen=True):
    """Settings of a localizer."""

    seed: int = 0
    odometry: OdometrySettings = OdometrySettings()
    stereo: StereoSettings = StereoSettings()
    orb: OrbSettings = OrbSettings(count=1000)
    fix: FixSettings = FixSettings()
    track: TrackSettings = TrackSettings()
    image_quality: ImageQualitySettings = ImageQualitySettings()

    @property
    def relocalizer(self) -> RelocalizerSettings:
        """Return the settings of relocalization."""
        return RelocalizerSettings(self.seed, self.stereo, self.orb, self.fix)
