"""The rim around a build: surveys the recordings, joins them to the site's map, writes draft, report and pictures."""

import resource
import time
from contextlib import nullcontext
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from fleetmap.bow import Vocabulary, encode_vocabulary
from fleetmap.config import to_dict
from fleetmap.errors import RecordingError, StoreError, SurveyError, UsageError
from fleetmap.mapformat import CameraEntry, Tile
from fleetmap.recordings.tum import write_tum
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import SensorSet, Trajectory
from mapserver.build.draft_evidence import Before, JudgedSession, examine_draft, replayed_probes
from mapserver.build.image_spill import ImageSpill
from mapserver.build.job_record import Job, recorded_job
from mapserver.build.loop_overlay import loop_places
from mapserver.build.progress import ProgressView, StageTimes
from mapserver.build.report import Accuracy, BuildReport, accuracy, full_report, make_report, sessions_report
from mapserver.build.survey_recordings import Admission, Surveyed, admit_recordings, survey_all, survey_recording
from mapserver.build.vocabulary_selection import ChosenVocabulary, choose_vocabulary, judged
from mapserver.build.worker import open_worker
from mapserver.build.zones_file import read_zones
from mapserver.quality.directions import one_way_words
from mapserver.quality.figures import Evidence
from mapserver.store import NOBODY, Actor, DraftContent, DraftDetails, MapStore
from mapserver.store.archive import decode_archive, encode_archive
from mapserver.survey.finish.map_transform import moved
from mapserver.survey.loops.loops import Loops
from mapserver.survey.loops.zones import Zones
from mapserver.survey.merge.initial_history import history_of
from mapserver.survey.merge.multi_session import Joined, Session, chained, join_sessions
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_map import SurveyMap
from mapserver.tiles.landmark_budget import choose_landmarks
from mapserver.tiles.tiling import TILE_SIZE_M, tiles_from_survey

_NOT_FOR_ROBOTS = ("map_bytes", "sessions", "culled", "directions")
_LIBRARIES = ("numpy", "numba", "opencv-python-headless", "gtsam", "scipy", "fleetmap")


@dataclass(frozen=True, slots=True)
class BuildRequest:
    """What `mapserver build` was asked for; frames is an A:B:C slice of each recording, absent files are not written.

    replay: earlier recordings of the current version, of which frames are looked for in the draft. threads, scheduler: who does
    the work, see worker.py. job: the number of the job that builds, for its draft.
    """

    recordings: tuple[Path, ...]
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
    use: SensorSet | None = None
    replay: tuple[Path, ...] = ()
    actor: Actor = NOBODY
    threads: int | None = None
    scheduler: str | None = None
    job: int | None = None


@dataclass(frozen=True)
class _Built:
    """The surveys and what became of them: the map in its final frame, and how good it is."""

    surveyed: list[Surveyed]
    joined: Joined
    accuracy: Accuracy
    vocabulary: ChosenVocabulary
    zones: Zones
    times: StageTimes
    started_s: float

    @property
    def taken(self) -> list[Surveyed]:
        """The recordings that found their place in the map."""
        return [s for s, outcome in zip(self.surveyed, self.joined.outcomes, strict=True) if outcome.joined]


@dataclass(frozen=True, slots=True)
class Draft:
    """A stored draft, what the build says about it, and by content hash why recordings are not in it."""

    version: int
    sentence: str
    report: dict[str, Any]
    left_out: dict[str, str]


def run_build(order: BuildRequest, settings: SurveySettings) -> str:
    """Does it; the sentence says what there is now. Raises FleetmapErrors, before the survey where possible."""
    return build_draft(order, settings, noted=True).sentence


def build_draft(
    order: BuildRequest, settings: SurveySettings, unusable: dict[Path, str] | None = None, *, noted: bool = False
) -> Draft:
    """As `run_build`; noted: as a job of the store.

    With `unusable` a recording that cannot be surveyed goes in there with its reason, and the others are taken.
    """
    started_s = time.perf_counter()
    console = Console(stderr=True)
    zones = Zones() if order.zones is None else read_zones(order.zones)
    times = StageTimes(time.perf_counter)
    times.begin("examination")
    with open_worker(order.threads, None) as worker:
        admitted = admit_recordings(
            order.recordings, order.frames, order.calibration, order.use, console,
            needs_truth=order.frame_from_ground_truth, unusable=unusable, worker=worker,
        )  # fmt: skip
    with (
        MapStore.open(order.store, create=True) as maps,
        recorded_job(maps, order.site, "build") if noted else nullcontext(Job()) as job,
    ):
        parent = _parent(order, maps)
        base = None if parent is None else parent.survey
        chosen = choose_vocabulary(maps, order.site, order.vocabulary)
        built = _survey(order, admitted, zones, base, chosen, settings, console, times, started_s, unusable)
        draft = _keep(order, built, parent, settings, maps)
        places = loop_places([s.entry.name for s in built.taken], [s.survey for s in built.taken], built.joined)
        draft = replace(draft, report=draft.report | {"loop_places": places})
        job.message, job.report = draft.sentence, draft.report | {"version": draft.version}
        return draft


def _parent(order: BuildRequest, maps: MapStore) -> Before | None:
    """The site's current version, to build on; None for a site without one."""
    current = maps.current(order.site) if order.site in {info.site for info in maps.sites()} else None
    if current is None:
        return None
    if order.frame_from_ground_truth:
        raise UsageError(
            f"site {order.site} has version {current.version}, whose frame stays; build without --frame-from-ground-truth, "
            "or name another --site"
        )
    archive = maps.archive(order.site, current.version)
    if archive is None:
        raise StoreError(
            f"version {current.version} of site {order.site} has no archive to build on; survey the site anew under another name"
        )
    return Before.of(maps, maps.manifest(order.site, current.version), decode_archive(archive))


def _survey(
    order: BuildRequest, admitted: dict[Path, Admission], zones: Zones, base: SurveyMap | None, chosen: ChosenVocabulary,
    settings: SurveySettings, console: Console, times: StageTimes, started_s: float, unusable: dict[Path, str] | None,
) -> _Built:  # fmt: skip
    with (
        ProgressView(console) as view,
        ImageSpill(order.store) as shelf,
        open_worker(order.threads, order.scheduler) as worker,
    ):

        def progress(stage: str, done: int, total: int) -> None:
            times(stage, done, total)
            view(stage, done, total)

        def survey_one(path: Path, pinhole: StereoCamera | None, words: Vocabulary) -> Surveyed:
            return survey_recording(
                path,
                admitted[path],
                order.frames,
                order.calibration,
                order.use,
                pinhole,
                words,
                settings,
                zones,
                progress,
                shelf,
                worker,
            )

        surveyed = survey_all(
            list(admitted), survey_one, None if base is None else base.camera,
            chosen.vocabulary, unusable,
        )  # fmt: skip
        progress("joining", 0, 1)
        joined = join_sessions(base, [Session(s.survey, s.placed) for s in surveyed], settings)
    times.begin("vocabulary")
    chosen = judged(chosen, surveyed[0].survey, settings)
    times.begin("storing")
    _say_left_out(order, surveyed, joined, console)
    found = accuracy(joined.map, _truth(surveyed, joined))
    if order.frame_from_ground_truth:
        if found.rigid is None:
            raise RecordingError(
                f"{order.recordings[0]}: too few estimated frames have a ground truth; build without "
                "--frame-from-ground-truth"
            )
        joined = replace(joined, map=moved(joined.map, found.rigid.frame_from_estimate))
    return _Built(surveyed, joined, found, chosen, zones, times, started_s)


def _say_left_out(order: BuildRequest, surveyed: list[Surveyed], joined: Joined, console: Console) -> None:
    """Names the recordings that could not be joined; raises SurveyError where none could."""
    left = [(s, o) for s, o in zip(surveyed, joined.outcomes, strict=True) if not o.joined]
    for recording, outcome in left:
        console.print(f"left out: {recording.entry.name}: {outcome.reason}", markup=False)
    if len(left) == len(surveyed):
        reasons = "; ".join(f"{s.entry.name}: {o.reason}" for s, o in left)
        raise SurveyError(
            f"nothing could be joined to the current version of site {order.site} ({reasons}); drive through places that are "
            "in the map, pass its docks, or survey the area as another --site"
        )


def _truth(surveyed: list[Surveyed], joined: Joined) -> Trajectory | None:
    """The truth of the joined recordings on one clock, None where one of them has none."""
    truths = [s.truth for s, o in zip(surveyed, joined.outcomes, strict=True) if o.joined]
    known = [truth for truth in truths if truth is not None]
    return chained(known, joined.trajectories) if len(known) == len(truths) else None


def _keep(order: BuildRequest, built: _Built, parent: Before | None, settings: SurveySettings, maps: MapStore) -> Draft:
    survey_map = built.joined.map
    for_robots = choose_landmarks(survey_map, settings.budget, TILE_SIZE_M, _wanted_ids(parent, survey_map))
    tiles = tiles_from_survey(survey_map, chosen=for_robots)
    built.times.begin("examining")
    evidence = _examined(order, built, tiles, parent)
    built.times.begin("storing")
    archive = encode_archive(survey_map)
    vocabulary = encode_vocabulary(built.vocabulary.vocabulary)
    report = make_report(
        [s.entry.name for s in built.taken], built.joined, [s.survey for s in built.taken], built.accuracy,
        built.vocabulary.download_bytes(len(vocabulary)),
        time.perf_counter() - built.started_s, _peak_rss_mb(),
    )  # fmt: skip
    report = msgspec.structs.replace(
        report,
        findings={s.entry.name: s.remarks() for s in built.surveyed},
        sessions=sessions_report([s.entry.name for s in built.surveyed], built.joined),
        directions=evidence.directions or [],
    )
    details = DraftDetails(
        created=datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
        tile_size_m=TILE_SIZE_M,
        camera=_camera_entry(survey_map.camera),
        recordings=tuple(s.entry for s in built.taken),
        configuration=_configuration(order, parent, built.zones, settings),
        libraries=_library_versions(),
        # A robot downloads the manifest: what it says about the build is short.
        report={key: value for key, value in msgspec.to_builtins(report).items() if key not in _NOT_FOR_ROBOTS},
    )
    content = DraftContent(
        tiles=tiles, vocabulary=vocabulary, details=details, archive=archive, evidence=evidence, job=order.job
    )
    version = maps.save_draft(order.site, content, actor=order.actor)
    info = maps.version(order.site, version)
    report = msgspec.structs.replace(report, map_bytes=info.map_bytes)
    built.times.begin("writing")
    _write_files(order, built, parent, report, version)
    outcomes = zip(built.surveyed, built.joined.outcomes, strict=True)
    return Draft(
        version,
        _sentence(order.site, version, parent, report),
        msgspec.to_builtins(report),
        {s.entry.sha256: outcome.reason for s, outcome in outcomes if not outcome.joined},
    )


def _examined(order: BuildRequest, built: _Built, tiles: list[Tile], before: Before | None) -> Evidence:
    camera = built.joined.map.camera
    replayed = []
    if before is not None:
        options = (order.frames, order.calibration, order.use)
        replayed = replayed_probes(order.replay, before, *options, camera)
    trajectories = _map_trajectories(built.joined)
    sessions = [JudgedSession(t, s.held_out, s.survey) for t, s in zip(trajectories, built.taken, strict=True)]
    return examine_draft(tiles, camera, built.vocabulary.vocabulary, before, sessions, replayed)


def _map_trajectories(joined: Joined) -> list[Trajectory]:
    """The joined recordings' trajectories in the map's final frame, which the finished map has one after the other."""
    ends = np.cumsum([len(trajectory) for trajectory in joined.trajectories])
    parts = np.split(joined.map.trajectory.frame_from_body, ends[:-1])
    return [Trajectory(t.stamps_ns, part) for t, part in zip(joined.trajectories, parts, strict=True)]


def _wanted_ids(parent: Before | None, survey_map: SurveyMap) -> NDArray[np.uint32] | None:
    """Landmarks that come before others in the budget: those that robots have, and those that the map has just gained.

    The new ones compete with the published ones; what else the archive knows would only take the place of its like.
    """
    if parent is None:
        return None
    new = survey_map.landmark_ids[survey_map.landmark_ids >= history_of(parent.survey).next_landmark_id]
    return np.unique(np.concatenate([new, *(tile.landmark_ids for tile in parent.tiles)])).astype(np.uint32)


def _configuration(
    order: BuildRequest, parent: Before | None, zones: Zones, settings: SurveySettings
) -> dict[str, Any]:
    """What the map depends on besides the recordings; no paths, which mean nothing elsewhere."""
    kept = parent is not None and bool(parent.manifest.configuration.get("frame_from_ground_truth"))
    return {
        "frames": order.frames,
        "own_vocabulary": order.vocabulary is not None,
        "frame_from_ground_truth": order.frame_from_ground_truth or kept,
        "own_calibration": order.calibration is not None,
        "use": None if order.use is None else order.use.value,
        "zones": {name: polygon.tolist() for name, polygon in zones.polygons.items()},
        "survey": to_dict(settings),
    }


def _camera_entry(camera: StereoCamera) -> CameraEntry:
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


def _write_files(order: BuildRequest, built: _Built, parent: Before | None, report: BuildReport, version: int) -> None:
    if order.trajectory is not None:
        write_tum(order.trajectory, built.joined.map.trajectory)
    if order.picture is not None:
        from mapserver.build.plots import draw_survey

        title = f"{order.site}, version {version}"
        # Loops name keyframes of their own survey, which are the map's only where nothing was joined or culled.
        alone = parent is None and len(built.taken) == 1
        loops = built.taken[0].survey.loops if alone else Loops()
        _write(order.picture, draw_survey(title, built.joined.map, loops, built.accuracy, report))
    if order.report is not None:
        full = full_report(report, order.site, version, built.taken, built.joined, built.accuracy, built.times.seconds)
        full["vocabulary"] = {"source": built.vocabulary.source, "sha256": built.vocabulary.sha256()}
        full["vocabulary"]["trial"] = msgspec.to_builtins(built.vocabulary.trial)
        _write(order.report, msgspec.json.format(msgspec.json.encode(full), indent=2) + b"\n")


def _write(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as error:
        raise StoreError(f"{path} cannot be written ({error.strerror}); the draft is stored all the same") from error


def _sentence(site: str, version: int, parent: Before | None, report: BuildReport) -> str:
    ate = "" if report.ate_rmse_m is None else f", ATE {report.ate_rmse_m:.4f} m"
    sizes = f"{report.map_bytes} bytes, {report.loops['accepted']} loops{ate}, in {report.seconds:.1f} s"
    built_on = "" if parent is None else f" on version {parent.manifest.version}"
    left = [s["recording"] for s in report.sessions if not s["joined"]]
    left_out = f"; left out, they could not be joined: {', '.join(left)}" if left else ""
    one_way = one_way_words(report.directions)
    warned = f"; {one_way}" if one_way else ""
    if report.scale == "unknown":
        return (
            f"site {site}: draft {version} of {report.keyframes} keyframes and {report.landmarks} landmarks, {sizes}; its scale is "
            "unknown, so it can be inspected but not published"
        )
    return (
        f"site {site}: draft {version}{built_on} of {report.keyframes} keyframes and {report.landmarks} landmarks over "
        f"{report.path_m:.1f} m, {sizes}{left_out}{warned}; make it current with `mapserver publish --site {site}`"
    )
