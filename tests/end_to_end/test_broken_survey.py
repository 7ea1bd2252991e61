"""A first survey whose robot is moved while it sees nothing, as its IMU does not say: no part of it stands elsewhere in the map."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapserver.drafting.draft import BuildOptions
from mapserver.library import build_map
from support.recordings.recording_samples import Sample, write_euroc
from support.worlds.box_room import out_and_back, ride_sample

DARK, FRAME_S, FRAME_NS = 5, 0.1, 100_000_000


def joined(one: Sample, two: Sample) -> Sample:
    """Two rides as one recording; the pictures at the beginning of the second one are black."""
    shift_ns = int(one.stamps_ns[-1] - two.stamps_ns[0]) + FRAME_NS
    seen = one.imu_stamps_ns < one.stamps_ns[-1] + FRAME_NS
    after = two.imu_stamps_ns + shift_ns > one.imu_stamps_ns[seen][-1]
    dark = [np.zeros_like(one.left[0])] * DARK
    return replace(
        one,
        stamps_ns=np.append(one.stamps_ns, two.stamps_ns + shift_ns),
        left=[*one.left, *dark, *two.left[DARK:]],
        right=[*one.right, *dark, *two.right[DARK:]],
        imu_stamps_ns=np.append(one.imu_stamps_ns[seen], two.imu_stamps_ns[after] + shift_ns),
        gyro_radps=np.vstack([one.gyro_radps[seen], two.gyro_radps[after]]),
        accel_mps2=np.vstack([one.accel_mps2[seen], two.accel_mps2[after]]),
        world_from_body=[*one.world_from_body, *two.world_from_body],
    )


@pytest.mark.parametrize(("moved_m", "is_whole"), [(0.0, True), (0.9, False)])
def test_revisits_that_agree_against_the_motion_in_the_dark_part_the_survey(
    tmp_path: Path, moved_m: float, is_whole: bool
) -> None:
    one = ride_sample(out_and_back(6.0), 70, FRAME_S, begin_s=-1.0)
    two = ride_sample(out_and_back(6.0, start_m=(-1.2 + moved_m, 0.6, 0.0)), 67, FRAME_S, seed=1, begin_s=-0.7)
    sample = joined(one, two)
    options = BuildOptions(frame_from_ground_truth=True)
    draft = build_map(write_euroc(tmp_path / "rides", sample), tmp_path / "store", "room", options)
    frames = np.searchsorted(sample.stamps_ns, draft.map.keyframe_stamps_ns)
    off_m = draft.map.map_from_body[:, :3, 3] - np.array(sample.world_from_body)[frames, :3, 3]
    assert np.linalg.norm(off_m, axis=1).max() < 0.02
    assert bool(frames.min() < 70 <= frames.max()) == is_whole
    assert ("drive it again" in str(draft.report["findings"])) != is_whole
