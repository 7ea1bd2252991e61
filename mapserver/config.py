"""Configuration file of `mapserver`: common settings, a section per command, and the settings of maps, gate and fleet.

A command's section holds its options under their names, with `_` for `-`. Paths are relative to the working directory, as on the command
line.
"""

from pathlib import Path

import msgspec

from fleetmap.cli_options import Commands, Options, command_defaults, file_type
from fleetmap.config import Section, over, read_given, refuse_internal
from fleetmap.sensors.samples import SensorSet
from fleetmap.sensors.source_settings import SourceSection, Topics
from mapserver.fleet.alerts import AlertSettings
from mapserver.fleet.ingest import IngestSettings
from mapserver.fleet_statistics.canary_decision import CanarySettings
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings
from mapserver.quality.gate import GateSettings
from mapserver.survey.settings import SurveySettings

_PRESETS = Path(__file__).parent / "presets"

TIERS = {
    "user": {"": "site store", "source": "kind sensors calibration recording device", "topics": "*", "alerts": "*"},
    "tuning": {
        "source": "speed width_px height_px rate_hz delay_s",
        "gate": "*",
        "ingest": "*",
        "canary": "*",
        "resurvey": "*",
        "survey": "seed occupancy_grid surfel_map survey_pictures",
        "survey.orb": "extractor count",
        "survey.stereo": "min_depth_m depth_sigma_px",
        "survey.keyframes": "policy every_nth min_overlap max_rotation_deg max_parallax max_interval_s",
        "survey.segments": "*",
        "survey.loops": "top min_gap_keyframes repeats_every_m",
        "survey.noise": "disparity_sigma_px",
        "survey.sessions": "fade_probability min_confirmations",
        "survey.budget": "*",
        "survey.odometry.filter": "use_wheels",
    },
}


class MapserverConfig(Section, frozen=True):
    """The file without the sections of commands. source: sensors of a survey robot, for `live`; topics: also used for recordings."""

    site: str | None = None
    store: str | None = None
    source: SourceSection = SourceSection()
    topics: Topics = Topics()
    survey: SurveySettings = SurveySettings()
    gate: GateSettings = GateSettings()
    ingest: IngestSettings = IngestSettings()
    canary: CanarySettings = CanarySettings()
    resurvey: ResurveySettings = ResurveySettings()
    alerts: AlertSettings = AlertSettings()


def read_config(path: Path | None, commands: Commands) -> tuple[MapserverConfig, Options]:
    """Return the settings of the file at `path` and the options that it sets; the defaults for None.

    UsageError as `load_toml`, and for keys that are internal constants.
    """
    if path is None:
        return MapserverConfig(), {}
    given = read_given(path, file_type(MapserverConfig, commands))
    refuse_internal(path, given, MapserverConfig(), TIERS)
    settings = {key: given[key] for key in MapserverConfig.__struct_fields__ if key in given}
    return msgspec.convert(settings, MapserverConfig), command_defaults(given, commands)


def survey_settings(path: Path | None, sensor_set: SensorSet) -> SurveySettings:
    """Return the survey settings for these sensors: the preset, overridden by [survey] of the file at `path`."""
    preset = msgspec.toml.decode((_PRESETS / f"{sensor_set.value}.toml").read_bytes())
    given = {} if path is None else msgspec.toml.decode(path.read_bytes()).get("survey", {})
    return msgspec.convert(over(preset, given), SurveySettings)
