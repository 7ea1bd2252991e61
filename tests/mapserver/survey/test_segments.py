"""A survey in segments: the same map whoever makes them, as good as the whole, and whole where a segment cannot start."""

import pickle
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from fleetmap.bow.vocabulary import default_vocabulary
from fleetmap.geometry import Array
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, ImuSamples, SensorSet, Stamps, Trajectory
from mapserver.config import survey_settings
from mapserver.drafting.mapped_images import MappedImageStore
from mapserver.drafting.worker import open_executor
from mapserver.evaluation.trajectory_error import absolute_trajectory_error
from mapserver.store.archive import encode_archive
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.segments import planned
from mapserver.survey.settings import SegmentSettings
from mapserver.survey.stages import Survey, survey
from mapserver.survey.state import ImageStore
from mapserver.survey.survey_inputs import SurveyConfig, SurveyInputs, SurveyTools
from support.recordings.kidnapped_ride import ride
from support.recordings.recording_samples import Sample, calibration
from support.worlds.box_room import ride_sample

FRAMES, FRAME_S = 147, 0.1
SEGMENTS = SegmentSettings(seconds=4.0, overlap_s=1.5)
SETTINGS = survey_settings(None, SensorSet.STEREO)


@lru_cache(maxsize=1)
def sample() -> Sample:
    return ride_sample(ride(), FRAMES, FRAME_S)


@dataclass(frozen=True)
class Parts:
    frames: list[CameraFrame]

    @property
    def stamps_ns(self) -> Stamps:
        return np.array([frame.stamp_ns for frame in self.frames])

    def part(self, first: int, end: int) -> list[CameraFrame]:
        return self.frames[first:end]


def surveyed(
    segments: SegmentSettings,
    executor: Executor = SERIAL,
    dark: tuple[float, float] = (0.0, 0.0),
    images: ImageStore | None = None,
) -> Survey:
    made, rig = sample(), replace(calibration(), imu=None)
    frames = [CameraFrame(int(s), a, b) for s, a, b in zip(made.stamps_ns, made.left, made.right, strict=True)]
    for n in range(round(dark[0] / FRAME_S), round(dark[1] / FRAME_S)):
        frames[n] = replace(frames[n], left=np.full_like(frames[n].left, 3), right=np.full_like(made.right[n], 3))
    rectifier = Rectifier(rig)
    inputs = SurveyInputs(iter(frames), len(frames), ImuSamples.empty(), rig, rectifier, parts=Parts(frames))
    config = SurveyConfig(msgspec.structs.replace(SETTINGS, segments=segments), default_vocabulary())
    return survey(inputs, config, SurveyTools(executor=executor, images=images or ImageStore()))


@lru_cache(maxsize=1)
def alone() -> Survey:
    return surveyed(SEGMENTS)


def ate_m(done: Survey) -> float:
    truth: list[Array] = list(sample().world_from_body)
    stamps = done.map.trajectory.stamps_ns
    return absolute_trajectory_error(done.map.trajectory, Trajectory(stamps, np.array(truth))).rmse_m


def test_segments_overlap_and_share_their_ends() -> None:
    stamps_ns = np.arange(1000) * 50_000_000
    segments = planned(stamps_ns, SegmentSettings(seconds=12.0, overlap_s=2.0))
    assert [s.begin for s in segments] == [0, 250, 500, 750]
    assert [s.last for s in segments] == [250, 500, 750, 999]
    assert [s.lead for s in segments] == [0, 210, 460, 710]
    assert len(planned(stamps_ns[:479], SegmentSettings(seconds=12.0, overlap_s=2.0))) == 1
    assert len(planned(stamps_ns, SegmentSettings(seconds=0.0))) == 1
    with pytest.raises(ValueError, match="half"):
        SegmentSettings(seconds=10.0, overlap_s=6.0)


def test_segments_make_a_map_as_good_as_the_whole() -> None:
    done, whole = alone(), surveyed(SegmentSettings(seconds=0.0))
    assert [cut.refused for cut in done.odometry.cuts] == [None, None]
    assert whole.odometry.cuts == ()
    frames = [k.frame_index for k in done.odometry.keyframes]
    assert {cut.frame for cut in done.odometry.cuts} <= set(frames)
    assert frames == sorted(set(frames))
    assert [e.frame_index for e in done.odometry.estimates] == list(range(FRAMES))
    assert len(done.odometry.tracks.starts) == FRAMES + 1  # type: ignore[union-attr]
    assert ate_m(done) < max(1.1 * ate_m(whole), ate_m(whole) + 0.001)


class Elsewhere:
    """An executor whose batches and results travel as to another machine."""

    def map(self, function: Any, shared: Any, batches: Any) -> Iterator[Any]:
        for batch in batches:
            yield pickle.loads(pickle.dumps(function(shared, pickle.loads(pickle.dumps(batch)))))


@pytest.mark.parametrize("is_elsewhere", [True, False])
@pytest.mark.parametrize("in_file", [True, False])
def test_who_makes_them_and_where_pictures_lie_does_not_matter(
    in_file: bool, is_elsewhere: bool, tmp_path: Path
) -> None:
    with open_executor(2, None) as executor, MappedImageStore(tmp_path) as images:
        made = surveyed(SEGMENTS, Elsewhere() if is_elsewhere else executor, images=images if in_file else None)
        assert encode_archive(made.map) == encode_archive(alone().map)
        assert all((keyframe.images is images) == in_file for keyframe in made.odometry.keyframes)


def test_a_segment_that_cannot_start_is_surveyed_with_the_one_before() -> None:
    cut_s = alone().odometry.cuts[0].after_s
    first, second = surveyed(SEGMENTS, dark=(cut_s - 0.3, cut_s + 0.2)).odometry.cuts
    assert first.refused is not None
    assert second.refused is None
