"""Surveys under way in a test: recordings that are played for a kind of rig, and mapping without a process of its own."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import pytest

import mapserver
from fleetmap.geometry import Array, se3_inverse
from fleetmap.recordings.mcap.writer import McapRecordingWriter
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import CameraFrame, SensorSet
from mapserver.drafting.draft import BuildOptions, BuildRequest
from mapserver.plugins.live_surveys import live_survey
from mapserver.plugins.live_surveys.drives import RecordedDrive
from mapserver.plugins.live_surveys.live_map import LiveMap
from mapserver.plugins.live_surveys.message import MapSketch, NewKeyframe
from mapserver.survey.survey_inputs import SurveyConfig
from support.recordings.recording_samples import BODY_FROM_CAM0, Sample, calibration
from support.worlds.box_room import depth_of

_FURTHEST_M = 6.0  # that the depth camera measures


class MappingHere:
    """In the place of `MappingProcess`: every keyframe is mapped when it is put, and what the map was then is kept."""

    made: "MappingHere"

    def __init__(self, rectifier: Rectifier) -> None:
        self._rectifier, self.sketch = rectifier, MapSketch(keyframes=0)
        self.behind, self.most_behind, self.failed, self.longest_lag_s = 0, 0, "", 0.0
        self.after: dict[int, MapSketch] = {}  # by frame
        MappingHere.made = self

    def start(self, config: SurveyConfig) -> Self:
        self.map = LiveMap(config, self._rectifier)
        return self

    def put(self, frame: RectifiedFrame, keyframe: NewKeyframe) -> None:
        """One more keyframe."""
        self.map.add(frame, keyframe)
        self.sketch = self.after[keyframe.number] = self.map.sketch(np.zeros((0, 3)), [])

    def close(self) -> None:
        """Nothing waits."""

    @property
    def map_from_body(self) -> Array:
        """(K, 4, 4) of the keyframes."""
        return self.map.map_from_body


Call = tuple[Path, Path, str, BuildOptions]


def order_builds(monkeypatch: pytest.MonkeyPatch) -> list[Call]:
    """The builds that are ordered from now on and not done; mapping is done in this process."""
    ordered: list[Call] = []

    def build_map(recordings: Sequence[Path], *call: Any) -> object:
        ordered.append((*recordings, *call))
        return type("Built", (), {"version": 1, "sentence": "built"})()

    monkeypatch.setattr(live_survey, "MappingProcess", MappingHere)
    for module in (live_survey, mapserver):
        monkeypatch.setattr(module, "build_map", build_map)
    return ordered


class Laid(NamedTuple):
    """truth_from_map (4, 4) that lays the first pose upon the truth, and error_m (K,) of all poses then."""

    truth_from_map: Array
    error_m: Array


def laid_on_truth(map_from_body: Array, sample: Sample, frames: list[int]) -> Laid:
    """Poses of these frames against the truth of their recording."""
    truth = np.array(sample.world_from_body)[frames]
    truth_from_map = truth[0] @ se3_inverse(map_from_body[0])
    return Laid(truth_from_map, np.linalg.norm((truth_from_map @ map_from_body - truth)[:, :3, 3], axis=1))


@contextmanager
def played(
    recording: Path, store: Path, frames: str = "::", speed: float = 1.0, use: SensorSet | None = None
) -> Iterator[RecordedDrive]:
    """A recording, or the sensors `use` of it, as a drive for a draft of the site `lab`."""
    options = BuildOptions(frames, use=use)
    opened, indices = options.opened(recording)
    with opened:
        yield RecordedDrive(BuildRequest((recording,), "lab", store, options), opened, indices, speed)


def write_rgbd(path: Path, sample: Sample, *, has_depth: bool = True) -> Path:
    """A ride through the box room as its left camera and a depth camera see it; has_depth: False for one that measures nothing."""
    rig = calibration(has_imu=False)
    with McapRecordingWriter(path, replace(rig, cameras=rig.cameras[:1])) as writer:
        for stamp_ns, left, map_from_body in zip(
            sample.stamps_ns.tolist(), sample.left, sample.world_from_body, strict=True
        ):
            depth_m = depth_of(map_from_body @ BODY_FROM_CAM0)
            depth_m[depth_m >= _FURTHEST_M * has_depth] = 0.0
            writer.write_frame(CameraFrame(stamp_ns, left, None, depth_m))
    return path
