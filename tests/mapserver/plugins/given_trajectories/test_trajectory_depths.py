"""DROID's inverse depths make a single camera's recording one with depth; files that are not of its poses are refused."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fleetmap.errors import FleetmapError, RecordingError, UsageError
from fleetmap.geometry import se3, se3_inverse, so3_exp
from fleetmap.sensors.calibration import CameraCalibration
from fleetmap.sensors.samples import CameraFrame, SensorSet
from mapserver import BuildOptions, build_map
from mapserver.drafting.survey_recordings import OpenRecordings, RecordingOptions
from mapserver.plugins.given_trajectories.depths import DepthFrames
from mapserver.plugins.given_trajectories.given import GivenTrajectory
from support.recordings.recording_samples import BODY_FROM_CAM0, HEIGHT, WIDTH
from support.worlds.box_room import points_seen, there_and_back

FRAMES, STEP, CELL_PX = 61, 2, 8
METRES = 2.5  # in the run's unit of length
RUN_FROM_MAP = se3(so3_exp(np.array([0.4, -0.3, 0.2])), np.array([3.0, 1.0, 0.5]))
ROWS, COLUMNS = HEIGHT // CELL_PX, WIDTH // CELL_PX


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run's folder: every second frame is a keyframe; depths at an eighth of the resolution, poses in a unit of its own."""
    v, u = np.indices((ROWS, COLUMNS))
    pixels = (np.column_stack([u.ravel(), v.ravel()]) + 0.5) * CELL_PX - 0.5
    inverse = []
    map_from_cams = np.array(there_and_back().world_from_body[::STEP]) @ BODY_FROM_CAM0
    for map_from_cam in map_from_cams:
        points_cam = (points_seen(map_from_cam, pixels) - map_from_cam[:3, 3]) @ map_from_cam[:3, :3]
        inverse.append((METRES / points_cam[:, 2]).reshape(ROWS, COLUMNS))
    cams_from_run = se3_inverse(RUN_FROM_MAP @ map_from_cams)
    quats = Rotation.from_matrix(cams_from_run[:, :3, :3]).as_quat()
    np.save(tmp_path / "poses.npy", np.hstack([cams_from_run[:, :3, 3] / METRES, quats]).astype(np.float32))
    np.save(tmp_path / "tstamps.npy", np.arange(0, FRAMES, STEP, np.float64))
    np.save(tmp_path / "disps.npy", np.array(inverse, np.float32))
    return tmp_path


def options(run: Path, scale: float | None = METRES, use: SensorSet = SensorSet.MONO) -> OpenRecordings:
    return OpenRecordings(RecordingOptions(use=use, trajectory=GivenTrajectory(run, scale=scale)), run)


@pytest.mark.parametrize("use", [SensorSet.MONO, SensorSet.MONO_INERTIAL])
@pytest.mark.parametrize("intrinsics", [False, True])
def test_depths_are_those_of_the_recorded_pixels(room_ride: Path, run: Path, use: SensorSet, intrinsics: bool) -> None:
    if intrinsics:
        cells = [200 / CELL_PX, 200 / CELL_PX, WIDTH / CELL_PX / 2 - 0.5, HEIGHT / CELL_PX / 2 - 0.5]
        np.save(run / "intrinsics.npy", np.tile(np.array(cells, np.float32), (len(range(0, FRAMES, STEP)), 1)))
    with options(run, use=use).open(room_ride) as (opened, indices):
        assert opened.sensor_set is SensorSet.RGBD
        assert indices.tolist() == list(range(0, FRAMES, STEP))
        assert "30 of 61 frames have none in disps.npy" in opened.issues[-1].detail
        depth_m, without = opened.read_frame(20).depth_m, opened.read_frame(21).depth_m
        part_m = opened.part(indices[10:12]).read_frame(0).depth_m
        digest = opened.content_hash()
    assert not without.any()
    np.testing.assert_array_equal(part_m, depth_m)
    with OpenRecordings(RecordingOptions(use=use), run).open(room_ride) as (plain, _):
        assert digest == plain.content_hash()
    v, u = np.nonzero(depth_m)
    assert len(v) > 0.85 * WIDTH * HEIGHT
    map_from_cam = there_and_back().world_from_body[20] @ BODY_FROM_CAM0
    seen = (points_seen(map_from_cam, np.column_stack([u, v])) - map_from_cam[:3, 3]) @ map_from_cam[:3, :3]
    off = np.abs(depth_m[v, u] / seen[:, 2] - 1)
    assert np.percentile(off, 95) < 0.01
    assert off.max() < 0.15  # at the room's edges


def test_between_two_surfaces_no_depth_is_made_up(room_ride: Path, run: Path) -> None:
    inverse = np.full((len(range(0, FRAMES, STEP)), ROWS, COLUMNS), 1.0, np.float32)
    inverse[:, :, COLUMNS // 2 :] = 0.5
    inverse[:, 3, 3] = 0.0
    np.save(run / "disps.npy", inverse)
    with options(run).open(room_ride) as (opened, _):
        depth_m = opened.read_frame(0).depth_m
    np.testing.assert_allclose(np.unique(depth_m), [0.0, METRES, 2 * METRES], rtol=1e-5)
    assert not depth_m[28, 28]


@pytest.mark.parametrize(("width", "height"), [(94, 60), (512, 320)])
def test_a_lens_bends_the_recorded_pixels_alone(tmp_path: Path, width: int, height: int) -> None:
    """A slanted plane, whose depths the run wrote for the picture without distortion."""
    bent = np.array([-0.28, 0.07, 2e-4, 2e-5])
    camera = CameraCalibration("radial-tangential", 752, 480, np.array([458.0, 457, 367, 248]), bent, np.eye(4))
    normal, distance_m, per_px = np.array([0.1, 0.2, 1.0]), 4.0, np.array([width / 752, height / 480])
    places = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    rays = ((places + 0.5) / per_px - 0.5 - camera.intrinsics_px[2:]) / camera.intrinsics_px[:2]
    np.save(tmp_path / "disps.npy", ((rays @ normal[:2] + 1.0) * METRES / distance_m)[None].astype(np.float32))
    picture = CameraFrame(0, np.zeros((480, 752), np.uint8))
    source = SimpleNamespace(frame=lambda _: picture)
    depth_m = DepthFrames(source, tmp_path / "disps.npy", np.array([0]), camera, METRES).frame(0).depth_m
    v, u = np.nonzero(depth_m)
    assert len(v) > 0.65 * 480 * 752  # the corners lie outside of a picture without distortion
    seen = camera.ray_from_pixel(np.column_stack([u, v]).astype(float))
    np.testing.assert_allclose(depth_m[v, u], distance_m / (seen / seen[:, 2:] @ normal), rtol=1e-3)


def test_a_single_camera_is_surveyed_with_them_in_metres(room_ride: Path, run: Path) -> None:
    chosen = BuildOptions(use=SensorSet.MONO, trajectory=GivenTrajectory(run, scale=METRES), threads=1)
    done = build_map(room_ride, run / "maps", "hall", chosen)
    assert done.report["ate_rmse_m"] < 0.03
    assert done.report["keyframes"] > 5
    moved = np.ptp(done.trajectory.positions_m, axis=0).max()
    assert moved == pytest.approx(np.ptp(np.array(there_and_back().world_from_body)[:, :3, 3], axis=0).max(), rel=0.02)
    said = [words for words in done.report["findings"]["ride"] if "disps.npy" in words]
    assert said == ["depth of another system: 30 of 61 frames have none in disps.npy and are left out"]
    assert f"scale {METRES}" in " ".join(done.report["findings"]["ride"])


def test_depths_of_another_unit_than_the_poses_are_refused(room_ride: Path, run: Path) -> None:
    np.save(run / "disps.npy", np.load(run / "disps.npy") / 4)
    chosen = BuildOptions(use=SensorSet.MONO, trajectory=GivenTrajectory(run, scale=METRES), threads=1)
    with pytest.raises(RecordingError, match="another recording"):
        build_map(room_ride, run / "maps", "hall", chosen)


def test_without_depths_or_with_other_sensors_nothing_changes(room_ride: Path, run: Path) -> None:
    with options(run, None, SensorSet.STEREO).open(room_ride) as (opened, indices):
        assert opened.sensor_set is SensorSet.STEREO
        assert len(indices) == FRAMES
    (run / "disps.npy").unlink()
    with options(run, None).open(room_ride) as (opened, indices):
        assert opened.sensor_set is SensorSet.MONO
        assert len(indices) == FRAMES


def spoil(change: Callable[[np.ndarray], np.ndarray], name: str = "disps.npy") -> Callable[[Path], None]:
    return lambda run: np.save(run / name, change(np.load(run / name)), allow_pickle=True)


def put(value: float) -> Callable[[Path], None]:
    return spoil(lambda array: np.where(np.arange(array.size).reshape(array.shape) == 5000, np.float32(value), array))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (spoil(lambda array: array.astype(object)), r"disps\.npy is not a \.npy file of numbers"),
        (spoil(lambda array: array[:-1]), "30 images for 31 poses"),
        (spoil(lambda array: array[0]), r"of shape \(30, 40\)"),
        (spoil(lambda array: array.astype(np.int32)), "type int32"),
        (spoil(lambda array: np.swapaxes(array, 1, 2)), "images of 30x40, the camera 320x240"),
        (put(np.nan), "image 5 has invalid inverse depths"),
        (put(-0.1), "image 5 has invalid inverse depths"),
        (put(np.inf), "image 5 has invalid inverse depths"),
        (lambda run: (run / "disps.npy").write_bytes((run / "disps.npy").read_bytes()[:-100]), "not a .npy file"),
        (spoil(lambda array: array + 7200.0, "tstamps.npy"), "another recording"),
        (lambda run: np.save(run / "intrinsics.npy", np.ones(4)), r"intrinsics\.npy is of shape \(4,\)"),
        (lambda run: np.save(run / "intrinsics.npy", np.ones((31, 4))), "has its centre at"),
    ],
)
def test_files_that_are_no_depths_are_refused(
    room_ride: Path, run: Path, change: Callable[[Path], None], said: str
) -> None:
    change(run)
    with pytest.raises(RecordingError, match=said), options(run).open(room_ride):
        pass


def test_what_is_not_known_is_asked_for(room_ride: Path, run: Path) -> None:
    with pytest.raises(UsageError, match="--trajectory-scale"), options(run, None).open(room_ride):
        pass
    for name in ("poses.npy", "tstamps.npy", "disps.npy"):
        np.save(run / name, np.load(run / name)[:10])
    with pytest.raises(FleetmapError, match="spans less than half"), options(run).open(room_ride):
        pass
