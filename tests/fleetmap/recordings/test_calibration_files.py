"""Calibration files: Kalibr's meaning, and writing that comes back bit for bit."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from fleetmap.errors import CalibrationError
from fleetmap.geometry import se3, se3_exp
from fleetmap.recordings import format_calibration, read_calibration
from fleetmap.recordings.calibration_files import camera_of, load_calibration, parse_calibration, read_yaml
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise, RigCalibration
from fleetmap.sensors.rectification import Rectifier
from support.recordings.realdata import real_data
from support.recordings.recording_samples import calibration, kalibr_text


def random_rig(seed: int, *, has_imu: bool) -> RigCalibration:
    rng = np.random.default_rng(seed)
    cameras = []
    for model, count, shape in (
        *(("equidistant", 4, ()), ("radial-tangential", 5, ()), ("radial-tangential", 8, ())),
        ("omni", 4, (rng.uniform(0, 2),)),
        ("eucm", 4, rng.uniform(0.1, 0.9, 2)),
        ("double-sphere", 4, rng.uniform(-0.2, 0.9, 2).clip(0)),
        ("double-sphere", 0, (0.0, 0.0, 0.0, 0.0, -0.17, 0.59)),
    ):
        lens = (
            np.array([400, 400, 320, 240]) + rng.standard_normal(4),
            np.append(0.1 * rng.standard_normal(count), shape),
        )
        mounting = se3_exp(rng.standard_normal(6)), float(rng.normal(0, 0.01))
        cameras.append(CameraCalibration(model, 640, 480, *lens, *mounting))
    noise = ImuNoise(*np.abs(rng.normal(0, 1e-3, 4)).tolist()) if has_imu else None
    return RigCalibration(tuple(cameras), noise, se3_exp(rng.standard_normal(6)))


@pytest.mark.parametrize("has_imu", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_what_is_written_comes_back_bit_for_bit(seed: int, has_imu: bool) -> None:
    rig = random_rig(seed, has_imu=has_imu)
    back = parse_calibration(format_calibration(rig), "text").calibration
    assert back.imu == rig.imu
    np.testing.assert_array_equal(back.base_from_body, rig.base_from_body)
    for a, b in zip(back.cameras, rig.cameras, strict=True):
        for name in CameraCalibration.__slots__:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_kalibrs_chain_and_topics(tmp_path: Path) -> None:
    file = tmp_path / "camchain.yaml"
    file.write_text(
        kalibr_text().replace("  rostopic: /cam0", "  timeshift_cam_imu: 0.0125\n  rostopic: /cam0")
        + "imu0: {gyroscope_noise_density: 1e-4, rostopic: /imu}\nbase_from_body: [[1, 0, 0, 0.2], "
        "[0, 1, 0, 0], [0, 0, 1, 0.3], [0, 0, 0, 1]]\n"
    )
    found = load_calibration(file)
    for ours, wanted in zip(found.calibration.cameras, calibration().cameras, strict=True):
        np.testing.assert_allclose(ours.body_from_cam, wanted.body_from_cam, atol=1e-12)
    assert [camera.imu_minus_cam_s for camera in found.calibration.cameras] == [0.0125, 0.0125]
    assert found.calibration.imu.gyro_noise_radps_rthz == 1e-4
    np.testing.assert_array_equal(found.calibration.base_from_body, se3(np.eye(3), np.array([0.2, 0, 0.3])))
    assert (found.topics["cam1"], found.topics["imu0"]) == ("/cam1/image_raw", "/imu")


def test_the_real_chain_agrees_with_itself() -> None:
    """TUM-VI's file gives cam1 twice, by T_cam_imu and by T_cn_cnm1 after cam0."""
    file = real_data("tumvi_room1_fisheye_8") / "camchain.yaml"
    both = read_calibration(file)
    text = file.read_text()
    without = text[: text.index("T_cam_imu", text.index("cam1:"))] + text[text.index("T_cn_cnm1") :]
    chained = parse_calibration(without, "without").calibration
    np.testing.assert_allclose(chained.cameras[1].body_from_cam, both.cameras[1].body_from_cam, atol=1e-6)
    assert both.cameras[0].model == "equidistant"
    assert both.imu.gyro_noise_radps_rthz == pytest.approx(0.00016)


def sphere_text(**changed: object) -> str:
    """Kalibr's double sphere, with values changed."""
    values = {
        "camera_model": "ds", "distortion_coeffs": [], "distortion_model": "none", "resolution": [1440, 1080],
        "intrinsics": [-0.1996, 0.5925, 317.55, 316.17, 724.86, 546.57],
    }  # fmt: skip
    return yaml.safe_dump({"cam0": values | changed})


def test_kalibrs_spheres() -> None:
    """The parameters of the shape stand before fx; distortion of the plane comes from its own key."""
    (camera,) = parse_calibration(sphere_text(), "text").calibration.cameras
    assert camera.model == "double-sphere"
    assert camera.intrinsics_px.tolist() == [317.55, 316.17, 724.86, 546.57]
    assert camera.distortion.tolist() == [0.0, 0.0, 0.0, 0.0, -0.1996, 0.5925]
    assert "distortion_model: none" in format_calibration(RigCalibration((camera,)))
    plane = {"distortion_model": "radtan", "distortion_coeffs": [-0.34, 0.13, 6e-4, 5e-4]}
    omni = sphere_text(camera_model="omni", intrinsics=[0.8, 833.0, 830.3, 373.9, 253.7], **plane)
    (camera,) = parse_calibration(omni, "text").calibration.cameras
    assert (camera.model, camera.distortion.tolist()) == ("omni", [-0.34, 0.13, 6e-4, 5e-4, 0.8])


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"camera_model": "sphere"}, "camera model sphere .* not known; .*omni with radtan, ds or eucm"),
        ({"intrinsics": [317.55, 316.17, 724.86, 546.57]}, r"intrinsics \(xi alpha fx fy cx cy\).* 6 numbers are"),
        ({"intrinsics": [317.55, 316.17, 724.86, 546.57, -0.2, 0.6]}, "xi of ds is 317.55, outside .*order"),
        ({"camera_model": "eucm"}, "alpha of eucm is -0.1996, outside of 0 to 1"),
        (
            {"distortion_model": "equidistant", "distortion_coeffs": [0.1, 0.0, 0.0, 0.0]},
            "ds with equidistant of 4 coefficients is not supported; calibrate it as ds with radtan",
        ),
    ],
)
def test_spheres_that_cannot_be_are_refused(changed: dict[str, Any], says: str) -> None:
    with pytest.raises(CalibrationError, match=f"text: cam0.*{says}"):
        parse_calibration(sphere_text(**changed), "text")


RATIONAL = [0.42, 0.03, 2e-4, -1e-4, 1e-3, 0.72, 0.14, 4e-3]


@pytest.mark.parametrize(
    ("model", "coefficients", "kept"),
    [
        ("radtan", [-0.28, 0.07, 2e-4, 1e-5], 4),
        ("radtan", [-0.28, 0.07, 2e-4, 1e-5, 0.0], 4),
        ("plumb_bob", [-0.28, 0.07, 2e-4, 1e-5, 0.01], 5),
        ("radtan", RATIONAL, 8),
        ("rational_polynomial", [*RATIONAL, *[0.0] * 4], 8),
        ("equidistant", [0.01, -0.02, 0.003, 1e-3], 4),
        ("fisheye", [0.01, -0.02, 0.003, 1e-3], 4),
        ("none", [], 0),
        ("radtan", [-0.28, 0.07, 2e-4], "3 distortion coefficients"),
        ("radtan", [*RATIONAL, 1e-3, 0.0, 0.0, 0.0], "thin prisms"),
        ("rational_polynomial", [*RATIONAL, *[0.0] * 4, 0.01, 0.0], "tilted sensors"),
        ("equidistant", [0.01] * 5, "5 distortion coefficients.* for equidistant"),
        ("fov", [0.9], "'fov' is not supported"),
        ("none", [-0.28, 0.07, 2e-4, 1e-5], "'none' is not supported"),
        (None, [], "distortion_model is missing.*distortion_model: none"),
        ("radtan", None, "distortion_coeff.* is missing"),
    ],
)
@pytest.mark.parametrize("layout", ["kalibr", "euroc", "ros"])
def test_lenses_of_every_layout(
    tmp_path: Path, layout: str, model: str | None, coefficients: list[float] | None, kept: int | str
) -> None:
    """A camera as Kalibr, EuRoC and ROS's camera_calibration write it; one coefficient more that is zero changes nothing."""
    matrix = {"rows": 3, "cols": 3, "data": [400.0, 0, 310, 0, 410, 230, 0, 0, 1]}
    values: dict[str, Any] = {"camera_model": "pinhole", "intrinsics": [400.0, 410, 310, 230], "resolution": [640, 480]}
    key = "distortion_coeffs" if layout == "kalibr" else "distortion_coefficients"
    given: Any = coefficients
    if layout == "ros":
        values = {"image_width": 640, "image_height": 480, "camera_name": "left", "camera_matrix": matrix}
        given = coefficients and {"rows": 1, "cols": len(coefficients), "data": coefficients}
    values |= {} if model is None else {"distortion_model": model}
    values |= {} if coefficients is None else {key: given or []}
    file = tmp_path / "camera.yaml"
    eye = {"rows": 4, "cols": 4, "data": np.eye(4).ravel().tolist()}
    file.write_text(yaml.safe_dump({"cam0": values} if layout == "kalibr" else {**values, "T_BS": eye}))

    def read(path: Path) -> CameraCalibration:
        return camera_of(read_yaml(path), key) if layout == "euroc" else read_calibration(path).cameras[0]

    if isinstance(kept, str):
        with pytest.raises(CalibrationError, match=kept):
            read(file)
        return
    camera = read(file)
    assert camera.distortion.tolist() == coefficients[:kept]
    assert camera.intrinsics_px.tolist() == [400, 410, 310, 230]


EYE3, EYE = np.eye(3).tolist(), np.eye(4).tolist()
LENS = yaml.safe_load("""
    {camera_model: pinhole, distortion_model: radtan, distortion_coeffs: [-0.28, 0.07, 2.0e-4, 1.0e-5],
    intrinsics: [400.0, 410.0, 310.0, 230.0], resolution: [640, 480]}""")
NOISE = yaml.safe_load("""
    {accelerometer_noise_density: 2.0e-3, accelerometer_random_walk: 3.0e-3, gyroscope_noise_density: 1.7e-4,
    gyroscope_random_walk: 1.9e-5}""")
MOUNTED = se3_exp(np.array([0.4, -1.2, 0.3, 0.1, -0.2, 0.05]))


class PlainDumper(yaml.SafeDumper):
    """Without aliases of values that occur twice."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def open_vins(folder: Path, **imu: object) -> Path:
    """A rig in the two files of OpenVINS, which begin as OpenCV's do; its keys of the IMU replaced by others."""
    cameras = {}
    for number, shift in enumerate((0.0, 0.11)):
        body_from_cam = MOUNTED @ se3(np.eye(3), np.array([shift, 0.0, 0.0]))
        cameras[f"cam{number}"] = {**LENS, "T_imu_cam": body_from_cam.tolist(), "cam_overlaps": [1 - number]}
    given = {**NOISE, "T_i_b": EYE, "model": "kalibr", "time_offset": 0.0, "update_rate": 200.0, "Tw": EYE3, "Ta": EYE3}
    given |= {"R_IMUtoGYRO": EYE3, "R_IMUtoACC": EYE3, "Tg": np.zeros((3, 3)).tolist(), **imu}
    (folder / "kalibr_imu_chain.yaml").write_text("%YAML:1.0\n\n" + yaml.dump({"imu0": given}, Dumper=PlainDumper))
    file = folder / "kalibr_imucam_chain.yaml"
    file.write_text("%YAML:1.0 # the file's type\n\n" + yaml.dump(cameras, Dumper=PlainDumper))
    return file


def test_the_chains_of_open_vins(tmp_path: Path) -> None:
    """T_imu_cam is the other direction than Kalibr's T_cam_imu; the IMU's noise is in a second file."""
    found = read_calibration(open_vins(tmp_path))
    np.testing.assert_allclose(found.cameras[0].body_from_cam, MOUNTED, atol=1e-12)
    assert Rectifier(found).camera.baseline_m == pytest.approx(0.11)
    assert found.imu.gyro_noise_radps_rthz == pytest.approx(1.7e-4)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("Tw", (1.02 * np.eye(3)).tolist()),
        ("Tg", (0.01 * np.eye(3)).tolist()),
        ("R_IMUtoACC", np.eye(3)[[1, 0, 2]].tolist()),
        ("T_i_b", MOUNTED.tolist()),
        ("time_offset", 0.02),
        ("accelerometers", {"M": (1.02 * np.eye(3)).tolist()}),
    ],
)
def test_what_an_imu_needs_besides_is_refused_by_its_key(tmp_path: Path, key: str, value: object) -> None:
    with pytest.raises(CalibrationError, match=f"{key}.* not supported; correct the samples"):
        read_calibration(open_vins(tmp_path, **{key: value}))


def rig(**changes: Any) -> str:
    """A pair with an IMU, keys of cam0 replaced, or taken out where they are None."""
    first = {key: value for key, value in {**LENS, "T_cam_imu": EYE, **changes}.items() if value is not None}
    beside = se3(np.eye(3), np.array([-0.1, 0, 0])).tolist()
    values = {"cam1": {**LENS, "T_cn_cnm1": beside}, "cam0": first, "imu0": NOISE}
    return yaml.dump(values, Dumper=PlainDumper, sort_keys=False)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (rig(T_cam_imu=None), "the mounting of the IMU is missing; add T_cam_imu"),
        (rig(distortion_coeffs=None), "distortion_coeffs is missing"),
        (rig(distortion_coeffs=None, distortion_coefficients=[0.1] * 4), "distortion_coeffs is missing.*coefficients"),
        (rig(intrinsics=None), "intrinsics is missing"),
        (rig(intrinsics=[400, True, 310, 230]), "are not numbers"),
        (rig(intrinsics=[400, 400, 310, 2300]), "principal point"),
        (rig(intrinsics=["400 px", 400, 310, 230]), "are not numbers"),
        (rig(intrinsics=[float("nan"), 400, 310, 230]), "4 numbers are expected"),
        (rig(resolution=None), "resolution is missing"),
        (rig(resolution=[640.5, 480]), "resolution is 640.5 x 480"),
        (rig(resolution=[0, 480]), "resolution is 0 x 480"),
        (rig(T_cam_imu=MOUNTED.T.tolist()), "it is transposed"),
        (rig(T_cam_imu=(MOUNTED @ np.diag([1.1, 1.1, 1.1, 1])).tolist()), "scaled by 1.1"),
        (rig(T_cam_imu=np.diag([1.0, 1, -1, 1]).tolist()), "it mirrors"),
        (rig(T_cam_imu=EYE[:3]), "is not a 4x4 matrix"),
        (rig(T_cam_imu={"rows": 2, "cols": 8, "data": np.eye(4).ravel().tolist()}), "is not a 4x4 matrix"),
        (rig(T_cam_imu=[[str(v) + " m" for v in row] for row in EYE]), "is not a 4x4 matrix"),
        (rig(T_cam_imu=MOUNTED.tolist(), T_imu_cam=MOUNTED.tolist()), "not the inverse of T_imu_cam"),
        (rig().replace("T_cn_cnm1", "T_cnm1_cn"), "cam1: neither T_cam_imu, T_imu_cam nor T_cn_cnm1"),
        (rig().replace("cam0:", "cam2:"), "cam0 is missing"),
        (rig().replace("imu0:", "cam0: {}\nimu0:"), "the key 'cam0' twice"),
        (rig().replace("resolution:", "\tresolution:"), "is not YAML"),
        (rig().replace("pinhole", "&a pinhole"), "aliases"),
    ],
)
def test_what_is_missing_or_wrong_is_named(text: str, says: str) -> None:
    with pytest.raises(CalibrationError, match=says):
        parse_calibration(text, "rig.yaml")


def test_a_file_that_opencv_writes(tmp_path: Path) -> None:
    """Matrices with their tag, the second camera first."""
    file = tmp_path / "rig.yaml"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for number in (1, 0):
        storage.startWriteStruct(f"cam{number}", cv2.FileNode_MAP)
        for key, text in (("camera_model", "pinhole"), ("distortion_model", "plumb_bob")):
            storage.write(key, text)
        for key, values in (("intrinsics", LENS["intrinsics"]), ("distortion_coeffs", [-0.28, 0.07, 2e-4, 1e-5, 0.01])):
            storage.write(key, np.array([values]))
        storage.write("resolution", np.array([[640.0, 480.0]]))
        storage.write("T_imu_cam", MOUNTED @ se3(np.eye(3), np.array([0.1 * number, 0, 0])))
        storage.endWriteStruct()
    storage.release()
    found = read_calibration(file)
    assert [len(camera.distortion) for camera in found.cameras] == [5, 5]
    np.testing.assert_allclose(found.cameras[0].body_from_cam, MOUNTED, atol=1e-9)
    assert Rectifier(found).camera.baseline_m == pytest.approx(0.1)
