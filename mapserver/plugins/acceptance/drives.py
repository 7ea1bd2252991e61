"""A drive through a site: replayed by the robots' program, and its pictures localized in the version's tiles."""

import subprocess
from collections.abc import Iterable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import msgspec
import numpy as np

from fleetmap.bow.vocabulary import decode_vocabulary
from fleetmap.errors import FleetmapError, RecordingError
from fleetmap.failure_definition import SILENT_S, is_wrong
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array, Indices, Mask, rotation_angle_rad, se3_inverse
from fleetmap.mapformat.manifest import Manifest, RecordingEntry
from fleetmap.mapformat.tile import decode_tile
from fleetmap.messages import Status
from fleetmap.recordings import FrameSelection, Recording, open_recording
from fleetmap.recordings.tum import read_tum
from fleetmap.relocalization.map_view import MapView
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, SensorSet, Trajectory
from mapserver.doctor import Verdict, run_checks
from mapserver.drafting.admission import fingerprint, rig_evidence
from mapserver.drafting.draft_evidence import Before
from mapserver.drafting.survey_recordings import RecordingOptions
from mapserver.fleet.bounded_process import client_command
from mapserver.plugins.acceptance.figures import QUANTILES, DriveFigures, quantile
from mapserver.plugins.acceptance.ladders import ladders
from mapserver.quality.probes import Probe, probe_features, relocalized, spread
from mapserver.store import MapStore
from mapserver.store.archive import decode_archive

_NEVER_LOCALISED = 6  # exit status of `locclient replay` that comes with a report
# Of a place that can judge an estimate of centimetres: a dock or tag, not a zone or an operator's click
_DOCK_SIGMA_M = 0.1


class StartFrame(msgspec.Struct, frozen=True):
    """A frame of a start, as `locclient replay --starts` reports it."""

    stamp_ns: int
    status: str
    map_from_body: list[list[float]] | None


class ReplayReport(msgspec.Struct, frozen=True):
    """Keys of the report of `locclient replay`."""

    frames: int
    localised_share_of_all: float | None
    position_failures: int
    starts: list[list[StartFrame]] = []


class MapUnderTest(NamedTuple):
    """A version of a site. built: what its archive knows, None for a version without one."""

    store: Path
    manifest: Manifest
    view: MapView
    built: Before | None

    @classmethod
    def of(cls, maps: MapStore, site: str, version: int) -> "MapUnderTest":
        """Read a version; errors as of the store."""
        manifest, archive = maps.manifest(site, version), maps.archive(site, version)
        tiles = (decode_tile(maps.blob(tile.sha256)) for tile in manifest.tiles)
        view = MapView(tiles, decode_vocabulary(maps.blob(manifest.vocabulary.sha256)), manifest.camera.focal_px)
        built = None if archive is None else Before.of(maps, manifest, decode_archive(archive))
        return cls(maps.folder, manifest, view, built)


class Start(NamedTuple):
    """A start without a guess: its place (2,) in `map`, NaN if unknown, and its outcome, a field of StartCounts."""

    place_m: Array
    outcome: str


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture at its place. error_m: of its fix, None without one; is_wrong: its fix is at another place. rungs: by kind of ladder, the
    grey level and outcome at each rung that was tried."""

    probe: Probe
    grey: float
    error_m: float | None
    is_wrong: bool
    rungs: dict[str, dict[int, tuple[float, bool]]] = field(default_factory=dict)

    @property
    def is_fixed(self) -> bool:
        return self.error_m is not None and not self.is_wrong


class Drive(NamedTuple):
    """An examined drive."""

    figures: DriveFigures
    starts: list[Start]
    pictures: list[Picture]
    places_m: Array


def replayed(
    path: Path, reading: RecordingOptions, starts: int, version: MapUnderTest
) -> tuple[ReplayReport, Trajectory]:
    """Replay a drive, and so many starts, by `locclient replay` in a process of its own; return its report and the localized frames."""
    with TemporaryDirectory() as folder:
        report, trajectory = Path(folder) / "report.json", Path(folder) / "trajectory.tum"
        named = {
            "--store": version.store, "--site": version.manifest.site, "--version": version.manifest.version, "--frames": reading.frames,
            "--cache": folder, "--report": report, "--trajectory": trajectory, "--starts": starts,
            "--calibration": reading.calibration,
        }  # fmt: skip
        given = [word for option in named.items() if option[1] is not None for word in option]
        command = client_command("replay", path, *given)
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
        if done.returncode not in (0, _NEVER_LOCALISED):
            raise FleetmapError((done.stderr.strip().splitlines() or [f"replay of {path} failed"])[-1])
        return msgspec.json.decode(report.read_bytes(), type=ReplayReport), read_tum(trajectory)


def examined(
    path: Path,
    reading: RecordingOptions,
    pictures: int,
    version: MapUnderTest,
    replay: Future[tuple[ReplayReport, Trajectory]],
) -> Drive:
    """Return a drive with so many pictures, which the doctor checks while it is replayed; errors as of the recording and the replay."""
    with open_recording(path, reading.opening) as opened:
        findings = run_checks(opened).findings
        report, localised = replay.result()
        recording, selected = opened.readable(FrameSelection.parse(reading.frames).apply(opened))
        source, reference, is_free = _reference(recording, selected, version, localised)
        truths = [reference.at(int(stamp)) for stamp in recording.frame_stamps_ns[selected]]
        known = np.array([truth is not None for truth in truths], bool)
        numbers = spread(np.flatnonzero(known & is_free), pictures)
        looked = list(_pictures(recording, [(int(selected[n]), truths[n]) for n in numbers], version.view))
        starts = [_start(frames, reference) for frames in report.starts]
        off = {
            stamp: _off(map_from_body, truth)
            for stamp, map_from_body in zip(localised.stamps_ns.tolist(), localised.frame_from_body, strict=True)
            if (truth := reference.at(stamp)) is not None
        }
        errors_mm = None
        if off and reference is not localised:
            all_mm = [round(1e3 * error_m, 2) for error_m, _ in off.values()]
            errors_mm = {name: quantile(all_mm, share) for name, share in QUANTILES.items()} | {"max": max(all_mm)}
        docks_mm = [
            1e3 * float(np.linalg.norm((there @ se3_inverse(recording.calibration.base_from_body) - prior.map_from_base)[:2, 3]))
            for prior in recording.priors
            if prior.cov_rot_trans[3, 3] <= _DOCK_SIGMA_M**2 and not prior.is_revisable
            and (there := localised.at(prior.stamp_ns)) is not None
        ]  # fmt: skip
        stamps_ns = recording.frame_stamps_ns[selected]
        day = str(stamps_ns[0].astype("M8[ns]").astype("M8[D]"))
        figures = DriveFigures(
            name=recording.name,
            sha256=recording.content_hash(),
            day=day if day > "2000" else None,
            frames=report.frames,
            hours=round(float(stamps_ns[-1] - stamps_ns[0]) / 3.6e12, 6),
            reference=source,
            is_surveyed=any(recording.content_hash() == each.sha256 for each in version.manifest.recordings),
            localised_share=round(report.localised_share_of_all or 0.0, 4),
            failures=report.position_failures,
            silent=_silent_runs((stamp, is_wrong(*error)) for stamp, error in off.items()),
            errors_mm=errors_mm,
            docks_mm=[round(off, 1) for off in docks_mm],
            calibration=rig_evidence(fingerprint(recording.calibration), findings),
            remarks=[f"{f.name}: {f.sentence}" for f in findings if f.verdict in (Verdict.WARN, Verdict.FAIL)],
        )
    places = np.array([truth[:2, 3] for truth in truths if truth is not None]).reshape(-1, 2)
    return Drive(figures, starts, looked, places)


def _reference(
    recording: Recording, selected: Indices, version: MapUnderTest, localised: Trajectory
) -> tuple[str, Trajectory, Mask]:
    """Return the best known poses with the name of their source: ground truth in the map's frame, the version's own survey, or the
    localized frames themselves; and the mask (F,) of selected frames that did not make the map."""
    entry = RecordingEntry(name=recording.name, sha256=recording.content_hash(), frames=len(selected))
    known = None if version.built is None else version.built.trajectory_of(entry)
    source, trajectory = "its own replay", localised
    if version.manifest.configuration.get("frame_from_ground_truth") and recording.ground_truth is not None:
        source, trajectory = "ground truth", recording.ground_truth
    elif known is not None:
        source = f"the survey of version {version.manifest.version}"
        trajectory = Trajectory(recording.frame_stamps_ns[selected], known[0])
    return source, trajectory, np.ones(len(selected), bool) if known is None else known[1]


def _off(map_from_body: Array, truth: Array) -> tuple[float, float]:
    off = se3_inverse(truth) @ map_from_body
    return float(np.linalg.norm(off[:3, 3])), rotation_angle_rad(off[:3, :3])


def _silent_runs(frames: Iterable[tuple[int, bool]]) -> int:
    """Return the number of runs of wrong frames (stamp, is wrong) longer than SILENT_S, or up to the end: those may have become as long."""
    runs = [(is_off, [stamp_ns for stamp_ns, _ in run]) for is_off, run in groupby(frames, itemgetter(1))]
    return sum(is_off and (ns is runs[-1][1] or ns[-1] - ns[0] > SILENT_S * 1e9) for is_off, ns in runs)


def _start(frames: list[StartFrame], reference: Trajectory) -> Start:
    """Return the place and outcome of a start."""
    there = reference.at(frames[0].stamp_ns)
    place_m = np.full(2, np.nan) if there is None else there[:2, 3]
    wrong = [
        (frame.stamp_ns, frame.status == Status.TRACKING and is_wrong(*_off(np.array(frame.map_from_body), truth)))
        for frame in frames
        if frame.map_from_body is not None and (truth := reference.at(frame.stamp_ns)) is not None
    ]
    if _silent_runs(wrong):
        return Start(place_m, "silent")
    ended = frames[-1].status
    return Start(place_m, "found" if ended == Status.TRACKING else "ambiguous" if ended == Status.AMBIGUOUS else "lost")


def _pictures(recording: Recording, wanted: list[tuple[int, Array | None]], view: MapView) -> Iterator[Picture]:
    """Yield frames, localized from a prior at their own place, as they are and on the rungs of all ladders, up to the first miss."""
    rectifier = Rectifier(recording.calibration, has_depth=recording.sensor_set is SensorSet.RGBD)
    for index, truth in wanted:
        assert truth is not None
        try:
            frame = recording.read_frame(index)
        except RecordingError:
            continue
        map_from_cam = truth @ rectifier.body_from_cam

        def look(frame: CameraFrame, map_from_cam: Array = map_from_cam) -> Picture:
            features = probe_features(rectifier.rectify(frame), rectifier.camera, OrbSettings())
            probe = Probe(rectifier.camera, features, map_from_cam)
            fix = relocalized(view, probe, map_from_cam)
            error = None if fix is None else _off(fix.map_from_cam, map_from_cam)
            is_off = error is not None and is_wrong(*error)
            return Picture(probe, float(np.median(frame.left)), None if error is None else error[0], is_off)

        found = look(frame)
        for kind, rungs in ladders(frame, index).items():
            is_fixed = found.is_fixed
            for level, spoilt in rungs:
                is_fixed = is_fixed and look(spoilt).is_fixed  # a rung above a missed one counts as missed
                found.rungs.setdefault(kind, {})[level] = float(np.median(spoilt.left)), is_fixed
        yield found
