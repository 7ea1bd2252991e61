"""Frames of recordings, relocalized in a draft's tiles in their final form: some have a say in its landmarks, the others are evidence.

A view that has a say, and gets no fix or a weak one, gets more landmarks.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.bow.vocabulary import Vocabulary
from fleetmap.errors import RecordingError
from fleetmap.failure_definition import is_wrong
from fleetmap.features.settings import OrbSettings
from fleetmap.geometry import Array, Indices, Mask, rotation_angle_rad, se3_inverse
from fleetmap.mapformat.manifest import Manifest, RecordingEntry
from fleetmap.mapformat.tile import Tile, decode_tile, encode_tile
from fleetmap.recordings import Recording
from fleetmap.relocalization.map_view import MapView, places_around
from fleetmap.relocalization.relocalizer import Fix, FrameFeatures, is_reliable
from fleetmap.relocalization.settings import FixSettings
from fleetmap.sensors.rectification import Rectifier, StereoCamera
from fleetmap.sensors.samples import SensorSet, Trajectory
from mapserver.quality import probes as probing
from mapserver.quality.directions import tile_directions
from mapserver.quality.evidence import Probes, displaced, examine, trajectory_breaks
from mapserver.quality.figures import BlindView, Evidence, RigEvidence, SurveyedViews, TrajectoryBreaks
from mapserver.quality.probes import Probe, anywhere, place_xy, probe_features, relocalized, spread
from mapserver.store import MapStore
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.rig import frame_of_camera, used_cameras
from mapserver.survey.settings import BudgetSettings
from mapserver.survey.stages import Survey
from mapserver.survey.survey_map import SurveyMap, history_of
from mapserver.tiles.tiling import Sighting, choose_landmarks, tiles_from_survey

PROBES = 40  # of each kind: one wrong or missing frame counts 2.5 %
_LEAST_PROBES = 20  # of each recording in the version before
_HELD_OUT = 2 * PROBES  # every second one has a say in the landmarks for robots, and only the others can judge these


@dataclass(frozen=True, slots=True)
class ProbedFrame:
    """A frame of a surveyed recording, or one by a rig's other cameras: its number among the selected ones, its camera and features.

    is_held_out: True if the build did not use it; else an end of the drive that is a keyframe. view: its number.
    """

    number: int
    camera: StereoCamera
    body_from_cam: Array
    features: FrameFeatures
    is_held_out: bool = True
    view: int = 0

    def probe(self, map_from_body: Array) -> Probe:
        """Return it as a probe; map_from_body (F, 4, 4) of all selected frames."""
        return Probe(self.camera, self.features, map_from_body[self.number] @ self.body_from_cam)


class MappedSession(NamedTuple):
    """A recording in the map: poses of its frames in `map`, its probed frames, its survey, and its name."""

    trajectory: Trajectory
    probed: Sequence[ProbedFrame]
    survey: Survey
    name: str = ""

    @property
    def map_from_body(self) -> Array:
        """(F, 4, 4) of its frames."""
        return self.trajectory.frame_from_body

    def asked(self, recordings: int) -> list[ProbedFrame]:
        """Return the frames for which landmarks are chosen: every second held-out one of one of so many recordings, and both ends."""
        ends = {frame.number for frame in (*self.probed[:1], *self.probed[-1:])}
        return [*self._held_out(recordings, 1), *(frame for frame in self.probed if frame.number in ends)]

    def judging(self, recordings: int) -> list[ProbedFrame]:
        """Return the other held-out frames: the tiles do not depend on them."""
        asked = {frame.number for frame in self.asked(recordings)}
        return [frame for frame in self._held_out(recordings, 0) if frame.number not in asked]

    def probes(self, frames: Iterable[ProbedFrame]) -> list[Probe]:
        """Return frames of the recording as probes."""
        return [frame.probe(self.map_from_body) for frame in frames]

    def _held_out(self, recordings: int, first: int) -> list[ProbedFrame]:
        """Return the images of every second held-out frame of one of so many recordings."""
        numbers = list(dict.fromkeys(frame.number for frame in self.probed if frame.is_held_out))
        chosen = set(numbers[::recordings][first::2])
        return [frame for frame in self.probed if frame.number in chosen]


def probed_frames(
    recording: Recording, selected: Sequence[int], rectifier: Rectifier, survey: Survey, orb: OrbSettings
) -> list[ProbedFrame]:
    """Return frames of a surveyed recording that did not become keyframes, and both ends, read again. Damaged ones are left out."""
    keyframes, measured = survey.odometry.keyframe_frames, np.flatnonzero(survey.map.trajectory_estimated)
    # The survey used no image of these. Odometry tracked them, so their position between two keyframes is known to millimetres;
    # excluding whole stretches would leave gaps in the map.
    free = np.setdiff1d(measured, keyframes)
    numbers = sorted({*spread(free, _HELD_OUT), *spread(measured, 2)})
    found = _read(recording, selected, numbers, rectifier, orb)
    return [replace(frame, is_held_out=frame.number not in keyframes) for frame in found]


def _read(
    recording: Recording, selected: Sequence[int], numbers: Sequence[int], rectifier: Rectifier, orb: OrbSettings
) -> list[ProbedFrame]:
    found = []
    for number in numbers:
        try:
            frame = rectifier.rectify(recording.read_frame(int(selected[number])))
        except RecordingError:
            continue
        for view, used in used_cameras(rectifier):
            if view and not used.baseline_m > 0:
                continue
            if (seen := frame_of_camera(frame, view)) is not None:
                camera, body_from_cam = rectifier.mounted[view]
                found.append(ProbedFrame(number, camera, body_from_cam, probe_features(seen, camera, orb), view=view))
    return found


class AskedView(NamedTuple):
    """A frame to be localized, and the path driven up to it in its recording."""

    probe: Probe
    path_m: float


def asked_views(sessions: Sequence[MappedSession]) -> list[AskedView]:
    """Return held-out frames of all recordings that judge no draft, and both ends of every recording."""
    found = []
    for session in sessions:
        map_from_body, positions_m = session.trajectory.frame_from_body, session.trajectory.positions_m
        path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions_m, axis=0), axis=1))])
        frames = list({(frame.number, frame.view): frame for frame in session.asked(len(sessions))}.values())
        found += [AskedView(frame.probe(map_from_body), float(path_m[frame.number])) for frame in frames]
    return found


class TileChooser(NamedTuple):
    """A map, its budget for robots, and what their tiles need.

    published: landmarks with priority, None in a first version. frozen (N,): those that are chosen only if published.
    """

    survey_map: SurveyMap
    settings: BudgetSettings
    published: NDArray[np.uint32] | None
    vocabulary: Vocabulary
    frozen: Mask | None = None

    def choose(self, views: Sequence[AskedView]) -> tuple[list[Tile], SurveyedViews]:
        """Return the tiles, and which views give no fix in them.

        The budget is chosen for what keyframes observed. A view between them or beyond the last one may match few of those
        landmarks: those that it matches among all landmarks then count as its observations, and the budget is chosen again. What one view
        gets others lose: the second choice is taken if fewer views are without a fix in it, or as many and fewer are weak.
        """
        tiles = self._tiles(())
        fixes = self._fixes(tiles, views)
        weak = [view for view, fix in zip(views, fixes, strict=True) if fix is None or not _is_sure(fix)]
        sightings = [found for view in weak if (found := self._sighting(view.probe)) is not None]
        given_more = 0
        if sightings:
            again = self._tiles(sightings)
            fixes_again = self._fixes(again, views)
            if _lacking(fixes_again) < _lacking(fixes):
                tiles, fixes, given_more = again, fixes_again, len(sightings)
        missed = [view for view, fix in zip(views, fixes, strict=True) if fix is None]
        places = [BlindView(place_xy(view.probe.map_from_cam), round(view.path_m, 1)) for view in missed]
        return tiles, SurveyedViews(len(views), given_more, places)

    def _tiles(self, sightings: Sequence[Sighting]) -> list[Tile]:
        chosen = choose_landmarks(self.survey_map, self.settings, self.published, sightings)
        if self.frozen is not None and self.published is not None:
            chosen = np.where(self.frozen, np.isin(self.survey_map.landmark_ids, self.published), chosen)
        return tiles_from_survey(self.survey_map, chosen=chosen)

    def _view(self, tiles: Sequence[Tile]) -> MapView:
        return MapView(_as_stored(tiles), self.vocabulary, self.survey_map.camera.focal_px)

    def _fixes(self, tiles: Sequence[Tile], views: Sequence[AskedView]) -> list[Fix | None]:
        view = self._view(tiles)
        return [relocalized(view, each.probe, each.probe.map_from_cam) for each in views]

    def _sighting(self, probe: Probe) -> Sighting | None:
        """Return the matches of a probe among all landmarks that were observed around it; None without a fix at its place."""
        survey = self.survey_map
        map_from_cam = survey.map_from_body @ survey.body_from_cam
        near = places_around(map_from_cam, probe.map_from_cam, probing.PRIOR_RADIUS_M, probing.SAME_WAY_COSINE)
        around = np.zeros(len(survey.landmark_ids), bool)
        around[survey.obs_landmark[near[survey.obs_keyframe]]] = True
        view = self._view(tiles_from_survey(survey, chosen=around))
        fix = relocalized(view, probe, probe.map_from_cam)
        if fix is None or fix.matches is None:
            return None
        off = se3_inverse(probe.map_from_cam) @ fix.map_from_cam
        if is_wrong(float(np.linalg.norm(off[:3, 3])), rotation_angle_rad(off[:3, :3])):
            return None
        features, rows = fix.matches.T
        order = np.argsort(survey.landmark_ids, kind="stable")
        landmarks = order[np.searchsorted(survey.landmark_ids, view.landmark_ids[rows], sorter=order)]
        return Sighting(fix.map_from_cam, landmarks, probe.features.pixels[features])


def _as_stored(tiles: Sequence[Tile]) -> list[Tile]:
    return [decode_tile(encode_tile(tile)) for tile in tiles]


def _lacking(fixes: Sequence[Fix | None]) -> tuple[int, int]:
    """Return the numbers of views without a fix, and of those without a sure one."""
    return fixes.count(None), sum(fix is None or not _is_sure(fix) for fix in fixes)


def _is_sure(fix: Fix) -> bool:
    """True if 95 % of other looks from there are reliable, too: the numbers that they find are distributed as Poisson's."""
    inliers, seen = (count - 1.645 * np.sqrt(count) for count in (fix.inliers, fix.seen))
    recall = seen / fix.expected if fix.expected else fix.landmark_recall
    return is_reliable(replace(fix, inliers=int(inliers), landmark_recall=recall), FixSettings())


@dataclass(frozen=True, slots=True)
class Before:
    """The parent version of a draft: its manifest, survey and tiles, and the calibrations judged up to it.

    removed_ids: landmarks that corrections of the site's areas take from the draft, None for none.
    """

    manifest: Manifest
    survey: SurveyMap
    tiles: list[Tile]
    calibrations: list[RigEvidence]
    removed_ids: NDArray[np.uint32] | None = None

    @classmethod
    def of(cls, maps: MapStore, manifest: Manifest, survey: SurveyMap) -> "Before":
        """Return the version of this manifest and archive, with its tiles from the store."""
        evidence = maps.evidence(manifest.site, manifest.version)
        known = () if evidence is None else evidence.calibrations or ()
        judged = [RigEvidence(rig.rig, rig.judged, pair_yaw=rig.pair_yaw) for rig in known if rig.judged]
        return cls(manifest, survey, [decode_tile(maps.blob(tile.sha256)) for tile in manifest.tiles], judged)

    def wanted_ids(self, survey_map: SurveyMap) -> NDArray[np.uint32]:
        """Return landmarks with priority in the budget: those on the robots, and those new in the map.

        The new ones compete with the published ones; others of the archive would only replace similar ones.
        """
        new = survey_map.landmark_ids[survey_map.landmark_ids >= history_of(self.survey).next_landmark_id]
        return np.unique(np.concatenate([new, *(tile.landmark_ids for tile in self.tiles)])).astype(np.uint32)

    def removed(self) -> dict[str, int]:
        """Return by tile, as "x,y", how many of its landmarks corrections take from the draft."""
        ids = np.zeros(0, np.uint32) if self.removed_ids is None else self.removed_ids
        counts = {f"{tile.tile_x},{tile.tile_y}": int(np.isin(tile.landmark_ids, ids).sum()) for tile in self.tiles}
        return {name: count for name, count in counts.items() if count}

    def trajectory_of(self, entry: RecordingEntry) -> tuple[Array, Mask] | None:
        """Return (F, 4, 4) map_from_body of a recording's frames from the build of this version, and a mask (F,) of usable ones.

        Keyframes are excluded; None if the version was built without it.
        """
        start = 0
        for known in self.manifest.recordings:
            if known.sha256 == entry.sha256 and known.frames == entry.frames:
                part = slice(start, start + known.frames)
                stamps_ns = self.survey.trajectory.stamps_ns[part]
                free = self.survey.trajectory_estimated[part] & ~np.isin(stamps_ns, self.survey.keyframe_stamps_ns)
                return self.survey.trajectory.frame_from_body[part], free
            start += known.frames
        return None


def replayed_probes(
    paths: Sequence[Path],
    before: Before,
    opened: Callable[[Path], tuple[Recording, Indices]],
    seen_by: tuple[StereoCamera, OrbSettings],
) -> list[Probe]:
    """Return frames of earlier recordings with their poses in the version built from them; none of unknown recordings.

    opened: gives a recording and its selected frames. seen_by: the camera to which they are resampled, and the survey's features.
    """
    probes: list[Probe] = []
    pinhole, orb = seen_by
    for path in paths:
        recording, selected = opened(path)
        with recording:
            entry = RecordingEntry(name=recording.name, sha256=recording.content_hash(), frames=len(selected))
            known = before.trajectory_of(entry)
            if known is None:
                continue
            has_depth = recording.sensor_set is SensorSet.RGBD
            rectifier = Rectifier(recording.calibration, has_depth=has_depth, pinhole=pinhole)
            map_from_body, free = known
            numbers = spread(np.flatnonzero(free), PROBES // len(paths))
            probes += [x.probe(map_from_body) for x in _read(recording, selected.tolist(), numbers, rectifier, orb)]
    return probes


def examine_draft(
    tiles: Sequence[Tile],
    vocabulary: Vocabulary,
    camera: StereoCamera,
    before: Before | None,
    sessions: Sequence[MappedSession],
    replayed: Sequence[Probe],
    executor: Executor = SERIAL,
) -> Evidence:
    """Return the findings of probes in the tiles as stored; camera: that of the map; sessions: its recordings."""
    held_out = [probe for session in sessions for probe in session.probes(session.judging(len(sessions)))]
    stored = _as_stored(tiles)
    probes = Probes(held_out, replayed, [] if before is None else probing.probes_of_map(before.survey, PROBES))
    current = None if before is None else MapView(before.tiles, vocabulary, before.survey.camera.focal_px)
    draft = MapView(stored, vocabulary, camera.focal_px)
    removed_ids = None if before is None else before.removed_ids
    found = examine(draft, current, probes, _breaks(sessions), removed_ids, executor)
    moved = []
    if before is not None and current is not None:
        recall = before.manifest.report.get("lookalike_recall") or 0.0
        for session in sessions:
            chosen = spread(np.arange(len(session.probed)), max(PROBES // len(sessions), _LEAST_PROBES))
            frames = session.probes([session.probed[n] for n in chosen])
            fixes = executor.map(anywhere, current, frames)
            moved.append(displaced(session.name, current, list(zip(frames, fixes, strict=True)), recall))
    directions = tile_directions({(tile.tile_x, tile.tile_y): tile.map_from_cam for tile in stored})
    return msgspec.structs.replace(found, directions=directions, displaced=moved or None)


def _breaks(sessions: Sequence[MappedSession]) -> TrajectoryBreaks | None:
    """Return the breaks of all recordings together; a single camera's odometry has no scale to compare."""
    found = []
    for trajectory, _, survey, _ in sessions:
        if survey.state.rig.camera.baseline_m > 0:
            guess = survey.odometry
            odometry = (guess.odom_from_body, guess.covariances, guess.tracked.astype(bool))
            breaks = trajectory_breaks(trajectory.stamps_ns, trajectory.frame_from_body, *odometry)
            found += [] if breaks is None else [msgspec.structs.astuple(breaks)]
    if not found:
        return None
    stretches, numbers, worst_m = zip(*found, strict=True)
    return TrajectoryBreaks(sum(stretches), sum(numbers), max(worst_m))
