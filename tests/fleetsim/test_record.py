"""The commands: recordings that open, faults in the pictures, equal bytes for equal seeds."""

import hashlib
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fleetmap.errors import UsageError
from fleetmap.geometry import rotation_angle_rad, se3_inverse
from fleetmap.recordings import open_recording
from fleetmap.sensors.samples import SensorSet
from fleetsim.cli import app
from fleetsim.recorder import Order, prepare
from fleetsim.scenarios import SCENARIOS
from fleetsim.sensors import Fault, HiddenErrors

SIZE = ["--size", "160x120"]


def _run(*arguments: str) -> str:
    result = CliRunner().invoke(app, list(arguments))
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def _record(folder: Path, *arguments: str) -> Path:
    out = folder / "clip.mcap"
    _run("record", "clip", "--out", str(out), "--frames", "6", *SIZE, *arguments)
    return out


def test_scenarios_come_smallest_first() -> None:
    names = [line.split()[0] for line in _run("scenarios").splitlines()]
    assert names == list(SCENARIOS)
    sizes = [SCENARIOS[name]().layout.length_m * SCENARIOS[name]().layout.width_m for name in names]
    assert sizes == sorted(sizes)


def test_an_mcap_recording_opens_with_everything_in_it(tmp_path: Path) -> None:
    recording = open_recording(_record(tmp_path, "--robot", "tote-1"))
    assert recording.sensor_set is SensorSet.STEREO_INERTIAL
    assert len(recording.frame_stamps_ns) == 6
    assert recording.issues == ()
    assert len(recording.priors) == 1
    assert len(recording.wheel) > 10
    assert recording.calibration.base_from_body[2, 3] == 0.25
    truth = recording.ground_truth
    for index, stamp_ns in enumerate(recording.frame_stamps_ns.tolist()):
        assert truth.at(stamp_ns) is not None
        frame = recording.read_frame(index)
        assert frame.left.shape == (120, 160)
        assert frame.right is not None
        assert 20 < frame.left.mean() < 200
        assert not np.array_equal(frame.left, frame.right)
    assert recording.imu.stamps_ns[0] <= recording.frame_stamps_ns[0]
    assert recording.imu.stamps_ns[-1] >= recording.frame_stamps_ns[-1]


def test_equal_seeds_give_equal_bytes_and_others_do_not(tmp_path: Path) -> None:
    digests = []
    for number, arguments in enumerate(([], [], ["--seed", "1"], ["--light", "night"])):
        (tmp_path / str(number)).mkdir()
        digests.append(hashlib.sha256(_record(tmp_path / str(number), *arguments).read_bytes()).hexdigest())
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3


def test_hidden_errors_are_in_the_pictures_and_not_in_the_calibration(tmp_path: Path) -> None:
    plain, hidden = Order("clip"), Order("clip", hidden=HiddenErrors(0.02, 0.01, 0.005))
    one, other = prepare(plain), prepare(hidden)
    with closing(one.renderer), closing(other.renderer):
        for camera, same in zip(one.nominal.cameras, other.nominal.cameras, strict=True):
            np.testing.assert_array_equal(camera.body_from_cam, same.body_from_cam)
        for number in range(2):
            true_from_believed = se3_inverse(other.renderer.path(number)(1.0)) @ one.renderer.path(number)(1.0)
            assert rotation_angle_rad(true_from_believed[:3, :3]) == pytest.approx(0.01)
            assert np.linalg.norm(true_from_believed[:3, 3]) == pytest.approx(0.005)
        early = np.array(one.frame_stamps_ns()) - np.array(other.frame_stamps_ns())
        assert (early == 20_000_000).all()
        np.testing.assert_array_equal(one.imu.stamps_ns, other.imu.stamps_ns)
    folder = tmp_path / "hidden"
    folder.mkdir()
    arguments = ["--camera-delay-ms", "20", "--camera-turn-deg", "0.5", "--camera-shift-mm", "5"]
    spoiled, true = open_recording(_record(folder, *arguments)), open_recording(_record(tmp_path))
    assert (true.frame_stamps_ns - spoiled.frame_stamps_ns == 20_000_000).all()
    assert spoiled.calibration.cameras[0].imu_minus_cam_s == 0.0
    assert not np.array_equal(spoiled.read_frame(2).left, true.read_frame(2).left)


def test_camera_faults_are_in_the_pictures() -> None:
    faults = (
        Fault("camera-dark", 0.5, 0.6), Fault("camera-frozen", 0.7, 0.9), Fault("over-exposure", 1.0, 1.1),
        Fault("person-in-front", 1.2, 1.3), Fault("frames-dropped", 1.4, 1.5), Fault("frames-late", 1.6, 1.7),
    )  # fmt: skip
    session = prepare(Order("clip", size_px=(160, 120), faults=faults))
    with closing(session.renderer):
        shoot = session.renderer.shoot
        plain, dark, glare = (shoot(time_s)[0].image.mean() for time_s in (0.45, 0.55, 1.05))
        assert dark < 0.2 * plain
        assert glare > 1.7 * plain
        (_, before), (left, first), (later, second) = shoot(0.65), shoot(0.75), shoot(0.85)
        assert np.array_equal(before.image, first.image)
        assert np.array_equal(first.image, second.image)
        assert not np.array_equal(left.image, later.image)
        assert 0.3 < np.median(shoot(1.25)[0].depth_m[40:110, 60:100]) < 0.9
        assert not any(1.4 <= time_s < 1.5 for time_s in session.frame_times_s)
        stamps, regular = np.array(session.frame_stamps_ns()), np.array(session.frame_times_s)
        lateness = (stamps - stamps[0]) * 1e-9 - regular
        late = (regular >= 1.6) & (regular < 1.7)
        assert late.any()
        assert lateness[late] == pytest.approx(0.05, abs=1e-6)
        assert lateness[~late] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("order", "words"),
    [
        (Order("moon"), "unknown scenario 'moon'; known are clip"),
        (Order("clip", light="dusk"), "unknown light 'dusk'; known are day"),
        (Order("clip", robot="r2"), "unknown robot 'r2'.*survey"),
        (Order("clip", lens="fish"), "unknown lens 'fish'; known are pinhole"),
        (Order("clip", day=-1), "day -1"),
        (Order("clip", camera_pipeline="polaroid"), "unknown camera pipeline 'polaroid'; known are clean, soft"),
    ],
)
def test_nonsense_orders_are_refused(order: Order, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        prepare(order)


def test_an_existing_file_is_kept(tmp_path: Path) -> None:
    out = tmp_path / "there.mcap"
    out.write_bytes(b"precious")
    with pytest.raises(UsageError, match="exists already"):
        _run("record", "clip", "--out", str(out))
    assert out.read_bytes() == b"precious"
