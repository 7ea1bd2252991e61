"""A cloud of points beside MASt3R's poses makes a single camera's recording one with depth; what is no such cloud is refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.errors import FleetmapError, RecordingError, UsageError
from fleetmap.geometry import Array, quat_wxyz_from_rotation, se3, se3_inverse, so3_exp
from fleetmap.sensors.samples import SensorSet
from mapserver import BuildOptions, build_map
from mapserver.build.survey_recordings import RecordingOptions
from mapserver.build.trajectory import OtherTrajectory
from mapserver.build.trajectory.clouds import Cloud, read_ply, sighting
from support.recordings.recording_samples import BODY_FROM_CAM0, HEIGHT, WIDTH, Sample, write_euroc
from support.worlds.box_room import out_and_back, points_seen, ride_sample

FRAMES, STEP, PIXELS = 61, 2, 2  # every second frame is a keyframe of the run, every second pixel of it a point
METRES = 2.5  # in the run's unit of length
RUN_FROM_MAP = se3(so3_exp(np.array([0.4, -0.3, 0.2])), np.array([3.0, 1.0, 0.5]))
WRITTEN = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
NAMES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}


@pytest.fixture(scope="module")
def sample() -> Sample:
    return ride_sample(out_and_back(6.0), FRAMES, 0.1)


@pytest.fixture(scope="module")
def recording(sample: Sample, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_euroc(tmp_path_factory.mktemp("recordings") / "ride", sample)


@pytest.fixture(scope="module")
def table(sample: Sample) -> NDArray[np.void]:
    return cloud_of(sample)


@pytest.fixture
def run(sample: Sample, table: NDArray[np.void], tmp_path: Path) -> Path:
    """The file of a run's poses, with its cloud beside it."""
    write_ply(tmp_path / "ride.ply", table)
    return write_poses(tmp_path / "ride.txt", sample)


def cloud_of(sample: Sample, run_from_map: Array = RUN_FROM_MAP, noise: float = 0.01) -> NDArray[np.void]:
    """Every second pixel of the keyframes, its distance off by a share."""
    rng, parts = np.random.default_rng(2), []
    v, u = (each.ravel() for each in np.mgrid[0:HEIGHT:PIXELS, 0:WIDTH:PIXELS])
    for map_from_body, picture in zip(sample.world_from_body[::STEP], sample.left[::STEP], strict=True):
        map_from_cam = map_from_body @ BODY_FROM_CAM0
        from_cam = points_seen(map_from_cam, np.column_stack([u, v]).astype(float)) - map_from_cam[:3, 3]
        points = map_from_cam[:3, 3] + from_cam * (1 + noise * rng.normal(size=(len(u), 1)))
        part = np.empty(len(u), WRITTEN)
        for axis, values in zip("xyz", (points @ run_from_map[:3, :3].T + run_from_map[:3, 3]).T / METRES, strict=True):
            part[axis] = values
        for colour in ("red", "green", "blue"):
            part[colour] = picture[v, u]
        parts.append(part)
    return np.concatenate(parts)


def write_ply(path: Path, table: NDArray[np.void], kind: str = "binary_little_endian") -> None:
    assert table.dtype.names
    properties = [f"property {NAMES[table.dtype[name].str[1:]]} {name}" for name in table.dtype.names]
    head = [
        "ply",
        f"format {kind} 1.0",
        "comment of a run",
        f"element vertex {len(table)}",
        *properties,
        "end_header\n",
    ]
    rows = table.tobytes()
    if kind == "ascii":
        rows = "".join(" ".join(str(value) for value in row) + "\n" for row in table.tolist()).encode()
    elif kind == "binary_big_endian":
        rows = table.astype(table.dtype.newbyteorder(">")).tobytes()
    path.write_bytes("\n".join(head).encode() + rows)


def write_poses(path: Path, sample: Sample, *, inverse: bool = False, body: bool = False) -> Path:
    lines = []
    for stamp, map_from_body in list(zip(sample.stamps_ns.tolist(), sample.world_from_body, strict=True))[::STEP]:
        run_from_it: Array = RUN_FROM_MAP @ map_from_body @ (np.eye(4) if body else BODY_FROM_CAM0)
        run_from_it[:3, 3] /= METRES
        run_from_it = se3_inverse(run_from_it) if inverse else run_from_it
        w, x, y, z = quat_wxyz_from_rotation(run_from_it[:3, :3])
        lines.append(" ".join(f"{value:.9f}" for value in (stamp / 1e9, *run_from_it[:3, 3], x, y, z, w)))
    path.write_text("\n".join(lines) + "\n")
    return path


def options(run: Path, scale: float | None = METRES, **said: str) -> RecordingOptions:
    return RecordingOptions(use=SensorSet.MONO, trajectory=OtherTrajectory(run, "mast3r", scale=scale, **said))


@pytest.mark.parametrize(("inverse", "body"), [(False, False), (True, True)])
def test_the_cloud_is_seen_as_the_pictures_are(
    sample: Sample, recording: Path, run: Path, inverse: bool, body: bool
) -> None:
    """Whatever the file of poses calls them; the stated noise of a depth is that of the points."""
    write_poses(run, sample, inverse=inverse, body=body)
    with options(run).open(recording) as (opened, indices):
        assert opened.sensor_set is SensorSet.RGBD
        assert indices.tolist() == list(range(0, FRAMES, STEP))
        depth_m, without = opened.read_frame(20).depth_m, opened.read_frame(21).depth_m
        part_m = opened.part(indices[10:12]).read_frame(0).depth_m
        said, sigma_px = opened.issues[-1].detail, opened.depth_sigma_px
    reading = f"poses of the {'body' if body else 'camera'}, {'pose-from-map' if inverse else 'map-from-pose'}, quaternions xyzw"
    assert reading in said
    assert "30 of 61 frames have none in ride.ply" in said
    assert depth_m is not None
    assert without is not None
    assert not without.any()
    np.testing.assert_array_equal(part_m, depth_m)
    v, u = np.nonzero(depth_m)
    assert len(v) > 0.8 * WIDTH * HEIGHT
    map_from_cam = sample.world_from_body[20] @ BODY_FROM_CAM0
    seen = (points_seen(map_from_cam, np.column_stack([u, v])) - map_from_cam[:3, 3]) @ map_from_cam[:3, :3]
    off = np.abs(depth_m[v, u] / seen[:, 2] - 1)
    assert np.percentile(off, 95) < 0.02
    assert off.max() < 0.2  # at the room's edges
    disparity_px = 200 * 0.08 / float(np.median(seen[:, 2]))
    assert sigma_px is not None
    assert 0.008 * disparity_px < sigma_px < 0.04 * disparity_px


def test_a_single_camera_is_surveyed_with_it_in_metres(sample: Sample, recording: Path, run: Path) -> None:
    chosen = BuildOptions(use=SensorSet.MONO, trajectory=OtherTrajectory(run, "mast3r", scale=METRES), threads=1)
    done = build_map(recording, run.parent / "maps", "hall", chosen)
    assert done.report["ate_rmse_m"] < 0.03
    assert done.report["keyframes"] > 5
    moved = np.ptp(done.trajectory.positions_m, axis=0).max()
    assert moved == pytest.approx(np.ptp(np.array(sample.world_from_body)[:, :3, 3], axis=0).max(), rel=0.02)
    assert any("depths of ride.ply: poses of the camera" in words for words in done.report["findings"]["ride"])


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("order", [["red", "z", "confidence", "y", "x", "blue", "green"], ["x", "y", "z"]])
def test_each_kind_and_order_of_file_is_read(
    table: NDArray[np.void], tmp_path: Path, kind: str, order: list[str]
) -> None:
    kinds = dict(WRITTEN) | {"confidence": "<f8", "y": "<f8"}
    foreign = np.zeros(500, [(name, kinds[name]) for name in order])
    for name in set(order) - {"confidence"}:
        foreign[name] = table[name][:500]
    write_ply(tmp_path / "p.ply", foreign, kind)
    cloud = read_ply(tmp_path / "p.ply")
    np.testing.assert_allclose(cloud.points, np.column_stack([table[axis][:500] for axis in "xyz"]), rtol=1e-6)
    assert (cloud.grey is None) == ("red" not in order)
    if cloud.grey is not None:
        np.testing.assert_allclose(cloud.grey, table["red"][:500], atol=1e-3)


def test_what_lies_behind_a_surface_does_not_show_through_it() -> None:
    """A dense wall at 4 m behind a thin one at 2 m; points behind the camera are not seen."""
    near = np.stack(np.meshgrid(np.arange(0, 20, 2), np.arange(20), indexing="xy"), axis=-1).reshape(-1, 2)
    far = np.stack(np.meshgrid(np.arange(0, 40, 0.25), np.arange(0, 20, 0.25), indexing="xy"), axis=-1).reshape(-1, 2)
    points = [
        np.column_stack([2 * near / 20, np.full(len(near), 2)]),
        np.column_stack([4 * far / 20, np.full(len(far), 4)]),
    ]
    cloud = Cloud(np.concatenate([*points, -points[1]]).astype(np.float32), None)
    inverse = sighting(cloud, np.eye(4), np.array([20.0, 20.0, 0.0, 0.0]), (20, 40)).inverse
    assert set(np.unique(inverse[:, :18]).tolist()) == {0.0, 0.5}
    assert np.unique(inverse[:, 22:]).tolist() == [0.25]


def test_the_cloud_of_another_recording_is_refused(recording: Path, run: Path) -> None:
    """Of the same room, in the frame of its own first camera."""
    other = ride_sample(out_and_back(3.5, yaw_rad=0.3), FRAMES, 0.1, begin_s=0.4)
    write_ply(run.with_suffix(".ply"), cloud_of(other, se3_inverse(other.world_from_body[0] @ BODY_FROM_CAM0)))
    with (
        pytest.raises(RecordingError, match=r"ride\.ply belongs to another recording: .* correlate"),
        options(run).open(recording),
    ):
        pass


def test_what_is_not_known_is_asked_for(recording: Path, run: Path, table: NDArray[np.void]) -> None:
    with pytest.raises(UsageError, match="--trajectory-scale"), options(run, None).open(recording):
        pass
    write_ply(run.with_suffix(".ply"), table[["x", "y", "z"]].astype([(axis, "<f4") for axis in "xyz"]))
    with (
        pytest.raises(UsageError, match=r"no colours .* --trajectory-frame .* --trajectory-direction"),
        options(run).open(recording),
    ):
        pass
    known = {"frame": "camera", "direction": "map-from-pose", "quaternion": "xyzw"}
    with options(run, METRES, **known).open(recording) as (opened, _):
        assert opened.sensor_set is SensorSet.RGBD
    run.with_suffix(".ply").unlink()
    with options(run, None).open(recording) as (opened, _):
        assert opened.sensor_set is SensorSet.MONO


def changed(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    return lambda content: content.replace(old, new, 1)


def with_nan(content: bytes) -> bytes:
    start = content.index(b"end_header\n") + 11 + 4 * 15
    return content[:start] + np.float32(np.nan).tobytes() + content[start + 4 :]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda _: b"", "no PLY header"),
        (lambda content: content[:40], "no PLY header"),
        (lambda content: content[:-1], r"points end after \d+ bytes, it has"),
        (lambda content: content + b"0", r"points end after \d+ bytes, it has"),
        (changed(b"comment", b"comment " + b"x" * 20000), "no PLY header within"),
        (changed(b"vertex 9", b"vertex 0"), "it holds 0 points"),
        (changed(b"vertex 9", b"vertex -9"), "it holds -9 points"),
        (changed(b"vertex 9", b"vertex 999999999"), "it holds 999999999 points"),
        (changed(b"vertex 9", b"vertex 40000000"), "points end after 600000"),
        (changed(b"vertex 9", b"vertex many"), "invalid literal"),
        (changed(b"vertex 9", b"face 9"), "its first element is not vertex"),
        (changed(b"binary_little_endian", b"zip"), "does not begin with a format"),
        (changed(b"property float x", b"property list uchar int x"), "'property list uchar int x' of its header"),
        (changed(b"property float x", b"property float w"), "w, y, z, red, green, blue; x, y and z are expected"),
        (changed(b"property float x", b"property float z"), "no cloud of points"),
        (changed(b"comment of", b"comment \xff"), "no cloud of points"),
        (changed(b"binary_little_endian", b"ascii"), "no cloud of points"),
        (with_nan, r"point 5 is at \[nan"),
    ],
)
def test_files_that_are_no_clouds_are_refused(
    recording: Path, run: Path, table: NDArray[np.void], change: Callable[[bytes], bytes], said: str
) -> None:
    file = run.with_suffix(".ply")
    write_ply(file, table[:9])
    file.write_bytes(change(file.read_bytes()))
    with pytest.raises(RecordingError, match=said), options(run).open(recording):
        pass


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("1 2 3\n", "1 lines for 2 points"),
        ("1 2 3\n4 5 6\n7 8 9\n", "more than 3 lines for 2 points"),
        ("1 2 3\n4 5\n", "no cloud of points"),
        ("1 2 3\n4 5 six\n", "no cloud of points"),
        ("1 2 3\n4 5 inf\n", "point 2 is at"),
    ],
)
def test_text_that_is_no_cloud_is_refused(tmp_path: Path, rows: str, said: str) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (tmp_path / "p.ply").write_text(head + rows)
    with pytest.raises(FleetmapError, match=said):
        read_ply(tmp_path / "p.ply")
