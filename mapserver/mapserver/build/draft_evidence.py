"""The rim around `quality`: frames are read from recordings, tiles as robots get them, and the draft is measured."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import Vocabulary
from fleetmap.errors import RecordingError
from fleetmap.geometry import Array
from fleetmap.mapformat import Manifest, RecordingEntry, Tile, decode_tile, encode_tile
from fleetmap.recordings import FrameSelection, OpenOptions, Recording, open_recording
from fleetmap.sensors.rectification import Rectifier, StereoCamera
from fleetmap.sensors.samples import SensorSet, Trajectory
from mapserver.build.sensor_subset import reduced
from mapserver.quality.directions import tile_directions
from mapserver.quality.evidence import Offered, examine, trajectory_breaks
from mapserver.quality.figures import Evidence, Motion
from mapserver.quality.probes import Look, Probe, held_out_frames, look_at, probes_of_map, spread
from mapserver.quality.tile_map import TileMap
from mapserver.store import MapStore
from mapserver.survey.pipeline import Survey
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_map import SurveyMap

PROBES = 40  # of each kind: one wrong or missing frame weighs 2.5 %


@dataclass(frozen=True, slots=True)
class HeldOut:
    """A look of a recording that the build did not use: its frame's number among the selected ones, and body_from_cam (4, 4)."""

    number: int
    look: Look
    body_from_cam: Array


def held_out_of(
    recording: Recording, selected: Sequence[int], rectifier: Rectifier, survey: Survey, settings: SurveySettings
) -> list[HeldOut]:
    """Frames of a surveyed recording that did not become keyframes, read again. Damaged ones are left out."""
    keyframes = [k.frame_index for k in survey.first_guess.keyframes]
    numbers = held_out_frames(keyframes, survey.map.trajectory_estimated, PROBES)
    return _looks(recording, selected, numbers, rectifier, settings)


def _looks(
    recording: Recording, selected: Sequence[int], numbers: Sequence[int], rectifier: Rectifier, settings: SurveySettings
) -> list[HeldOut]:  # fmt: skip
    found = []
    for number in numbers:
        try:
            frame = rectifier.rectify(recording.read_frame(int(selected[number])))
        except RecordingError:
            continue
        found.append(HeldOut(number, look_at(frame, rectifier.camera, settings), rectifier.body_from_cam))
    return found


@dataclass(frozen=True, slots=True)
class Before:
    """The version that a draft is built on: its manifest, its survey, its tiles."""

    manifest: Manifest
    survey: SurveyMap
    tiles: list[Tile]

    @classmethod
    def of(cls, maps: MapStore, manifest: Manifest, survey: SurveyMap) -> "Before":
        """The version of this manifest and archive, with its tiles from the store."""
        return cls(manifest, survey, [decode_tile(maps.blob(tile.sha256)) for tile in manifest.tiles])

    def trajectory_of(self, entry: RecordingEntry) -> tuple[Array, NDArray[np.bool_]] | None:
        """(F, 4, 4) map_from_body of a recording's frames when this version was made of it, and which (F,) may be offered.

        Keyframes are left out; None where the version was made without it.
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
    paths: Sequence[Path], before: Before, frames: str, calibration: Path | None, use: SensorSet | None, pinhole: StereoCamera,
    settings: SurveySettings,
) -> list[Probe]:  # fmt: skip
    """Frames of earlier recordings where the version that was made of them says they are; none of recordings it knows not."""
    probes: list[Probe] = []
    for path in paths:
        with open_recording(path, OpenOptions(calibration_file=calibration)) as opened:
            recording = reduced(opened, use)
            selected = FrameSelection.parse(frames).apply(recording)
            entry = RecordingEntry(name=recording.name, sha256=recording.content_hash(), frames=len(selected))
            known = before.trajectory_of(entry)
            if known is None:
                continue
            has_depth = recording.sensor_set is SensorSet.RGBD
            rectifier = Rectifier(recording.calibration, has_depth=has_depth, pinhole=pinhole)
            map_from_body, free = known
            looks = _looks(
                recording, selected.tolist(), spread(np.flatnonzero(free), PROBES // len(paths)), rectifier, settings
            )
            probes += [Probe(x.look, map_from_body[x.number] @ x.body_from_cam) for x in looks]
    return probes


def examine_draft(
    tiles: Sequence[Tile], before: Before | None, trajectories: Sequence[Trajectory], held_out: Sequence[Sequence[HeldOut]],
    surveys: Sequence[Survey], replayed: Sequence[Probe], vocabulary: Vocabulary, settings: SurveySettings,
) -> Evidence:  # fmt: skip
    """What probes find in the tiles as they are stored.

    trajectories, held_out and surveys go along: of each recording in the map, where its frames are in `map` now, frames that
    the build left out, and its survey.
    """
    probes = [
        Probe(x.look, trajectory.frame_from_body[x.number] @ x.body_from_cam)
        for trajectory, looks in zip(trajectories, held_out, strict=True)
        for x in looks[:: len(held_out)]
    ]
    last = [] if before is None else probes_of_map(before.survey, PROBES)
    stored = [decode_tile(encode_tile(tile)) for tile in tiles]
    evidence = examine(
        TileMap(stored), None if before is None else TileMap(before.tiles), Offered(probes, replayed, last),
        _motion(trajectories, surveys), vocabulary, settings,
    )  # fmt: skip
    return msgspec.structs.replace(evidence, directions=tile_directions(stored))


def _motion(trajectories: Sequence[Trajectory], surveys: Sequence[Survey]) -> Motion | None:
    """All recordings together; a single camera's odometry knows no metres to compare with."""
    found = [
        trajectory_breaks(
            trajectory.stamps_ns, trajectory.frame_from_body, survey.first_guess.odom_from_body, survey.first_guess.covariances,
            survey.first_guess.tracked.astype(bool),
        )
        for trajectory, survey in zip(trajectories, surveys, strict=True)
        if survey.state.camera.baseline_m > 0
    ]  # fmt: skip
    known = [motion for motion in found if motion is not None]
    if not known:
        return None
    return Motion(sum(m.stretches for m in known), sum(m.breaks for m in known), max(m.worst_m for m in known))
