"""Configuration file of `locclient`: the robot, its sensors and outputs, the localizer, and the options of `replay`."""

from pathlib import Path
from typing import Any

import msgspec

from fleetmap.config import Section, read_given, refuse_internal
from fleetmap.recordings import Topics
from locclient.daemon.publishers import OutputSection
from locclient.daemon.run_settings import RunSection
from locclient.localization.settings import LocalizerSettings
from locclient.maps.tile_cache import DEFAULT_MAX_BYTES
from locclient.sensors.source import SourceSection

TIERS = {
    "user": {
        "": "site store server",
        "replay": "*",
        "run": "server store site robot prior cache cache_bytes spool failures",
        "source": "kind calibration endpoint recording device",
        "output": "format endpoint",
        "topics": "*",
    },
    "tuning": {
        "run": "spool_bytes frame_queue imu_wait_s",
        "run.window": "*",
        "run.trial": "*",
        "source": "domain speed width_px height_px rate_hz delay_s",
        "output": "domain pose_topic status_topic tf_topic map_frame odom_frame base_frame publish_odom",
        "localizer": "seed",
        "localizer.orb": "extractor count",
        "localizer.stereo": "min_depth_m depth_sigma_px",
        "localizer.odometry.filter": "use_wheels",
        "localizer.fix": "min_hit_share",
        "localizer.track": "fix_interval_s settled_interval_s strong_inliers is_whole_site_mapped telling_evidence "
        "degraded_after_s degraded_radius_m lost_radius_m kidnap_fixes",
        "localizer.sight": "dark_contrast glare_share blurred_share occluded_depth_share",
    },
}


class ReplaySection(Section, frozen=True):
    """Options of `locclient replay`; the command line goes before them."""

    server: str | None = None
    store: str | None = None
    site: str | None = None
    robot: str = "replay"
    frames: str = ":"
    calibration: str | None = None
    prior: str | None = None
    reverse: bool = False
    realtime: bool = False
    report: str | None = None
    trajectory: str | None = None
    picture: str | None = None
    cache: str | None = None
    cache_bytes: int = DEFAULT_MAX_BYTES


class LocclientConfig(Section, frozen=True):
    """The whole file. `site`, and either `store` or `server`, at its top go for [run] and [replay]."""

    site: str | None = None
    store: str | None = None
    server: str | None = None
    replay: ReplaySection = ReplaySection()
    run: RunSection = RunSection()
    source: SourceSection = SourceSection()
    output: OutputSection = OutputSection()
    topics: Topics = Topics()
    localizer: LocalizerSettings = LocalizerSettings()


def read_config(path: Path | None) -> LocclientConfig:
    """Settings of the file at `path`, the defaults without one; UsageError as `load_toml`, and for internal constants."""
    if path is None:
        return LocclientConfig()
    given = read_given(path, LocclientConfig)
    refuse_internal(path, given, LocclientConfig(), TIERS)
    return msgspec.convert(with_common(given), LocclientConfig)


def with_common(given: dict[str, Any]) -> dict[str, Any]:
    """The content of a file, its [run] and [replay] completed by the keys at the top."""
    completed = dict(given)
    for name in ("run", "replay"):
        section: dict[str, Any] = given.get(name, {})
        left_out = {"store", "server"} if {"store", "server"} & set(section) else set()
        keys = {"site", "store", "server"} - left_out
        completed[name] = {key: given[key] for key in keys if key in given} | section
    return completed
