"""Poses of another SLAM system: noisy truth in a wrong convention, and poses of another recording, are refused."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fleetmap.errors import FleetmapError, RecordingError, UsageError
from fleetmap.geometry import Array, se3, se3_exp, se3_inverse, so3_exp
from fleetmap.recordings import Recording, open_recording
from fleetmap.recordings.sensor_subset import reduced
from fleetmap.recordings.tum import write_tum
from fleetmap.sensors.samples import SensorSet, Trajectory
from mapserver import BuildOptions, build_map
from mapserver.drafting.survey_recordings import GivenPoses
from mapserver.evaluation.trajectory_error import absolute_trajectory_error
from mapserver.plugins.given_trajectories import given as given_module
from mapserver.plugins.given_trajectories.formats import WrittenPoses
from mapserver.plugins.given_trajectories.given import GivenTrajectory, OwnMotion, fitted_scale, stamps_on_clock
from mapserver.survey.odometry_pass import poses_as_odometry
from support.recordings.recording_samples import BODY_FROM_CAM0, START_NS, write_mcap
from support.worlds.box_room import out_and_back, ride_sample, there_and_back

FRAMES = 61
FOLLOWED: dict[tuple[object, ...], OwnMotion] = {}
OTHER_FROM_MAP = se3(so3_exp(np.array([0.4, -0.3, 0.2])), np.array([3.0, 1.0, 0.5]))


@pytest.fixture(autouse=True)
def followed_once(monkeypatch) -> None:
    """Our odometry runs once over the same frames."""
    follow = given_module._followed

    def once(recording: Recording, indices: NDArray[np.int64], *, whole: bool) -> OwnMotion:
        key = recording.path, recording.sensor_set, len(indices), whole
        if key not in FOLLOWED:
            FOLLOWED[key] = follow(recording, indices, whole=whole)
        return FOLLOWED[key]

    monkeypatch.setattr(given_module, "_followed", once)


def drifted() -> Array:
    """The truth with a drift of centimetres, in a frame whose z is not up."""
    rng = np.random.default_rng(3)
    drift = np.cumsum(rng.normal(0, [2e-4] * 3 + [2e-3] * 3, (FRAMES, 6)), axis=0)
    return OTHER_FROM_MAP @ np.array(there_and_back().world_from_body) @ np.array([se3_exp(d) for d in drift])


def pose_rows(map_from_body: Array, *, scalar_first: bool = False) -> Array:
    """(F, 7) positions and quaternions."""
    quats = Rotation.from_matrix(map_from_body[:, :3, :3]).as_quat(scalar_first=scalar_first)
    return np.hstack([map_from_body[:, :3, 3], quats])


def written(
    file: Path,
    other_from_body: Array,
    stamps: Sequence[str],
    *,
    camera: bool = False,
    inverse: bool = False,
    order: str = "xyzw",
    scale: float = 1.0,
) -> Path:
    """A text file of poses of the body, brought into another system's convention."""
    other_from_it = other_from_body @ BODY_FROM_CAM0 if camera else other_from_body.copy()
    other_from_it[:, :3, 3] *= scale
    rows = pose_rows(se3_inverse(other_from_it) if inverse else other_from_it, scalar_first=order == "wxyz")
    lines = [" ".join([stamp, *(f"{value:.9f}" for value in row)]) for stamp, row in zip(stamps, rows, strict=True)]
    file.write_text("\n".join(lines) + "\n")
    return file


def in_seconds() -> list[str]:
    return [f"{stamp / 10**9:.6f}" for stamp in there_and_back().stamps_ns.tolist()]


def given(recording: Path, other: GivenTrajectory, use: SensorSet | None = None, frames: int = FRAMES) -> GivenPoses:
    with open_recording(recording) as opened:
        return other.poses_of(reduced(opened, use), np.arange(frames))


def off_m(found: GivenPoses) -> float:
    truth = Trajectory(there_and_back().stamps_ns, np.array(there_and_back().world_from_body))
    return absolute_trajectory_error(found.trajectory, truth).rmse_m


@pytest.mark.parametrize("use", [None, SensorSet.STEREO])
@pytest.mark.parametrize("frame", ["camera", "body"])
@pytest.mark.parametrize(
    ("wrong", "instead"),
    [
        ({}, ""),
        ({"camera": None}, "say --trajectory-frame"),
        ({"inverse": True}, "write map_from_pose, the inverse of each pose"),
        ({"order": "wxyz"}, "write quaternions as x y z w"),
    ],
)
def test_a_wrong_convention_is_refused_with_the_one_that_fits(
    room_ride: Path, tmp_path: Path, use: SensorSet | None, frame: str, wrong: dict[str, Any], instead: str
) -> None:
    convention = {"camera": frame == "camera"} | wrong
    if wrong == {"camera": None}:
        convention, instead = {"camera": frame == "body"}, f"{instead} {'camera' if frame == 'body' else 'body'}"
    file = written(tmp_path / "p.tum", drifted(), in_seconds(), **convention)
    if instead:
        with pytest.raises(RecordingError, match=f"does not fit ride as poses of the {frame}: .*; {instead}$"):
            given(room_ride, GivenTrajectory(file, frame), use)
    else:
        found = given(room_ride, GivenTrajectory(file, frame), use)
        assert f"trajectory p.tum (TUM): poses of the {frame}, scale 1:" in found.words
        assert off_m(found) < 0.02


@pytest.mark.parametrize(
    "stamp",
    [lambda ns: f"{(ns - START_NS) / 10**9:.7f}", lambda ns: f"{(ns - START_NS) / 10**8:.1f}"],
    ids=["elapsed", "frames"],
)
def test_stamps_of_mast3r_and_dpv_slam_are_read(room_ride: Path, tmp_path: Path, stamp: Any) -> None:
    """Seconds since the first frame, and numbers of frames."""
    stamps = [stamp(ns) for ns in there_and_back().stamps_ns.tolist()]
    file = written(tmp_path / "p.txt", drifted(), stamps, camera=True)
    assert off_m(given(room_ride, GivenTrajectory(file))) < 0.02


@pytest.mark.parametrize("stamps", [False, True], ids=["rows", "numbers"])
def test_frames_that_are_damaged_count(room_ride: Path, tmp_path: Path, stamps: bool) -> None:
    """A row for each frame, and numbers of frames: the other system has counted those too that are left out here."""
    count = len(there_and_back().stamps_ns)
    map_from_it = np.tile(np.eye(4), (count, 1, 1))
    rows = WrittenPoses("any", np.arange(count) * 1_000_000_000 if stamps else None, map_from_it)
    with open_recording(room_ride) as opened:
        kept = np.delete(np.arange(count), 7)
        sound = replace(opened.part(kept), damaged_ns=opened.frame_stamps_ns[[7]])
        found = stamps_on_clock(rows, sound, np.arange(count - 1), GivenTrajectory(tmp_path / "p.txt"))
        np.testing.assert_array_equal(found, opened.frame_stamps_ns)


@pytest.mark.parametrize("scale", [1000.0, 0.3])
def test_the_scale_is_found(room_ride: Path, tmp_path: Path, scale: float) -> None:
    file = written(tmp_path / "p.tum", drifted(), in_seconds(), camera=True, scale=scale)
    found = given(room_ride, GivenTrajectory(file))
    said = float(found.words.partition("scale ")[2].partition(":")[0])
    assert said * scale == pytest.approx(1.0, rel=0.02)
    assert off_m(found) < 0.03


@pytest.mark.parametrize(("noise_m", "own_noise_m"), [(0.0, 0.0), (0.05, 0.0), (0.0, 0.05), (0.05, 0.05)])
@pytest.mark.parametrize("metres", [1.0, 0.8, 1000.0])
def test_noise_of_neither_side_passes_for_another_scale(noise_m: float, own_noise_m: float, metres: float) -> None:
    """Over so many stretches four standard errors alone are less than what the noise takes from a regression; our own odometry is off."""
    rng = np.random.default_rng(7)
    true_m = 0.3 * rng.normal(size=(4000, 3)) / np.sqrt(3)
    moved = (true_m + rng.normal(0, noise_m, true_m.shape)) / metres
    seen = 0.995 * true_m + rng.normal(0, own_noise_m, true_m.shape)
    moved[::50] *= 5.0  # slips
    scale, within = fitted_scale(moved, seen)
    assert abs(np.log(scale / metres)) <= within < 0.2
    assert (abs(np.log(scale)) <= within) == (metres == 1.0)


def test_kitti_and_droid_are_read(room_ride: Path, tmp_path: Path) -> None:
    map_from_cam = drifted() @ BODY_FROM_CAM0
    np.savetxt(tmp_path / "p.txt", map_from_cam[:, :3].reshape(-1, 12))
    assert off_m(given(room_ride, GivenTrajectory(tmp_path / "p.txt"))) < 0.02
    np.save(tmp_path / "poses.npy", pose_rows(se3_inverse(map_from_cam))[::2].astype(np.float32))
    np.save(tmp_path / "tstamps.npy", np.arange(0, FRAMES, 2, np.float64))
    found = given(room_ride, GivenTrajectory(tmp_path))
    assert "(DROID): poses of the camera" in found.words
    assert off_m(found) < 0.02


@pytest.mark.parametrize("use", [None, SensorSet.STEREO])
def test_missing_poses_are_bridged_by_our_odometry(room_ride: Path, tmp_path: Path, use: SensorSet | None) -> None:
    """Every third one, a second in the middle, and both ends."""
    kept = [k for k in range(3, FRAMES - 4) if k % 3 and not 25 <= k < 36]
    stamps = np.array(in_seconds())[kept].tolist()
    found = given(room_ride, GivenTrajectory(written(tmp_path / "p.tum", drifted()[kept], stamps), "body"), use)
    assert "21 of 61 frames without a pose are bridged by our own odometry" in found.words
    assert len(found.trajectory) == FRAMES
    assert off_m(found) < 0.03


def test_standing_still_shows_no_metres(tmp_path: Path) -> None:
    still = ride_sample(lambda _: se3(so3_exp(np.array([0, 0, np.pi / 2])), np.zeros(3)), 20, 0.1)
    folder = write_mcap(tmp_path / "still", still)
    file = written(tmp_path / "p.tum", np.array(still.world_from_body), in_seconds()[:20])
    with pytest.raises(UsageError, match="set its metres with --trajectory-scale METRES"):
        given(folder, GivenTrajectory(file, "body"), frames=20)
    assert "as stated" in given(folder, GivenTrajectory(file, "body", scale=1.0), frames=20).words


@pytest.mark.parametrize("use", [None, SensorSet.STEREO])
def test_poses_of_another_recording_are_refused(room_ride: Path, tmp_path: Path, use: SensorSet | None) -> None:
    other = ride_sample(out_and_back(3.5, yaw_rad=0.3), FRAMES, 0.1, begin_s=0.4)
    file = written(tmp_path / "p.tum", np.array(other.world_from_body), in_seconds())
    with pytest.raises(RecordingError, match=r"another recording: .* off by \d+ % of"):
        given(room_ride, GivenTrajectory(file, "body"), use)
    late = [f"{stamp / 10**9 + 3600:.6f}" for stamp in there_and_back().stamps_ns.tolist()]
    with pytest.raises(RecordingError, match="another recording: of its 61 poses"):
        given(room_ride, GivenTrajectory(written(tmp_path / "q.tum", drifted(), late), "body"), use)


@pytest.mark.parametrize("use", [None, SensorSet.STEREO])
def test_a_build_from_poses_makes_a_map_of_them(
    room_ride: Path, tmp_path: Path, use: SensorSet | None, monkeypatch
) -> None:
    """Upright too, though the frame of the poses is not: by gravity, or by how the body began."""
    monkeypatch.setattr("mapserver.survey.stages.poses_as_odometry", begun := Mock(side_effect=poses_as_odometry))
    file = written(tmp_path / "p.tum", drifted(), in_seconds(), camera=True, scale=0.1)
    options = BuildOptions(use=use, trajectory=GivenTrajectory(file), threads=1)
    done = build_map(room_ride, tmp_path / "maps", "hall", options)
    assert done.report["ate_rmse_m"] < 0.02
    assert done.report["keyframes"] > 5
    begun.assert_called_once()
    assert len(begun.call_args.args[0]) == FRAMES
    (said,) = [words for words in done.report["findings"]["ride"] if words.startswith("trajectory p.tum (TUM)")]
    assert "poses of the camera" in said
    up = done.trajectory.frame_from_body[:, 2, :3]
    true_up = np.array(there_and_back().world_from_body)[:, 2, :3]
    assert np.arccos(np.clip(np.einsum("fi,fi->f", up, true_up), -1, 1)).max() < 0.01


def test_frames_between_keyframes_lose_the_noise_of_the_file(room_ride: Path, tmp_path: Path) -> None:
    """Pictures place them: noise of 4 cm in every pose is not in the map's trajectory."""
    rng = np.random.default_rng(4)
    noisy = [drift @ se3_exp(rng.normal(0, [3e-3] * 3 + [0.04] * 3)) for drift in drifted()]
    file = written(tmp_path / "p.tum", np.array(noisy), in_seconds())
    options = BuildOptions(use=SensorSet.STEREO, trajectory=GivenTrajectory(file, "body"), threads=1)
    done = build_map(room_ride, tmp_path / "maps", "hall", options)
    assert done.report["keyframes"] < FRAMES / 2
    assert done.report["ate_rmse_m"] < 0.02


def test_half_of_the_way_is_refused_by_name(room_ride: Path, tmp_path: Path) -> None:
    write_tum(tmp_path / "half.tum", Trajectory(there_and_back().stamps_ns[:28], drifted()[:28]))
    with pytest.raises(UsageError, match=r"no pose for 33 of 61 frames of ride: \d+\.\d{9}, .* --frames"):
        given(room_ride, GivenTrajectory(tmp_path / "half.tum", "body"))
    assert len(given(room_ride, GivenTrajectory(tmp_path / "half.tum", "body"), frames=28).trajectory) == 28


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "holds 0 poses"),
        ("1 2 3\n", "line 1: '1 2 3' is not 't x y z qx qy qz qw'"),
        ("1 0 0 0 0 0 0 1\n2 0 0 nan 0 0 0 1\n", "line 2.*NaN"),
        ("1 0 0 0 0 0 0 1\n2 1e13 0 0 0 0 0 1\n", "pose 2 is at"),
        ("1403636579763555584 0 0 0 0 0 0 1\n", "looks like ns; write seconds"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n2 0 0 0 0 1 0 0 0 0 1 0\n", "pose 2 has an invalid rotation"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n2 0 0\n", "each line must have twelve numbers"),
        ("\udcff", "not a text file"),
    ],
)
def test_files_that_are_no_poses_are_refused(room_ride: Path, tmp_path: Path, content: str, said: str) -> None:
    (tmp_path / "p.txt").write_bytes(content.encode("utf-8", "surrogateescape"))
    with pytest.raises(RecordingError, match=said):
        given(room_ride, GivenTrajectory(tmp_path / "p.txt"))


def test_arrays_that_are_no_poses_are_refused(room_ride: Path, tmp_path: Path) -> None:
    """Objects are not unpacked, and a header that promises more than the file holds reserves nothing."""
    file = tmp_path / "poses.npy"
    objects, words = np.array([{"a": 1}] * 7), np.array(["x"] * 9)
    for array in (objects, words, np.zeros((4, 5)), np.zeros((9, 7)), np.full((9, 7), np.nan)):
        np.save(file, array, allow_pickle=True)
        with pytest.raises(RecordingError, match=r"poses\.npy"):
            given(room_ride, GivenTrajectory(file))
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000, 7), }".ljust(117) + b"\n"
    for content in (b"", b"\x93NUMPY", b"\x93NUMPY\x01\x00v\x00" + header, b"\x93NUMPY\x01\x00v\x00" + b"(" * 118):
        file.write_bytes(content)
        with pytest.raises(RecordingError, match="file of numbers"):
            given(room_ride, GivenTrajectory(file))


@pytest.mark.parametrize(
    ("change", "use", "said"),
    [
        ({"frame": "lidar"}, None, "--trajectory-frame lidar: unknown frame; use one of camera, body"),
        ({"scale": 0.0}, None, "--trajectory-scale 0.0"),
        ({}, SensorSet.MONO, "needs stereo or depth"),
        ({"file": Path("nowhere.tum")}, None, "cannot be read"),
    ],
)
def test_what_does_not_fit_is_refused(
    room_ride: Path, tmp_path: Path, change: dict[str, object], use: SensorSet | None, said: str
) -> None:
    file = written(tmp_path / "p.tum", drifted(), in_seconds())
    with pytest.raises(FleetmapError, match=said):
        given(room_ride, GivenTrajectory(**{"file": file} | change), use)  # type: ignore[arg-type]


def test_one_file_belongs_to_one_recording(room_ride: Path, tmp_path: Path) -> None:
    file = written(tmp_path / "p.tum", drifted(), in_seconds())
    options = BuildOptions(trajectory=GivenTrajectory(file, "body"))
    with pytest.raises(UsageError, match="is for one recording, 2 are named"):
        build_map([room_ride, room_ride], tmp_path / "maps", "hall", options)
