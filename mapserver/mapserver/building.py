"""The rim around the survey: opens the recording and the store, runs the survey, writes draft, report and pictures."""

import resource
import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from rich.console import Console

from fleetmap.bow import encode_vocabulary
from fleetmap.config import to_dict
from fleetmap.errors import RecordingError, StoreError
from fleetmap.mapformat import CameraEntry, RecordingEntry
from fleetmap.recordings import FrameSelection, OpenOptions, Recording, open_recording
from fleetmap.recordings.tum import write_tum
from fleetmap.rectification import Rectifier
from fleetmap.samples import SensorSet
from mapserver.build_report import Accuracy, BuildReport, accuracy, check_truth, full_report, make_report
from mapserver.progress import ProgressView, StageTimes
from mapserver.recording_checks import checked
from mapserver.store import DraftDetails, MapStore
from mapserver.store.archive import encode_archive
from mapserver.survey.moving import moved
from mapserver.survey.pipeline import Survey, survey
from mapserver.survey.placing import map_from_survey
from mapserver.survey.settings import SurveySettings
from mapserver.survey.zones import Zones
from mapserver.tiling import TILE_SIZE_M, tiles_from_survey
from mapserver.vocabulary_choice import ChosenVocabulary, choose_vocabulary, judged
from mapserver.zones_file import read_zones

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LIBRARIES = ("numpy", "numba", "opencv-python-headless", "gtsam", "scipy", "fleetmap")


@dataclass(frozen=True, slots=True)
class BuildOrder:
    """What `mapserver build` was asked for; frames is an A:B:C slice, absent files are not written."""

    recording: Path
    site: str
    store: Path
    frames: str = "::"
    calibration: Path | None = None
    zones: Path | None = None
    vocabulary: Path | None = None
    report: Path | None = None
    trajectory: Path | None = None
    picture: Path | None = None
    frame_from_ground_truth: bool = False


@dataclass(frozen=True)
class _Built:
    """A finished survey, in its final frame, and how good it is."""

    survey: Survey
    accuracy: Accuracy
    vocabulary: ChosenVocabulary
    zones: Zones
    frames: int
    times: StageTimes
    started_s: float


def run_build(order: BuildOrder, settings: SurveySettings) -> str:
    """Does it; the sentence says what there is now. Raises FleetmapErrors, before the survey where possible."""
    started_s = time.perf_counter()
    console = Console(stderr=True)
    selection = FrameSelection.parse(order.frames)
    zones = Zones() if order.zones is None else read_zones(order.zones)
    with open_recording(order.recording, OpenOptions(calibration_file=order.calibration)) as source:
        for loss in source.losses:
            console.print(f"loss: {loss.what}: {loss.detail}", markup=False)
        indices = selection.apply(source)
        _check(source, indices, order)
        times = StageTimes(time.perf_counter)
        recording, remarks = _examined(source, console)
        times("examination", 1, 1)
        with MapStore.open(order.store, create=True) as maps:
            chosen = choose_vocabulary(maps, order.site, order.vocabulary)
            built = _survey(order, recording, indices, zones, chosen, settings, console, times, started_s)
            return _keep(order, recording, built, remarks, settings, maps)


def _examined(recording: Recording, console: Console) -> tuple[Recording, list[str]]:
    """The recording as it is to be surveyed, and the doctor's remarks, which are printed too."""
    examined = checked(recording)
    remarks = examined.remarks()
    for remark in remarks:
        console.print(f"{recording.name}: {remark}", markup=False)
    return examined.recording, remarks


def _check(recording: Recording, indices: "NDArray[Any]", order: BuildOrder) -> None:
    """Refuses before the work what could not end well."""
    if recording.sensor_set in (SensorSet.MONO, SensorSet.MONO_INERTIAL):
        raise RecordingError(
            f"{recording.path} is {recording.sensor_set}: a survey needs a second camera or a depth sensor; "
            "record with one"
        )
    if order.frame_from_ground_truth:
        check_truth(str(recording.path), recording.frame_stamps_ns[indices], recording.ground_truth)


def _survey(
    order: BuildOrder, recording: Recording, indices: "NDArray[Any]", zones: Zones, chosen: ChosenVocabulary,
    settings: SurveySettings, console: Console, times: StageTimes, started_s: float,
) -> _Built:  # fmt: skip
    rectifier = Rectifier(recording.calibration, has_depth=recording.sensor_set is SensorSet.RGBD)
    frames = (recording.read_frame(int(index)) for index in indices)
    with ProgressView(console) as view:

        def progress(stage: str, done: int, total: int) -> None:
            times(stage, done, total)
            view(stage, done, total)

        done = survey(
            frames, len(indices), recording.imu, recording.calibration, rectifier,
            chosen.vocabulary, settings, zones, progress,
        )  # fmt: skip
    times.begin("vocabulary")
    chosen = judged(chosen, done, settings)
    times.begin("storing")
    placed = map_from_survey(done.map, recording.priors, recording.calibration.base_from_body)
    if placed is not None:
        done = replace(done, map=moved(done.map, placed))
    found = accuracy(done.map, recording.ground_truth)
    if order.frame_from_ground_truth:
        if found.rigid is None:
            raise RecordingError(
                f"{recording.path}: too few estimated frames have a ground truth; build without "
                "--frame-from-ground-truth"
            )
        done = replace(done, map=moved(done.map, found.rigid.frame_from_estimate))
    return _Built(done, found, chosen, zones, len(indices), times, started_s)


def _keep(
    order: BuildOrder, recording: Recording, built: _Built, remarks: list[str], settings: SurveySettings, maps: MapStore
) -> str:
    tiles = tiles_from_survey(built.survey.map)
    archive = encode_archive(built.survey.map)
    vocabulary = encode_vocabulary(built.vocabulary.vocabulary)
    content_hash = recording.content_hash()
    report = make_report(
        recording.name, built.survey.map, built.survey.loops, built.accuracy, built.vocabulary.download_bytes(len(vocabulary)),
        time.perf_counter() - built.started_s, _peak_rss_mb(),
    )  # fmt: skip
    remarks = [*remarks, *(part.remark() for part in built.survey.parts if not part.kept)]
    report = msgspec.structs.replace(report, findings={recording.name: remarks})
    details = DraftDetails(
        created=datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
        tile_size_m=TILE_SIZE_M,
        camera=_camera_entry(built.survey),
        recordings=(RecordingEntry(name=recording.name, sha256=content_hash, frames=built.frames),),
        configuration=_configuration(order, built.zones, settings),
        libraries=_library_versions(),
        # A robot downloads the manifest: what it says about the build is short.
        report={key: value for key, value in msgspec.to_builtins(report).items() if key != "map_bytes"},
    )
    version = maps.save_draft(order.site, tiles=tiles, vocabulary=vocabulary, details=details, archive=archive)
    info = maps.version(order.site, version)
    report = msgspec.structs.replace(report, map_bytes=info.map_bytes)
    built.times.begin("writing")
    _write_files(order, recording, built, report, version)
    return _sentence(order.site, version, report)


def _configuration(order: BuildOrder, zones: Zones, settings: SurveySettings) -> dict[str, Any]:
    """What the map depends on besides the recording; no paths, which mean nothing elsewhere."""
    return {
        "frames": order.frames,
        "own_vocabulary": order.vocabulary is not None,
        "frame_from_ground_truth": order.frame_from_ground_truth,
        "own_calibration": order.calibration is not None,
        "zones": {name: polygon.tolist() for name, polygon in zones.polygons.items()},
        "survey": to_dict(settings),
    }


def _camera_entry(done: Survey) -> CameraEntry:
    camera = done.map.camera
    return CameraEntry(
        focal_px=camera.focal_px, width_px=camera.width_px, height_px=camera.height_px, baseline_m=camera.baseline_m
    )


def _library_versions() -> dict[str, str]:
    versions = {}
    for name in _LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:  # a source tree that is not installed, or a library by another name
            versions[name] = "not installed as a package"
    return versions


def _peak_rss_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def _write_files(order: BuildOrder, recording: Recording, built: _Built, report: BuildReport, version: int) -> None:
    if order.trajectory is not None:
        write_tum(order.trajectory, built.survey.map.trajectory)
    if order.picture is not None:
        from mapserver.pictures import draw_survey

        title = f"{order.site}, version {version}"
        _write(order.picture, draw_survey(title, built.survey, built.accuracy, report))
    if order.report is not None:
        full = full_report(report, order.site, version, recording, built.survey, built.accuracy, built.times.seconds)
        full["vocabulary"] = {"source": built.vocabulary.source, "sha256": built.vocabulary.sha256()}
        full["vocabulary"]["trial"] = msgspec.to_builtins(built.vocabulary.trial)
        _write(order.report, msgspec.json.format(msgspec.json.encode(full), indent=2) + b"\n")


def _write(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as error:
        raise StoreError(f"{path} cannot be written ({error.strerror}); the draft is stored all the same") from error


def _sentence(site: str, version: int, report: BuildReport) -> str:
    ate = "" if report.ate_rmse_m is None else f", ATE {report.ate_rmse_m:.4f} m"
    sizes = f"{report.map_bytes} bytes, {report.loops['accepted']} loops{ate}, in {report.seconds:.1f} s"
    return (
        f"site {site}: draft {version} of {report.keyframes} keyframes and {report.landmarks} landmarks over "
        f"{report.path_m:.1f} m, {sizes}; make it current with `mapserver publish --site {site}`"
    )
