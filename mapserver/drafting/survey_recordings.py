"""Surveys of recordings: each is opened, checked, surveyed and closed in turn."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import NamedTuple, Protocol

import msgspec
import numpy as np
from rich.console import Console

from fleetmap.config import Section, load_toml
from fleetmap.errors import FleetmapError, RecordingError, SurveyError, UsageError
from fleetmap.geometry import Array, Indices
from fleetmap.log_lines import printable
from fleetmap.mapformat.manifest import RecordingEntry
from fleetmap.recordings import FrameSelection, OpenOptions, Recording, Topics, open_recording
from fleetmap.recordings.sensor_subset import reduced, with_other_views
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier, StereoCamera
from fleetmap.sensors.samples import CameraFrame, DataIssue, ImuSamples, SensorSet, Stamps, Trajectory, wheel_between
from mapserver.calibration import CalibrationParameter
from mapserver.calibration.motion_rows import CalibrationData
from mapserver.calibration.recordings import LONGEST_S, busiest_frames, busiest_stretch
from mapserver.doctor.calibration import SURE_SIGMAS
from mapserver.doctor.findings import summary
from mapserver.doctor.run_checks import frames_to_check
from mapserver.drafting.admission import DECISIVE, PAIR, CheckedRecording, checked, drops_wheels, with_further_views
from mapserver.drafting.draft_evidence import ProbedFrame, probed_frames
from mapserver.drafting.mapped_images import KeptFrames
from mapserver.drafting.worker import read_ahead
from mapserver.evaluation.trajectory_error import check_truth
from mapserver.quality.figures import RigEvidence
from mapserver.survey.bundle.stereo_yaw_check import StereoYaw
from mapserver.survey.merge.multi_session import MergedMap, chained
from mapserver.survey.odometry_pass import LEAD_NS, parts_between_lifts
from mapserver.survey.pose_graph.position_priors import aligned_by_priors
from mapserver.survey.settings import SurveySettings
from mapserver.survey.stages import Survey, begin_survey, finish_survey, survey
from mapserver.survey.survey_inputs import AdjustedChain, SurveyConfig, SurveyInputs, SurveyTools, Watch, Zones

_log = logging.getLogger(__name__)
_Opened = tuple[Recording, Indices]


@dataclass(frozen=True)
class RecordingSurvey:
    """One recording and its survey.

    map_from_survey (4, 4): by its position priors, None without any. findings: the doctor's statements; checks: all of them in one line.
    calibration: those on the calibration. corrections: of that, by parameter. probed: frames to be localized in the map.
    """

    entry: RecordingEntry
    format: str
    sensor_set: SensorSet
    issues: tuple[DataIssue, ...]
    truth: Trajectory | None
    survey: Survey
    map_from_survey: Array | None
    findings: tuple[str, ...]
    checks: str
    calibration: RigEvidence
    corrections: dict[str, float]
    probed: list[ProbedFrame]

    def remarks(self) -> list[str]:
        """Shortcomings of the recording, corrections and left-out parts, as text."""
        by = "the adjusted survey", "an earlier survey of this rig: this one cannot judge its pair"
        turned = [
            f"corrected: disparities{of_view} by {-yaw.shift_px:+.2f} px, sigma {yaw.sigma_px:.2f}, by {by[yaw.is_earlier]}"
            for of_view, yaw in self._yaws()
            if yaw.corrected
        ]
        apart = [c for c in self.survey.odometry.cuts if c.refused is not None]
        whole = [f"not cut after {c.after_s:.0f} s, surveyed as one with the part before: {c.refused}" for c in apart]
        left_out = [component.remark() for component in self.survey.components if not component.kept]
        state, unused = self.survey.state, list[str]()
        for prior in (p for p in state.priors if not p.is_believed):  # the survey contradicts them
            after_s = 1e-9 * (state.stamps_ns[prior.k] - state.stamps_ns[0])
            off_m = np.linalg.norm(state.map_from_body[prior.k, :3, 3] - prior.map_from_body[:3, 3])
            unused.append(
                f"not used: the position prior {after_s:.1f} s after the first keyframe, {off_m:.2f} m from the place by the survey; "
                "check the position of this dock or tag"
            )
        return [*self.findings, *turned, *whole, *left_out, *unused]

    def evidence(self) -> RigEvidence:
        """Evidence on its calibration: the pair is doubted if the survey's disparities contradict the angle accepted by the doctor."""
        yaw, focal_px = CalibrationParameter.PAIR_YAW, self.survey.state.rig.camera.focal_px
        most_px = focal_px * (yaw.warn_above + SURE_SIGMAS * yaw.least_sigma)
        off = [f"{-yaw.shift_px:+.2f} px{of_view}" for of_view, yaw in self._yaws() if abs(yaw.correction_px) > most_px]
        if not off:
            own, known = self.survey.stereo_yaws[0], None
            if PAIR in self.calibration.judged and yaw.value not in self.corrections and np.isfinite(own.sigma_px):
                known = own.shift_px / focal_px, own.sigma_px / focal_px
            return msgspec.structs.replace(self.calibration, pair_yaw=known)
        words = f"the survey's disparities are {' and '.join(off)} off by its motion; the doctor did not find this"
        return msgspec.structs.replace(self.calibration, doubted=self.calibration.doubted | {PAIR: words})

    def _yaws(self) -> list[tuple[str, StereoYaw]]:
        """Return the error of yaw of the pair of each view, with the view's name; that of the first one is empty."""
        return [(f" of view {n}" if n else "", yaw) for n, yaw in enumerate(self.survey.stereo_yaws)]


class GivenPoses(NamedTuple):
    """frame_from_body of every selected frame, in metres, and text on the findings about their file."""

    trajectory: Trajectory
    words: str


class StartPoses(Protocol):
    """Poses of another system with which a survey begins, from a file; made by a plug-in (`mapserver.poses`)."""

    @property
    def file(self) -> Path: ...

    def seen(self, recording: Recording, indices: Indices) -> tuple[Recording, Indices]:
        """Return the recording with what the system measured beside poses, and which of the selected frames (F,) can be used."""

    def poses_of(self, recording: Recording, indices: Indices) -> GivenPoses:
        """Return the poses of the selected frames (F,); an error if they do not fit the recording."""


@dataclass(frozen=True, slots=True)
class Admission:
    """A recording accepted for a survey, with its findings.

    given: its initial trajectory, None for fleetmap's odometry. begun: the first stages of its survey, if the doctor needed them.
    pair_yaw: see SurveyInputs.
    """

    checked: CheckedRecording
    given: GivenPoses | None = None
    begun: AdjustedChain | None = None
    pair_yaw: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class RecordingOptions:
    """Options of reading.

    frames: an A:B:C slice of each recording. use: only the sensors of a smaller set. trajectory: start poses of another system, None for
    fleetmap's odometry.
    """

    frames: str = "::"
    calibration: Path | None = None
    topics: Topics = field(default_factory=Topics)
    use: SensorSet | None = None
    trajectory: StartPoses | None = None

    @property
    def opening(self) -> OpenOptions:
        """How recordings are opened."""
        return OpenOptions(self.calibration, self.topics)

    def opened(self, path: Path, keep_in: Path | None = None, found: Recording | None = None) -> _Opened:
        """Return the recording at `path`, to be closed, and its selected frames. keep_in: a folder for KeptFrames; found: if it is open."""
        recording = open_recording(path, self.opening) if found is None else found
        if recording.name not in {path.name, path.stem}:  # people look for the file, whatever its recorder called it
            recording = replace(recording, name=printable(path.name))
        try:
            recording = reduced(recording, self.use)
            indices = FrameSelection.parse(self.frames).apply(recording)
            if self.trajectory is not None:
                recording, indices = self.trajectory.seen(recording, indices)
            if keep_in is not None:
                recording = replace(recording, frames=KeptFrames(recording.frames, keep_in))
            return recording.readable(indices)
        except FleetmapError:
            recording.close()
            raise


class OpenRecordings(AbstractContextManager["OpenRecordings"]):
    """Recordings opened with `options`. The last used one stays open; frames decoded at its first use are not decoded again.

    folder: for their temporary file. first: the first one, if it is open already.
    """

    def __init__(self, options: RecordingOptions, folder: Path, first: Recording | None = None) -> None:
        self._options, self._folder, self._first, self.trajectory = options, folder, first, options.trajectory
        self._path: Path | None = None
        self._opened: _Opened

    def __exit__(self, *_: object) -> None:
        if self._path is not None:
            self._opened[0].close()
            self._path = None

    @contextmanager
    def open(self, path: Path) -> Iterator[_Opened]:
        if path != self._path:
            self.__exit__()
            first, self._first = self._first, None
            self._opened, self._path = self._options.opened(path, self._folder, first), path
        yield self._opened


@dataclass(frozen=True, slots=True)
class RecordedParts:
    """The selected frames (F,) of a recording as FrameParts: each part reads its own files and holds no data of the others.

    They are iterated once: that closes the recording.
    """

    recording: Recording
    indices: Indices

    @property
    def stamps_ns(self) -> Stamps:
        return self.recording.frame_stamps_ns[self.indices]

    def part(self, first: int, end: int) -> "RecordedParts":
        part = self.recording.part(self.indices[first:end])
        part = replace(part, imu=ImuSamples.empty(), wheel=(), priors=(), ground_truth=None, issues=())
        return RecordedParts(part, np.arange(len(part)))

    def __iter__(self) -> Iterator[CameraFrame]:
        with self.recording as recording:
            yield from map(recording.read_frame, self.indices.tolist())


def survey_inputs_of(
    recording: Recording, indices: Indices, rectifier: Rectifier, given: Trajectory | None
) -> SurveyInputs:
    """Return the selected frames (F,) of a recording, read ahead, and its samples."""
    frames = read_ahead(rectifier.rectify(recording.read_frame(int(index))) for index in indices)
    samples = recording.imu, recording.calibration, rectifier, recording.wheel
    parts = RecordedParts(recording, indices)
    return SurveyInputs(frames, len(indices), *samples, given, parts, priors=recording.priors)


_TRIED_S = 120.0  # of a drive tracked as a whole under a calibration that is only tried; of a longer one its stretch with the most motion


class BegunSurvey:
    """The first stages of a recording's survey, which also measure its calibration: they run only once if that is right."""

    def __init__(self, whole: Recording, indices: Indices, settings: SurveySettings, tools: SurveyTools) -> None:
        """whole: with all cameras of its rig, of which the calibration concerns the first. indices (F,): of the selected frames."""
        self._whole, self._indices, self._settings, self._tools = whole, indices, settings, tools
        self._made: tuple[RigCalibration, bool, AdjustedChain] | None = None

    def __call__(self, recording: Recording, rig: RigCalibration, watch: Watch) -> CalibrationData:
        """Return the data of the frames under the calibration `rig`. SurveyError if they are too few to be tracked."""
        calibration, images = with_other_views(rig, self._whole.calibration), self._tools.images
        rectifier, seen = Rectifier(calibration), replace(recording, calibration=calibration, frames=self._whole.frames)
        is_believed, indices = rig is recording.calibration, self._indices
        stamps_ns = recording.frame_stamps_ns[indices]
        if not is_believed and stamps_ns[-1] - stamps_ns[0] > _TRIED_S * 1e9:
            indices = indices[busiest_frames(stamps_ns, recording.imu)]
        inputs = survey_inputs_of(seen, indices, rectifier, None)
        with nullcontext(images) if is_believed else images.apart() as images:
            chain = begin_survey(inputs, self._settings, replace(self._tools, images=images, watch=watch))
            self._tools.at("local adjustment", 1, 1)
            if is_believed:
                self._made = rig, len(recording.wheel) > 0, chain
            return busiest_stretch(chain, (rig, rectifier), recording.wheel)

    def chain_of(self, rig: RigCalibration, *, has_wheels: bool) -> AdjustedChain | None:
        """Return the result under a calibration, with the wheels or without; None if the last one used was another."""
        if self._made is None or self._made[0] is not rig or self._made[1] != has_wheels:
            return None
        return self._made[2]

    @staticmethod
    def suits(recording: Recording, indices: Indices, *, is_only: bool = True) -> bool:
        """True if the selected frames are consecutive, and as informative as any stretch; and not many, where other drives wait as long."""
        stamps_ns = recording.frame_stamps_ns[indices]
        seconds = float(stamps_ns[-1] - stamps_ns[0]) * 1e-9
        is_run, is_enough = len(indices) == np.ptp(indices) + 1, len(indices) == len(recording) or seconds >= LONGEST_S
        return bool(is_run and is_enough and (is_only or seconds <= _TRIED_S))


def admit_recordings(
    paths: Sequence[Path],
    reading: OpenRecordings,
    console: Console,
    *,
    needs_truth: bool,
    unusable: dict[Path, str] | None = None,
    settings: SurveySettings | None = None,
    tools: SurveyTools | None = None,
    look_at: Callable[[Sequence[Path]], None] = lambda _: None,
) -> dict[Path, Admission]:
    """Check all recordings, so that an unusable one is refused before the work begins.

    unusable: receives refused ones with the reason; without it, or if all are refused, an error is raised. look_at: called with each path.
    settings: of the surveys, which may be begun for the checks.
    """
    admitted: dict[Path, Admission] = {}
    for path in paths:
        look_at([path])
        with _noting(path, unusable):
            admitted[path] = _admission(
                path, reading, console, needs_truth, settings, tools or SurveyTools(), is_only=len(paths) == 1
            )
    if not admitted:
        raise RecordingError(f"none of {len(paths)} recordings can be used: {'; '.join((unusable or {}).values())}")
    return admitted


@contextmanager
def _noting(path: Path, unusable: dict[Path, str] | None) -> Iterator[None]:
    """Record in `unusable` why the block fails for a recording; re-raises without it, and errors unrelated to the recording."""
    try:
        yield
    except (RecordingError, SurveyError) as error:
        if unusable is None:
            raise
        unusable[path] = str(error)
    except (FleetmapError, OSError):
        raise
    except Exception as error:
        if unusable is None:
            raise
        _log.exception("%s", path)
        unusable[path] = f"{path}: {type(error).__name__}: {str(error)[:200]}; a bug; report it with the log"


def _admission(
    path: Path,
    reading: OpenRecordings,
    console: Console,
    needs_truth: bool,
    settings: SurveySettings | None,
    tools: SurveyTools,
    *,
    is_only: bool,
) -> Admission:
    with reading.open(path) as (recording, indices):
        for issue in recording.issues:
            console.print(f"{recording.name}: issue: {issue.what}: {issue.detail}", markup=False)
        if needs_truth:
            check_truth(str(recording.path), recording.frame_stamps_ns[indices], recording.ground_truth)
        first = recording.view(0)
        total, done = frames_to_check(first), count(1)
        begun = None
        if (
            settings is not None
            and reading.trajectory is None
            and BegunSurvey.suits(recording, indices, is_only=is_only)
        ):
            begun = BegunSurvey(recording, indices, settings, tools)
        result = checked(
            first, lambda: tools.progress("examination", min(next(done), total - 1), total), tools.executor, begun
        )
        corrected = replace(recording, calibration=with_other_views(result.rig, recording.calibration))
        result = with_further_views(result, corrected)
        tools.at("examination", total, total)
        for remark in result.remarks():
            console.print(f"{recording.name}: {remark}", markup=False)
        if reading.trajectory is None:
            has_wheels = len(first.wheel) > 0 and not drops_wheels(result.findings)
            return Admission(result, begun=None if begun is None else begun.chain_of(result.rig, has_wheels=has_wheels))
        given = reading.trajectory.poses_of(replace(first, calibration=result.rig), indices)
        console.print(f"{recording.name}: {given.words}", markup=False)
        return Admission(result, given)


def survey_recording(
    path: Path,
    admission: Admission,
    reading: OpenRecordings,
    pinhole: StereoCamera | None,
    options: SurveyConfig,
    tools: SurveyTools,
) -> list[RecordingSurvey]:
    """Survey one recording resampled to `pinhole` (or the camera that suits it). The caller drops its references to the first stages.

    One from which the robot was lifted has several surveys: each part is a drive of its own, which finds its place in the map or does not.
    """
    found, given, chain = admission.checked, admission.given, admission.begun
    with reading.open(path) as (opened, indices):
        rig = with_other_views(found.rig, opened.calibration)
        recording = replace(opened, calibration=rig)
        if drops_wheels(found.findings):
            recording = replace(recording, wheel=())
        rectifier = Rectifier(rig, has_depth=recording.sensor_set is SensorSet.RGBD, pinhole=pinhole)
        inputs = survey_inputs_of(recording, indices, rectifier, None if given is None else given.trajectory)
        inputs = replace(inputs, pair_yaw=admission.pair_yaw)
        if chain is None or chain.state.rig.camera != rectifier.camera:
            chain = begin_survey(inputs, options.settings, tools)
        parts, held = parts_between_lifts(chain.odometry.estimates), [chain]
        del admission, chain  # otherwise it would be in memory twice
        said = [] if given is None else [given.words]
        if parts == [slice(None)]:
            surveys = [(recording, indices, finish_survey(held.pop(), inputs, options, tools))]
        else:
            held.clear()
            surveys = _by_parts(recording, [indices[p] for p in parts], rectifier, options, tools, said)
        sha256 = recording.content_hash()
        return [
            RecordingSurvey(
                entry=RecordingEntry(name=part.name, sha256=sha256, frames=len(chosen)),
                format=part.format,
                sensor_set=part.sensor_set,
                issues=part.issues,
                truth=part.ground_truth,
                survey=done,
                map_from_survey=map_from_survey,
                findings=(*found.statements(), *said),
                checks=summary(found.findings, DECISIVE),
                calibration=found.calibration,
                corrections=found.corrections,
                probed=probed_frames(part, chosen.tolist(), rectifier, done, options.settings.orb),
            )
            for part, chosen, own in surveys
            for done, map_from_survey in [_aligned(own, part)]
        ]


def _by_parts(
    recording: Recording,
    parts: list[Indices],
    rectifier: Rectifier,
    options: SurveyConfig,
    tools: SurveyTools,
    said: list[str],
) -> list[tuple[Recording, Indices, Survey]]:
    """Return each part with its frames and its survey, and add remarks to those said. SurveyError if none can be surveyed."""
    done = []
    for number, chosen in enumerate(parts, 1):
        part = _between(recording, chosen, rectifier, f"{recording.name}, part {number}")
        first_s, last_s = (part.frame_stamps_ns[chosen[[0, -1]]] - part.frame_stamps_ns[0]) * 1e-9
        said.append(f"part {number} of {len(parts)}, {first_s:.1f} to {last_s:.1f} s, by itself: the robot was lifted")
        try:
            done.append((part, chosen, survey(survey_inputs_of(part, chosen, rectifier, None), options, tools)))
        except SurveyError as error:
            said[-1] += f"; left out: {error}"
    if not done:
        raise SurveyError(f"{recording.path}: nothing between two lifts can be surveyed: {'; '.join(said)}")
    return done


def _between(recording: Recording, chosen: Indices, rectifier: Rectifier, name: str) -> Recording:
    """Return a recording with the samples and the truth of its chosen frames alone, under a name."""
    first_ns, last_ns = recording.frame_stamps_ns[chosen[[0, -1]]].tolist()
    offset_ns, truth = int(rectifier.imu_minus_cam_s * 1e9), recording.ground_truth
    samples = first_ns + offset_ns, last_ns + offset_ns + LEAD_NS
    if truth is not None:
        rows = slice(*np.searchsorted(truth.stamps_ns, [first_ns, last_ns + 1]))
        truth = Trajectory(truth.stamps_ns[rows], truth.frame_from_body[rows])
    return replace(
        recording,
        name=name,
        imu=recording.imu.between(*samples),
        wheel=tuple(wheel_between(recording.wheel, *samples)),
        priors=tuple(prior for prior in recording.priors if first_ns <= prior.stamp_ns <= last_ns),
        ground_truth=truth,
    )


def _aligned(done: Survey, recording: Recording) -> tuple[Survey, Array | None]:
    """Return the survey, in metres if its priors give an unknown scale, and map_from_survey (4, 4) by them, None without any."""
    if done.map.scale_known:  # a survey with priors is in `map` already
        return done, np.eye(4) if any(prior.is_believed for prior in done.state.priors) else None
    aligned = aligned_by_priors(done.map, recording.priors, recording.calibration.base_from_body)
    if aligned is None:
        return done, None
    map_from_survey, scale = aligned
    return replace(done, map=done.map.scaled(scale), state=done.state.scaled(scale)), map_from_survey


def survey_all(
    paths: Sequence[Path],
    survey_one: Callable[[Path, StereoCamera | None], list[RecordingSurvey]],
    pinhole: StereoCamera | None,
    unusable: dict[Path, str] | None = None,
) -> list[RecordingSurvey]:
    """Survey all recordings, resampled to one camera: `pinhole`, or that of the first one.

    unusable: receives failed ones with the reason; without it, or if all fail, an error is raised.
    """
    done: list[RecordingSurvey] = []
    for path in paths:
        with _noting(path, unusable):
            done += survey_one(path, pinhole)
            pinhole = pinhole or done[0].survey.state.rig.camera
    if not done:
        raise SurveyError(f"none of {len(paths)} recordings can be surveyed: {'; '.join((unusable or {}).values())}")
    return done


def say_left_out(console: Console, site: str, surveyed: list[RecordingSurvey], joined: MergedMap) -> None:
    """Print the recordings that could not be joined; raises SurveyError if none could."""
    left = [f"{s.entry.name}: {o.reason}" for s, o in zip(surveyed, joined.outcomes, strict=True) if not o.joined]
    for words in left:
        console.print(f"left out: {words}", markup=False)
    if len(left) == len(surveyed):
        raise SurveyError(
            f"nothing could be joined to the current version of site {site} ({'; '.join(left)}); drive through places that are "
            "in the map, pass its docks, or survey the area as another --site"
        )


def taken(surveyed: Sequence[RecordingSurvey], joined: MergedMap) -> list[RecordingSurvey]:
    """Return the recordings that were joined to the map."""
    return [s for s, outcome in zip(surveyed, joined.outcomes, strict=True) if outcome.joined]


def joined_truth(surveyed: Sequence[RecordingSurvey], joined: MergedMap) -> Trajectory | None:
    """Return the ground truth of the joined recordings on one clock, None if one of them has none."""
    truths = [s.truth for s in taken(surveyed, joined) if s.truth is not None]
    return chained(truths, joined.trajectories) if len(truths) == len(joined.trajectories) else None


def map_trajectories(joined: MergedMap) -> list[Trajectory]:
    """Return the joined recordings' trajectories in the map's final frame; the finished map stores them concatenated."""
    ends = np.cumsum([len(trajectory) for trajectory in joined.trajectories])
    parts = np.split(joined.map.trajectory.frame_from_body, ends[:-1])
    return [Trajectory(t.stamps_ns, part) for t, part in zip(joined.trajectories, parts, strict=True)]


def read_zones(path: Path | None) -> Zones:
    """Read zones from a TOML file: a table [zones] with name = [[x, y], ...] in metres. None gives no zones.

    Raises UsageError, naming the file and the zone, unless a zone has three or more corners of two finite numbers each.
    """

    class ZonesFile(Section, frozen=True):
        zones: dict[str, object]

    if path is None:
        return Zones()
    polygons = {}
    for name, value in load_toml(path, ZonesFile).zones.items():
        where = f"{path}: zone {name!r}"
        try:
            corners = msgspec.convert(value, list[tuple[float, float]])
        except msgspec.ValidationError as error:
            raise UsageError(f"{where}: {error}; write it as a list of corners [x, y] in metres") from error
        if len(corners) < 3:
            raise UsageError(f"{where} has {len(corners)} corner(s); an area needs at least 3")
        polygons[name] = np.array(corners, np.float64)
        if not np.isfinite(polygons[name]).all():
            raise UsageError(f"{where} has a corner that is not finite: {corners}; write metres")
    if not polygons:
        raise UsageError(f"{path}: the table [zones] is empty; write name = [[x, y], ...] or leave --zones out")
    return Zones(polygons)
