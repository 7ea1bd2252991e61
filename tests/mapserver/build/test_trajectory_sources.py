"""Poses of another SLAM system as a survey's initial trajectory: truth with noise makes a map, what does not fit is refused."""

from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import FleetmapError, UsageError
from fleetmap.geometry import Array, se3, se3_exp, so3_exp
from fleetmap.recordings.tum import write_tum
from fleetmap.sensors.samples import SensorSet, Trajectory
from mapserver import BuildOptions, build_map
from mapserver.build.trajectory_sources import TRAJECTORY_SOURCES
from support.recordings.recording_samples import Sample, write_euroc
from support.worlds.box_room import out_and_back, ride_sample

FRAMES = 61


@pytest.fixture(scope="module")
def sample() -> Sample:
    return ride_sample(out_and_back(6.0), FRAMES, 0.1)


@pytest.fixture
def recording(sample: Sample, tmp_path: Path) -> Path:
    return write_euroc(tmp_path / "ride", sample)


def drifted(sample: Sample, rows: slice = slice(None), *, tilted: bool = False) -> Trajectory:
    """The truth with a drift of centimetres, every second frame; tilted: in a frame whose z is not up."""
    rng = np.random.default_rng(3)
    drift = np.cumsum(rng.normal(0, [2e-4] * 3 + [2e-3] * 3, (FRAMES, 6)), axis=0)
    other_from_map = se3(so3_exp(np.array([0.4, -0.3, 0.2])), np.array([3.0, 1.0, 0.5])) if tilted else np.eye(4)
    noisy = np.array(
        [other_from_map @ true @ se3_exp(d) for true, d in zip(sample.world_from_body, drift, strict=True)]
    )
    return Trajectory(sample.stamps_ns[::2][rows], noisy[::2][rows])


def options(file: Path | None, *, use: SensorSet | None = None, source: str = "tum") -> BuildOptions:
    return BuildOptions(use=use, trajectory_source=source, initial_trajectory=file, threads=1)


@pytest.mark.parametrize("use", [None, SensorSet.STEREO])
def test_noisy_poses_make_a_map_without_our_odometry(
    sample: Sample, recording: Path, tmp_path: Path, use: SensorSet | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With an IMU also in a frame whose z is not up: gravity levels it."""
    monkeypatch.setattr("mapserver.survey.pipeline.run_odometry", lambda *_: pytest.fail("odometry was run"))
    given = drifted(sample, tilted=use is None)
    write_tum(tmp_path / "poses.tum", given)
    done = build_map(recording, tmp_path / "maps", "hall", options(tmp_path / "poses.tum", use=use))
    assert done.report["ate_rmse_m"] < 0.02
    assert done.report["keyframes"] > 5
    assert _tilt_rad(done.trajectory.frame_from_body, sample) < 0.01


def _tilt_rad(map_from_body: Array, sample: Sample) -> float:
    """Largest angle between the z axis of the map and that of the truth, as the bodies see them."""
    mine, true = map_from_body[:, 2, :3], np.array(sample.world_from_body)[:, 2, :3]
    return float(np.arccos(np.clip(np.einsum("fi,fi->f", mine, true), -1, 1)).max())


def test_frames_without_poses_are_refused_by_name(sample: Sample, recording: Path, tmp_path: Path) -> None:
    write_tum(tmp_path / "half.tum", drifted(sample, slice(0, 20)))
    with pytest.raises(UsageError, match=r"no pose for 22 of 61 frames of ride: \d+\.\d{9}, .* --frames"):
        build_map(recording, tmp_path / "maps", "hall", options(tmp_path / "half.tum"))


@pytest.mark.parametrize(
    ("file", "use", "source", "said"),
    [
        (None, None, "tum", "needs --initial-trajectory"),
        ("poses.tum", None, "odometry", "is not read by"),
        ("poses.tum", None, "kalman", "the sources are odometry, tum"),
        ("poses.tum", SensorSet.MONO, "tum", "needs stereo or depth"),
        ("nowhere.tum", None, "tum", "cannot be read"),
    ],
)
def test_what_does_not_fit_is_refused(
    sample: Sample, recording: Path, tmp_path: Path, file: str | None, use: SensorSet | None, source: str, said: str
) -> None:
    write_tum(tmp_path / "poses.tum", drifted(sample))
    asked = options(None if file is None else tmp_path / file, use=use, source=source)
    with pytest.raises(FleetmapError, match=said):
        build_map(recording, tmp_path / "maps", "hall", asked)


def test_our_own_odometry_is_the_default() -> None:
    assert list(TRAJECTORY_SOURCES) == ["odometry", "tum"]
    assert BuildOptions().trajectory_source == "odometry"
