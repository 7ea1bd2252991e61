"""The configuration file of `mapserver`: one section for each command, [survey] for how maps are made, [gate]
for which drafts are refused, [ingest], [canary] and [resurvey] for what is made of the robots' reports.

A command's section holds its options under their names, with `_` for `-`. Paths are relative to the working directory,
as on the command line.
"""

from pathlib import Path
from typing import Any

import msgspec

from fleetmap.config import Section, load_toml
from fleetmap.sensors.samples import SensorSet
from mapserver.fleet.ingest import IngestSettings
from mapserver.fleet_statistics.canary_test import CanarySettings
from mapserver.fleet_statistics.resurvey_test import ResurveySettings
from mapserver.quality.gate import GateSettings
from mapserver.survey.settings import SurveySettings

_PRESETS = Path(__file__).parent / "presets"


class BuildSection(Section, frozen=True):
    """Options of `mapserver build`."""

    site: str | None = None
    store: str | None = None
    frames: str | None = None
    calibration: str | None = None
    zones: str | None = None
    vocabulary: str | None = None
    report: str | None = None
    trajectory: str | None = None
    picture: str | None = None
    frame_from_ground_truth: bool | None = None
    use: str | None = None
    replay: list[str] | None = None
    threads: int | None = None
    scheduler: str | None = None


class NightlySection(Section, frozen=True):
    """Options of `mapserver nightly`."""

    site: str | None = None
    inbox: str | None = None
    store: str | None = None
    settle_s: float | None = None
    frames: str | None = None
    calibration: str | None = None
    zones: str | None = None
    report: str | None = None
    threads: int | None = None
    scheduler: str | None = None


class PublishSection(Section, frozen=True):
    """Options of `mapserver publish`."""

    site: str | None = None
    store: str | None = None
    version: int | None = None
    force: bool | None = None
    actor: str | None = None
    reason: str | None = None


class ActSection(Section, frozen=True):
    """Options of `mapserver rollback`."""

    site: str | None = None
    store: str | None = None
    actor: str | None = None
    reason: str | None = None


class PromoteSection(Section, frozen=True):
    """Options of `mapserver promote`."""

    site: str | None = None
    store: str | None = None
    canary: str | None = None
    actor: str | None = None
    reason: str | None = None


class StoreSection(Section, frozen=True):
    """Options of `mapserver versions`, `inspect`, `diff` and `verify` that make sense in a file."""

    site: str | None = None
    store: str | None = None
    version: int | None = None
    json: bool | None = None


class GcSection(Section, frozen=True):
    """Options of `mapserver gc`."""

    store: str | None = None
    keep_versions: int | None = None
    keep_drafts: int | None = None
    keep_days: float | None = None
    robot_days: float | None = None
    dry_run: bool | None = None
    json: bool | None = None
    actor: str | None = None
    reason: str | None = None


class ExportSection(Section, frozen=True):
    """Options of `mapserver export`."""

    site: str | None = None
    store: str | None = None
    version: int | None = None
    without_archive: bool | None = None


class ImportSection(Section, frozen=True):
    """Options of `mapserver import`."""

    store: str | None = None
    actor: str | None = None
    reason: str | None = None


class ServeSection(Section, frozen=True):
    """Options of `mapserver serve`."""

    store: str | None = None
    http: str | None = None
    zenoh: str | None = None
    token_file: str | None = None


class FleetReportSection(Section, frozen=True):
    """Options of `mapserver fleet report`."""

    site: str | None = None
    store: str | None = None
    hours: int | None = None


class FleetExportSection(Section, frozen=True):
    """Options of `mapserver fleet export`."""

    site: str | None = None
    store: str | None = None
    hours: int | None = None
    kind: str | None = msgspec.field(default=None, name="format")


class FleetResurveySection(Section, frozen=True):
    """Options of `mapserver fleet resurvey`."""

    site: str | None = None
    store: str | None = None
    route: str | None = None
    json: bool | None = None


class FleetSection(Section, frozen=True):
    """The commands of `mapserver fleet`."""

    report: FleetReportSection = FleetReportSection()
    export: FleetExportSection = FleetExportSection()
    resurvey: FleetResurveySection = FleetResurveySection()


class ConvertSection(Section, frozen=True):
    """Options of `mapserver convert`."""

    calibration: str | None = None
    force: bool | None = None


class DoctorSection(Section, frozen=True):
    """Options of `mapserver doctor`; json_file is its --json."""

    calibration: str | None = None
    json_file: str | None = None


class EvaluateSection(Section, frozen=True):
    """Options of `mapserver evaluate`."""

    ground_truth: str | None = None
    covariances: str | None = None
    from_first: bool | None = None
    frames: int | None = None
    json: bool | None = None


class TrainVocabularySection(Section, frozen=True):
    """Options of `mapserver train-vocabulary`."""

    out: str | None = None
    frames: str | None = None
    branching: int | None = None
    levels: int | None = None
    seed: int | None = None


class MapserverConfig(Section, frozen=True, rename={"import_": "import"}):
    """The whole file."""

    build: BuildSection = BuildSection()
    survey: SurveySettings = SurveySettings()
    gate: GateSettings = GateSettings()
    nightly: NightlySection = NightlySection()
    ingest: IngestSettings = IngestSettings()
    canary: CanarySettings = CanarySettings()
    resurvey: ResurveySettings = ResurveySettings()
    publish: PublishSection = PublishSection()
    promote: PromoteSection = PromoteSection()
    rollback: ActSection = ActSection()
    versions: StoreSection = StoreSection()
    inspect: StoreSection = StoreSection()
    diff: StoreSection = StoreSection()
    verify: StoreSection = StoreSection()
    gc: GcSection = GcSection()
    export: ExportSection = ExportSection()
    import_: ImportSection = ImportSection()
    serve: ServeSection = ServeSection()
    fleet: FleetSection = FleetSection()
    convert: ConvertSection = ConvertSection()
    doctor: DoctorSection = DoctorSection()
    evaluate: EvaluateSection = EvaluateSection()
    train_vocabulary: TrainVocabularySection = TrainVocabularySection()


def read_config(path: Path | None) -> MapserverConfig:
    """The settings of the file at `path`, the defaults without one; UsageError as `load_toml`."""
    return MapserverConfig() if path is None else load_toml(path, MapserverConfig)


def survey_settings(path: Path | None, sensor_set: SensorSet) -> SurveySettings:
    """What a survey with these sensors is made by: the preset of the sensor set, and over it the [survey] of the file at `path`."""
    preset = msgspec.toml.decode((_PRESETS / f"{sensor_set.value}.toml").read_bytes())
    given: dict[str, Any] = {} if path is None else msgspec.toml.decode(path.read_bytes()).get("survey", {})
    return msgspec.convert(_over(preset, given), SurveySettings)


def _over(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        merged[key] = _over(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


def command_defaults(config: MapserverConfig) -> dict[str, dict[str, Any]]:
    """By command (and for commands in groups, by command of the group), the options that the file sets."""
    settings = {"survey", "gate", "ingest", "canary", "resurvey"}
    commands = (name for name in msgspec.structs.asdict(config) if name not in settings)
    return {name.rstrip("_").replace("_", "-"): _set_options(getattr(config, name)) for name in commands}


def _set_options(section: Section) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in msgspec.structs.asdict(section).items():
        if isinstance(value, Section):
            if options := _set_options(value):
                found[name] = options
        elif value is not None:
            found[name] = value
    return found
