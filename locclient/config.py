"""Configuration file of `locclient`: the robot, its sensors and outputs, and the localizer."""

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from fleetmap.cli_options import Commands, Options, command_defaults, file_type
from fleetmap.config import Section, Tiers, read_given, refuse_internal
from fleetmap.geometry import Array
from fleetmap.hooks import plugins
from fleetmap.recordings import Topics
from fleetmap.sensors.rectification import MountedCamera
from fleetmap.sensors.source_settings import SourceSection
from locclient.hooks import LinkHook
from locclient.localization.settings import LocalizerSettings
from locclient.maps.loaded_map import TileSelectionSettings
from locclient.maps.tile_cache import DEFAULT_MAX_BYTES
from locclient.outputs import OutputSection
from locclient.robot.robot import ImagePriors
from locclient.robot.version_trial import TrialSettings

TIERS = {
    "user": {
        "": "site store server",
        "run": "server store site robot prior cache cache_bytes root identity insecure outbox failures replays surveys",
        "source": "kind sensors calibration recording device",
        "output": "format endpoint robot_height_m stop_above_m autostart",
        "topics": "*",
    },
    "tuning": {
        "run": "outbox_bytes replays_bytes frame_queue imu_wait_s",
        "run.window": "*",
        "run.trial": "*",
        "source": "speed width_px height_px rate_hz delay_s",
        "output": "namespace node pose_topic initial_pose_topic odom_topic status_topic map_topic tf_topic "
        "map_frame building_frame odom_frame base_frame sensor_frames publish_odom transform_tolerance_s",
        "localizer": "seed",
        "localizer.orb": "extractor count",
        "localizer.stereo": "min_depth_m depth_sigma_px",
        "localizer.odometry.filter": "use_wheels",
        "localizer.fix": "min_recall",
        "localizer.track": "fix_interval_s settled_interval_s strong_inliers is_whole_site_mapped telling_evidence "
        "degraded_after_s degraded_radius_m lost_radius_m kidnap_fixes protection_risk",
        "localizer.image_quality": "dark_contrast glare_share blurred_share occluded_depth_share",
    },
}


class RunSection(Section, frozen=True):
    """Name of the robot, source of its map, and limits of its files."""

    server: str | None = None
    store: str | None = None
    site: str | None = None
    robot: str | None = None
    prior: str | None = None
    cache: str | None = None
    cache_bytes: int = DEFAULT_MAX_BYTES
    root: str | None = None
    identity: str | None = None
    insecure: bool = False
    outbox: str | None = None
    outbox_bytes: int = 50_000_000
    failures: str | None = None
    replays: Literal["off", "blurred", "full"] = "blurred"
    replays_bytes: int = 50_000_000
    surveys: bool = False
    frame_queue: Annotated[int, msgspec.Meta(ge=1)] = 2
    imu_wait_s: float = 0.05
    window: TileSelectionSettings = TileSelectionSettings()
    trial: TrialSettings = TrialSettings()


class LocclientConfig(Section, frozen=True):
    """The whole file. Top-level `site`, and either `store` or `server`, apply to [run] and [replay]."""

    site: str | None = None
    store: str | None = None
    server: str | None = None
    run: RunSection = RunSection()
    source: SourceSection = SourceSection()
    output: OutputSection = OutputSection()
    topics: Topics = Topics()
    localizer: LocalizerSettings = LocalizerSettings()


def read_config(path: Path | None, commands: Commands) -> tuple[LocclientConfig, Options]:
    """Read the settings of the file at `path` and its options for `commands`; the defaults if `path` is None.

    Raises UsageError as `load_toml`, and for keys that are internal constants.
    """
    if path is None:
        return LocclientConfig(), {}
    defaults, tiers = with_plugins()
    given = read_given(path, file_type(type(defaults), commands))
    for name in ("run", "replay"):  # which the top-level keys complete
        section: dict[str, Any] = given.get(name, {})
        keys = {"site"} if {"store", "server"} & section.keys() else {"site", "store", "server"}
        given[name] = {key: given[key] for key in keys if key in given} | section
    refuse_internal(path, given, defaults, tiers)
    settings = {key: given[key] for key in defaults.__struct_fields__ if key in given}
    return msgspec.convert(settings, type(defaults)), command_defaults(given, commands)


def with_plugins() -> tuple[LocclientConfig, Tiers]:
    """Return the defaults of the whole file, with the sections of the installed plug-ins, and the tiers of its keys."""
    hooks = plugins("locclient.links") | plugins("locclient.priors")
    sections = [(name, hook.section, hook.section()) for name, hook in hooks.items()]
    kind: type[LocclientConfig] = msgspec.defstruct(  # type: ignore[assignment]
        "Config", sections, bases=(LocclientConfig,), frozen=True, kw_only=True
    )
    return kind(), TIERS | {"user": TIERS["user"] | {name: "*" for name, _, _ in sections}}


def links_of(config: LocclientConfig) -> list[tuple[LinkHook, Section]]:
    """Return the links that the file asks for, with their sections."""
    sections = ((hook, getattr(config, name, None)) for name, hook in plugins("locclient.links").items())
    return [(hook, section) for hook, section in sections if section is not None and hook.is_on(section)]


def image_priors_of(config: LocclientConfig, mounted: MountedCamera, base_from_body: Array) -> list[ImagePriors]:
    """Open the priors by images that the file asks for; UsageError for invalid settings."""
    sections = ((hook, getattr(config, name, None)) for name, hook in plugins("locclient.priors").items())
    opened = (hook.open(section, mounted, base_from_body) for hook, section in sections if section is not None)
    return [prior for prior in opened if prior is not None]


def with_insecure(config: LocclientConfig, *, insecure: bool) -> LocclientConfig:
    """Return the configuration, with [run] insecure set if `insecure`."""
    run = msgspec.structs.replace(config.run, insecure=config.run.insecure or insecure)
    return msgspec.structs.replace(config, run=run)
