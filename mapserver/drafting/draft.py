"""A build: surveys recordings, merges them into the site's map, stores the draft, writes report and pictures."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console

from fleetmap.bow.vocabulary import default_vocabulary, default_vocabulary_bytes
from fleetmap.console import plain_console
from fleetmap.encoding import to_json, to_plain
from fleetmap.errors import RecordingError, StoreError, UsageError
from fleetmap.free_memory import gc_frozen
from fleetmap.hooks import plugins
from fleetmap.mapformat.manifest import CameraEntry
from fleetmap.mapformat.tile import Tile
from fleetmap.recordings import Recording, Topics
from fleetmap.recordings.tum import write_tum
from fleetmap.sensors.rectification import StereoCamera
from mapserver.drafting import draft_evidence, survey_recordings
from mapserver.drafting import report as reports
from mapserver.drafting.area_corrections import AreaCorrections, driven_since
from mapserver.drafting.draft_evidence import Before, MappedSession
from mapserver.drafting.extras import ChosenDraft, Extra
from mapserver.drafting.job_lock import Job, JobProgress, recorded_job
from mapserver.drafting.mapped_images import MappedImageStore
from mapserver.drafting.progress import ProgressView, StageTimes
from mapserver.drafting.report import BuildReport, BuildResult, sentence
from mapserver.drafting.survey_recordings import Admission, OpenRecordings
from mapserver.drafting.worker import open_executor, single_threaded_libraries
from mapserver.evaluation.trajectory_error import accuracy, truth_from_estimate
from mapserver.quality.figures import EVIDENCE_KEY, TRUSTED_KEY, Evidence, merged, pair_yaws
from mapserver.quality.map_error import map_errors
from mapserver.quality.probes import alias_step_m
from mapserver.store import NOBODY, Actor, DraftContent, DraftDetails, MapStore
from mapserver.store.archive import decode_archive, encode_archive
from mapserver.survey.loops.loops import Loops
from mapserver.survey.merge.multi_session import MergedMap
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyConfig, SurveyTools, Zones
from mapserver.tiles.tiling import TILE_SIZE_M
from mapserver.trust.signing import check_base

_NOT_FOR_ROBOTS = ("map_bytes", "sessions", "checks", "culled", "directions", "starts", "views")


@dataclass(frozen=True, slots=True)
class BuildOptions(survey_recordings.RecordingOptions):
    """Options of a build, beside those of reading. Files without a name are not written.

    trajectory_out: a TUM file for the poses of all frames. replay: earlier recordings of the current version, of which frames are
    localized in the draft.
    threads, scheduler: see worker.py. settings: those of the survey; None for the preset of the first recording's sensors with the [survey]
    section of the file `config` over it. job: its number, for the draft.
    look_at: called with the recordings in work.
    """

    zones: Path | None = None
    report: Path | None = None
    trajectory_out: Path | None = None
    picture: Path | None = None
    frame_from_ground_truth: bool = False
    replay: tuple[Path, ...] = ()
    actor: Actor = NOBODY
    threads: int | None = None
    scheduler: str | None = None
    job: int | None = None
    config: Path | None = None
    settings: SurveySettings | None = None
    look_at: Callable[[Sequence[Path]], None] = lambda _: None


@dataclass(frozen=True, slots=True)
class BuildRequest:
    """Recordings for a draft of a site in a store. first: the first of them, if it is open already."""

    recordings: tuple[Path, ...]
    site: str
    store: Path
    options: BuildOptions = BuildOptions()
    first: Recording | None = None


@dataclass(frozen=True)
class _Run:
    """A running build, with the data for all of its steps."""

    request: BuildRequest
    reading: OpenRecordings
    settings: SurveySettings
    zones: Zones
    unusable: dict[Path, str] | None
    console: Console
    times: StageTimes
    images: MappedImageStore

    @contextmanager
    def tools(self, scheduler: str | None = None, told: JobProgress | None = None) -> Iterator[SurveyTools]:
        """Open tools with displayed and timed progress, also reported to viewers of the job."""
        with ProgressView(self.console) as view, open_executor(self.request.options.threads, scheduler) as executor:

            def progress(stage: str, done: int, total: int) -> None:
                self.times(stage, done, total)
                view(stage, done, total)
                if told is not None:
                    told(stage, done, total)

            yield SurveyTools(progress, self.images, executor)


@dataclass(frozen=True, slots=True)
class Draft:
    """A stored draft: its version, a summary sentence, its report, and the reasons for left-out recordings by content hash."""

    version: int
    sentence: str
    report: dict[str, Any]
    left_out: dict[str, str]


def build_draft(
    request: BuildRequest, settings: SurveySettings, unusable: dict[Path, str] | None = None, *, recorded: bool = False
) -> tuple[Draft, BuildResult]:
    """Build a draft; raises FleetmapErrors, before the survey if possible.

    With `unusable` a recording that cannot be surveyed is added there with its reason, and the others are used. recorded: as
    a job of the store.
    """
    options, times = request.options, StageTimes(time.perf_counter)
    if (given := options.trajectory) is not None and len(request.recordings) > 1:
        raise UsageError(f"{given.file} is for one recording, {len(request.recordings)} are named; build each alone")
    zones = survey_recordings.read_zones(options.zones)
    console = plain_console(stderr=True)
    folder = next(each for each in (request.store, *request.store.absolute().parents) if each.is_dir())
    reads = OpenRecordings(options, folder, request.first)
    with single_threaded_libraries(), gc_frozen(), reads as reading, MappedImageStore(folder) as images:
        run = _Run(request, reading, settings, zones, unusable, console, times, images)
        times.begin("examination")
        with run.tools() as tools:
            admitted = survey_recordings.admit_recordings(
                request.recordings,
                reading,
                console,
                needs_truth=options.frame_from_ground_truth,
                unusable=unusable,
                settings=settings,
                tools=tools,
                look_at=options.look_at,
            )
        with (
            MapStore.open(request.store, create=True) as maps,
            recorded_job(maps, request.site, "build") if recorded else nullcontext(Job(number=options.job)) as job,
        ):
            parent = _parent(request, maps)
            corrections = AreaCorrections()
            if parent is not None:
                corrections = AreaCorrections.of(maps.areas(request.site), parent.manifest)
            if lacking := {path: each for path, each in admitted.items() if each.checked.lacks_pair}:
                known = [maps.evidence(s.site, s.current_version) for s in maps.sites() if s.current_version]
                yaws = pair_yaws(known, settings.noise.turn_sigmas)
                admitted |= {p: replace(a, pair_yaw=yaws.get(a.checked.calibration.rig)) for p, a in lacking.items()}
            built = _survey(run, admitted, parent, corrections, JobProgress(maps, job.number))
            if parent is not None:
                parent = built.corrections.applied(parent)
            draft = _keep(run, built, parent, maps)
            draft = replace(draft, report=draft.report | {"loop_places": reports.loop_places(built)})
            job.message, job.report = draft.sentence, draft.report | {"version": draft.version}
            return draft, built


def _parent(request: BuildRequest, maps: MapStore) -> Before | None:
    """Return the site's current version, to build on; None if absent."""
    site = request.site
    if site not in {info.site for info in maps.sites()} or (current := maps.current(site)) is None:
        return None
    if request.options.frame_from_ground_truth:
        raise UsageError(
            f"site {site} has version {current.version}, whose frame is fixed; build without --frame-from-ground-truth, "
            "or name another --site"
        )
    check_base(maps, current)
    archive = maps.archive(site, current.version)
    if archive is None:
        raise StoreError(
            f"version {current.version} of site {site} has no archive to build on; survey the site again under another name"
        )
    return Before.of(maps, maps.manifest(site, current.version), decode_archive(archive))


def _survey(
    run: _Run, admitted: dict[Path, Admission], parent: Before | None, corrections: AreaCorrections, told: JobProgress
) -> BuildResult:
    """Survey all recordings and join them to the current map, with the corrections of the site's areas."""
    options, settings, base = run.request.options, run.settings, None if parent is None else parent.survey
    survey_options = SurveyConfig(settings, default_vocabulary(), run.zones)
    with run.tools(options.scheduler, told) as tools:

        def survey_one(path: Path, pinhole: StereoCamera | None) -> list[survey_recordings.RecordingSurvey]:
            options.look_at([path])
            return survey_recordings.survey_recording(
                path, admitted.pop(path), run.reading, pinhole, survey_options, tools
            )

        paths = list(admitted)
        surveyed = survey_recordings.survey_all(paths, survey_one, None if base is None else base.camera, run.unusable)
        options.look_at(paths)
        tools.progress("joining", 0, 1)
        joined, corrections = corrections.joined(base, surveyed, settings)
    run.times.begin("storing")
    survey_recordings.say_left_out(run.console, run.request.site, surveyed, joined)
    truth = survey_recordings.joined_truth(surveyed, joined)
    estimate = joined.map.estimated_trajectory
    found = accuracy(estimate, len(joined.map.trajectory), truth, joined.map.keyframe_stamps_ns)
    if options.frame_from_ground_truth:
        if truth is None or found.rigid is None:
            raise RecordingError(
                f"{run.request.recordings[0]}: too few estimated frames have a ground truth; build without "
                "--frame-from-ground-truth"
            )
        joined = replace(joined, map=joined.map.transformed(truth_from_estimate(estimate, truth)))
    return BuildResult(surveyed, joined, found, corrections, is_first=base is None)


def _keep(run: _Run, built: BuildResult, parent: Before | None, maps: MapStore) -> Draft:
    """Cut the map into tiles, measure them, store the draft and write the requested files."""
    site, survey_map = run.request.site, built.joined.map
    sessions = [
        MappedSession(trajectory, s.probed, s.survey, s.entry.name)
        for trajectory, s in zip(survey_recordings.map_trajectories(built.joined), built.taken, strict=True)
    ]
    run.times.begin("choosing")
    wanted = None if parent is None else parent.wanted_ids(survey_map)
    frozen = built.corrections.frozen(survey_map.points_map)
    chooser = draft_evidence.TileChooser(survey_map, run.settings.budget, wanted, default_vocabulary(), frozen)
    tiles, views = chooser.choose(draft_evidence.asked_views(sessions))
    run.times.begin("extras")
    before = None if parent is None else parent.manifest
    chosen, stages = ChosenDraft(sessions, run.settings, built.corrections, before, maps), plugins("mapserver.stages")
    extras: dict[str, Extra] = {key: made for stage in stages.values() for key, made in stage(chosen).items()}
    run.times.begin("examining")
    evidence = msgspec.structs.replace(_evidence(run, built, sessions, tiles, parent), views=views)
    run.times.begin("storing")
    known_m = None if before is None else before.report.get("alias_step_m")
    report = reports.make_report(
        built,
        evidence,
        sum(run.times.seconds.values()),
        surveyed_requests=covered_requests(maps, site, built.joined),
        removed_landmarks={} if parent is None else parent.removed(),
        alias_step_m=alias_step_m(evidence.repetition, known_m),
        map_errors=map_errors(survey_map, [(tile.tile_x, tile.tile_y) for tile in tiles], TILE_SIZE_M),
    )
    said = to_plain(report) | {key: to_plain(extra.report) for key, extra in extras.items()}
    details = _details(run, built, parent, evidence, said)
    content = DraftContent(
        tiles=tiles,
        vocabulary=default_vocabulary_bytes(),
        details=details,
        archive=encode_archive(survey_map),
        extras=[(extra.kind, data) for extra in extras.values() for data in extra.blobs],
        evidence=evidence,
        job=run.request.options.job,
    )
    version = maps.save(site, content, actor=run.request.options.actor).version
    report = msgspec.structs.replace(report, map_bytes=maps.version(site, version).map_bytes)
    said |= {"map_bytes": report.map_bytes}
    run.times.begin("writing")
    words = sentence(site, version, None if before is None else before.version, report, maps.folder)
    mapped, outcomes = {s.entry.sha256 for s in built.taken}, zip(built.surveyed, built.joined.outcomes, strict=True)
    left_out = {s.entry.sha256: o.reason for s, o in outcomes if s.entry.sha256 not in mapped}
    draft = Draft(version, maps.areas(site).name_tiles(words, TILE_SIZE_M), said, left_out)
    _write_files(run, built, draft)
    return draft


def _details(
    run: _Run, built: BuildResult, parent: Before | None, evidence: Evidence, report: dict[str, Any]
) -> DraftDetails:
    starts = None if evidence.starts is None else msgspec.structs.replace(evidence.starts, lookalikes=[])
    camera = built.joined.map.camera
    return DraftDetails(
        created=datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
        tile_size_m=TILE_SIZE_M,
        camera=CameraEntry(**{name: getattr(camera, name) for name in CameraEntry.__struct_fields__}),
        recordings=tuple(s.entry for s in built.taken),
        configuration=_configuration(run, parent) | built.corrections.configuration(run.request.site),
        libraries=reports.library_versions(),
        # A robot downloads the manifest: its part about the build is short.
        report={key: value for key, value in report.items() if key not in _NOT_FOR_ROBOTS}
        | {EVIDENCE_KEY: to_plain(msgspec.structs.replace(evidence, directions=None, starts=starts, views=None))},
    )


def covered_requests(maps: MapStore, site: str, joined: MergedMap) -> dict[str, float]:
    """Return by id of each open request the covered share of its places; recordings older than the request do not count."""
    places = joined.map.map_from_body[:, :2, 3]
    found = {
        request.id: round(request.covered_share(places, driven_since(joined, request.asked_ns)), 3)
        for request in maps.survey_requests(site)
    }
    return {name: share for name, share in found.items() if share > 0}


def _evidence(
    run: _Run, built: BuildResult, sessions: list[MappedSession], tiles: list[Tile], before: Before | None
) -> Evidence:
    options, camera = run.request.options, built.joined.map.camera
    replayed = []
    if before is not None:
        opened = replace(options, trajectory=None).opened
        replayed = draft_evidence.replayed_probes(options.replay, before, opened, (camera, run.settings.orb))
    with open_executor(options.threads, None) as executor:
        evidence = draft_evidence.examine_draft(
            tiles, default_vocabulary(), camera, before, sessions, replayed, executor
        )
    known = [] if before is None else before.calibrations
    return msgspec.structs.replace(evidence, calibrations=merged([*known, *(s.evidence() for s in built.taken)]))


def _configuration(run: _Run, parent: Before | None) -> dict[str, Any]:
    """Return the inputs of the map besides the recordings; no paths, which are meaningless elsewhere."""
    options = run.request.options
    kept = parent is not None and bool(parent.manifest.configuration.get("frame_from_ground_truth"))
    given: dict[str, Any] = {} if options.trajectory is None else {"trajectory": options.trajectory.file.name}
    if parent is not None and (trusted := parent.manifest.configuration.get(TRUSTED_KEY)):
        given[TRUSTED_KEY] = trusted
    topics = {} if options.topics == Topics() else {"topics": to_plain(options.topics)}
    always = {
        "frames": options.frames,
        "frame_from_ground_truth": options.frame_from_ground_truth or kept,
        "own_calibration": options.calibration is not None,
        "use": None if options.use is None else options.use.value,
        "zones": {name: polygon.tolist() for name, polygon in run.zones.polygons.items()},
        "survey": to_plain(run.settings),
    }
    return given | topics | always


def picture_png(site: str, draft: Draft, built: BuildResult) -> bytes:
    """Return the map from above as a PNG."""
    from mapserver.drafting.plots import draw_survey

    # Loops name keyframes of their own survey; these are the map's only if nothing was joined or culled.
    loops = built.taken[0].survey.loops if built.is_first and len(built.taken) == 1 else Loops()
    report = msgspec.convert(draft.report, BuildReport)
    return draw_survey(f"{site}, version {draft.version}", built.joined.map, loops, built.accuracy, report)


def _write_files(run: _Run, built: BuildResult, draft: Draft) -> None:
    options, site = run.request.options, run.request.site
    if options.trajectory_out is not None:
        write_tum(options.trajectory_out, built.joined.map.trajectory)
    if options.picture is not None:
        reports.write_file(options.picture, picture_png(site, draft, built))
    if options.report is not None:
        full: dict[str, Any] = {"site": site, "version": draft.version}
        full = draft.report | full | reports.report_details(built, run.times.seconds)
        reports.write_file(options.report, to_json(full, indent=2) + b"\n")
