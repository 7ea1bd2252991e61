"""Replay of a recording by the `Robot` of `locclient run`: load the map, handle frames one by one. `localize` does all in one call."""

import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from fleetmap.errors import LinkError, RecordingError
from fleetmap.free_memory import gc_frozen, give_back_free_memory
from fleetmap.geometry import Array, rotation_angle_rad
from fleetmap.recordings import FrameSelection, OpenOptions, Recording, Topics, open_recording
from fleetmap.recordings.sensor_subset import reduced
from fleetmap.sensors.lens_fit import lens_of_frames
from fleetmap.sensors.rectification import MountedCamera, Rectifier
from fleetmap.sensors.samples import CameraFrame, PositionPrior, SensorSet
from fleetmap.sources.sensor_bundle import SensorBundle
from fleetmap.sources.source import ReplaySource
from locclient.identity import MapAddress
from locclient.localization.estimate import Estimate
from locclient.localization.settings import LocalizerSettings
from locclient.maps.loaded_map import LoadedMap
from locclient.maps.map_client import connected
from locclient.maps.map_source import MapSource
from locclient.maps.tile_cache import DEFAULT_MAX_BYTES
from locclient.replay.run_metrics import FrameRecord
from locclient.replay.run_result import ReplayResult
from locclient.robot.failure_report import RobotProfile
from locclient.robot.robot import ImagePriors, Outcome, Robot
from locclient.robot.version_trial import TrialSettings

_ENDPOINT = re.compile(r"(tcp|tls|udp|quic|ws|unixsock-stream)/")
LOOK_S = 3.0  # of a start without a guess
_IMU_LEAD_NS = 100_000_000  # of a robot's own samples before its first frame
TRUTH_FLAG = "frame_from_ground_truth"  # key of the configuration: the map lies in the frame of the recordings' truth


class RunExport(Protocol):
    """Writes a replay's outcomes, frame by frame."""

    def begin(self, first_ns: int, loaded: LoadedMap, profile: RobotProfile, rectifier: Rectifier) -> None:
        """Write the map and the robot. Called once, before the first frame, with its stamp."""

    def handle(self, frame: CameraFrame, outcome: Outcome) -> None:
        """Write the results of a frame, with its images as recorded."""


@dataclass(frozen=True)
class ReplayOptions:
    """Settings of the localizer, playback at recorded speed, progress callback with the number of each frame, export file;
    open_priors: as of `PriorHook.open`. robot: name for the server and the export; default: the identity's, else `replay`."""

    settings: LocalizerSettings = field(default_factory=LocalizerSettings)
    realtime: bool = False
    progress: Callable[[int], None] = lambda _: None
    export: RunExport | None = None
    open_priors: Callable[[MountedCamera, Array], Sequence[ImagePriors]] = lambda *_: ()
    robot: str | None = None


def load_map(source: MapSource) -> tuple[LoadedMap, str]:
    """Return the version to run with all usable tiles, and a note if it is not the wanted version.

    Raises LinkError if no map is available.
    """
    ready = source.ready()
    manifest = source.manifest(ready.wanted)
    loaded = source.load(ready.wanted, manifest)
    if not manifest.tiles:
        raise LinkError(f"version {manifest.version} of site {manifest.site} has no tile at all; publish another one")
    if not loaded.tiles:
        reason = f"none of the {len(manifest.tiles)} tiles of version {manifest.version} is usable: {loaded.refused}"
        raise LinkError(reason)
    return loaded, ready.note


@gc_frozen()
def replay(
    source: ReplaySource, maps: MapSource, options: ReplayOptions, prior: PositionPrior | None = None
) -> ReplayResult:
    """Play the source; prior: a coarse pose at its beginning.

    An unreadable frame is left out with a note. Raises LinkError if no map can be fetched, RecordingError if most frames are
    unreadable.
    """
    cv2.setNumThreads(1)  # one thread, so that figures are those of one core
    loaded, note = load_map(maps)
    rectifier = Rectifier(source.calibration, has_depth=source.recording.sensor_set is SensorSet.RGBD)
    found = options.open_priors(rectifier.mounted[0], source.calibration.base_from_body)
    robot = Robot(rectifier, options.settings, TrialSettings(), time.process_time, image_priors=found)
    robot.use(loaded)
    give_back_free_memory()
    if prior is not None:
        robot.localizer.handle_prior(prior)
    truth_in_map = bool(loaded.manifest.configuration.get(TRUTH_FLAG))
    result = ReplayResult([], [], [], loaded, [note] if note else [], truth_in_map=truth_in_map)
    begun_s, first_ns = time.monotonic(), source.played_stamp_ns(source.recorded_stamp_ns(0))
    if options.export is not None:
        profile = RobotProfile(maps.site, options.robot or "replay", rectifier.rig, options.settings)
        options.export.begin(first_ns, loaded, profile, rectifier)
    unread: list[str] = []
    for number, before in enumerate(source.samples_before_each()):
        decode_s = time.process_time()
        try:
            raw = source.frame(number)
        except RecordingError as error:
            unread.append(str(error))
            robot.handle(before)
            continue
        decode_s = time.process_time() - decode_s
        if options.realtime:
            time.sleep(max(0.0, (raw.stamp_ns - first_ns) * 1e-9 - (time.monotonic() - begun_s)))
        wall_s = time.monotonic()
        outcome = robot.handle(replace(before, frame=raw))
        wall_s = time.monotonic() - wall_s
        if outcome is not None:  # else the view that it follows has no image in this frame
            truth = source.recording.ground_truth
            place = None if truth is None else truth.at(source.recorded_stamp_ns(number))
            _add(result, outcome, place, wall_s, decode_s)
            if options.export is not None:
                options.export.handle(raw, outcome)
        options.progress(number)
    _note_the_whole(result, source, unread)
    return result


def _add(result: ReplayResult, outcome: Outcome, truth: Array | None, wall_s: float, decode_s: float) -> None:
    """Add a frame, whose images were decoded beforehand; truth: map_from_body or that in the frame of the truth, as of the result."""
    estimate, error_map_m, error_rad = outcome.estimate, None, None
    if truth is not None and result.truth_in_map and estimate.map_from_body is not None:
        error_map_m = estimate.map_from_body[:3, 3] - truth[:3, 3]
        error_rad = rotation_angle_rad(estimate.map_from_body[:3, :3].T @ truth[:3, :3])
    record = FrameRecord(
        stamp_ns=estimate.stamp_ns,
        status=estimate.status,
        has_fix=estimate.fix is not None,
        cov_rot_trans=estimate.cov_rot_trans,
        error_map_m=error_map_m,
        error_rad=error_rad,
        cpu_s=outcome.cpu_s,
        wall_s=wall_s,
        stage_s={**outcome.stage_s, "decode": decode_s},
        speed_mps=outcome.speed_mps,
        may_be_mapped=outcome.may_be_mapped,
        protection_m=estimate.protection_m,
    )
    result.frames.append(record)
    result.estimates.append(estimate)
    result.truths.append(truth)
    result.search.handle(estimate, outcome.speed_mps, may_be_mapped=outcome.may_be_mapped)
    result.failures += outcome.failure is not None
    result.notes.extend(words for words in outcome.left_out.values() if words not in result.notes)


def _note_the_whole(result: ReplayResult, source: ReplaySource, unread: list[str]) -> None:
    """Note what the frames say together. RecordingError if most cannot be read."""
    if 2 * len(unread) > len(source):
        raise RecordingError(f"{len(unread)} of {len(source)} frames cannot be read; the first: {unread[0]}")
    if unread:
        result.notes.append(f"{len(unread)} of {len(source)} frames are left out; the first: {unread[0]}")
    if words := result.search.words:
        result.notes.append(words)
        recording = source.recording
        fit = lens_of_frames(recording.calibration, recording.frame_stamps_ns, recording.read_frame)
        if fit is not None and fit.is_doubtful:  # with a wrong lens model nothing in the map matches
            result.notes.append(fit.words(recording.calibration.cameras[0]))
    if not result.truth_in_map and any(truth is not None for truth in result.truths):
        result.notes.append(result.alignment_note())


# --- starts without a guess: a robot that is switched on somewhere, looks around for some seconds, and knows nothing -------------------


def spread_starts(source: ReplaySource, count: int) -> list[int]:
    """Return at most so many frame numbers, evenly spread over the frames that are followed by a whole look."""
    stamps_ns = source.recording.frame_stamps_ns[source.indices]
    last = int(np.searchsorted(stamps_ns, stamps_ns[-1] - int(LOOK_S * 1e9), side="right")) - 1
    return [int(number) for number in np.unique(np.linspace(0, max(last, 0), count).round().astype(int))]


def starts(
    source: ReplaySource, numbers: Sequence[int], loaded: LoadedMap, settings: LocalizerSettings
) -> Iterator[list[Estimate]]:
    """Yield the estimates of LOOK_S from each of the frames on, by a new robot each; the numbers ascend. Coarse poses are not played."""
    stamps_ns = source.recording.frame_stamps_ns[source.indices]
    rectifier = Rectifier(source.calibration, has_depth=source.recording.sensor_set is SensorSet.RGBD)
    shown: dict[int, CameraFrame] = {}
    for start in numbers:
        end = int(np.searchsorted(stamps_ns, stamps_ns[start] + int((LOOK_S + 1e-6) * 1e9)))
        shown = {k: frame for k, frame in shown.items() if k >= start}
        shown |= {k: source.frame(k) for k in range(start, end) if k not in shown}
        part = replace(source, indices=source.indices[start:end])
        robot = Robot(rectifier, settings, TrialSettings())
        robot.use(loaded)
        found = []
        for number, before in enumerate(part.samples_before_each()):
            frame = shown[start + number]
            imu = before.imu if number else before.imu.between(frame.stamp_ns - _IMU_LEAD_NS, 1 << 62)
            outcome = robot.handle(SensorBundle(frame, imu, before.wheel if number else []))
            if outcome is not None:
                found.append(outcome.estimate)
        yield found


@dataclass(frozen=True)
class LocalizeOptions(ReplayOptions):
    """Options of `localize` in addition to those of every replay.

    frames: Python slice of the recording's frames. reverse: backwards, with new stamps and without IMU. use: only the sensors of a
    smaller set. calibration, topics: for opening a recording by its path. root, identity, insecure: as of the command. cache, cache_bytes:
    folder and size of the tile cache. version: in a store's folder, drafts included.
    """

    frames: str = ":"
    reverse: bool = False
    use: SensorSet | None = None
    calibration: Path | None = None
    topics: Topics = field(default_factory=Topics)
    root: Path | None = None
    identity: Path | None = None
    insecure: bool = False
    cache: Path | None = None
    cache_bytes: int = DEFAULT_MAX_BYTES
    version: int | None = None


_DEFAULTS = LocalizeOptions()


def localize(
    recording: str | Path | Recording,
    maps: str | Path,
    site: str,
    *,
    prior: PositionPrior | None = None,
    options: LocalizeOptions = _DEFAULTS,
) -> ReplayResult:
    """Localize every frame of a recording in the current map of a site, as a robot would.

    recording: its path, or an open one. maps: folder of a store, or endpoint of a server, such as tcp/127.0.0.1:7447.
    prior: a coarse pose at the beginning. Raises FleetmapError if anything cannot be opened, read or fetched.
    """
    with ExitStack() as stack:
        if not isinstance(recording, Recording):
            how = OpenOptions(calibration_file=options.calibration, topics=options.topics)
            recording = stack.enter_context(open_recording(Path(recording), how))
        recording = reduced(recording, options.use)
        selection = FrameSelection.parse(options.frames)
        address = _address(maps, site, options)
        source_of_maps = stack.enter_context(connected(address, options.cache, options.cache_bytes))
        source = ReplaySource.of(recording, selection, reverse=options.reverse)
        stack.callback(cv2.setNumThreads, cv2.getNumThreads())
        return replay(source, source_of_maps, replace(options, robot=address.robot), prior)


def fetch_map(maps: str | Path, site: str, options: LocalizeOptions = _DEFAULTS) -> LoadedMap:
    """Fetch the current map of a site with all of its tiles, for a `MapView`; arguments and errors as of `localize`."""
    with connected(_address(maps, site, options), options.cache, options.cache_bytes) as source:
        return load_map(source)[0]


def _address(maps: str | Path, site: str, options: LocalizeOptions) -> MapAddress:
    is_server = isinstance(maps, str) and _ENDPOINT.match(maps) is not None
    place: dict[str, Any] = {"server" if is_server else "store": maps}
    return MapAddress.of(options, usual_robot="replay", site=site, **place)
