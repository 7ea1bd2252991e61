"""Calibration files: Kalibr's meaning, and writing that comes back bit for bit."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from fleetmap.errors import CalibrationError
from fleetmap.geometry import se3, se3_exp
from fleetmap.recordings import format_calibration, read_calibration
from fleetmap.recordings.calibration_files import load_calibration, parse_calibration, read_euroc_camera
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise, RigCalibration
from support.recordings.realdata import real_data
from support.recordings.recording_samples import calibration, kalibr_text


def random_rig(seed: int, *, has_imu: bool) -> RigCalibration:
    rng = np.random.default_rng(seed)
    cameras = tuple(
        CameraCalibration(
            model,
            640,
            480,
            np.array([400, 400, 320, 240]) + rng.standard_normal(4),
            0.1 * rng.standard_normal(count),
            se3_exp(rng.standard_normal(6)),
            float(rng.normal(0, 0.01)),
        )
        for model, count in (("equidistant", 4), ("radial-tangential", 5), ("radial-tangential", 8))
    )
    noise = ImuNoise(*np.abs(rng.normal(0, 1e-3, 4)).tolist()) if has_imu else None
    return RigCalibration(cameras, noise, se3_exp(rng.standard_normal(6)))


@pytest.mark.parametrize("has_imu", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_what_is_written_comes_back_bit_for_bit(seed: int, has_imu: bool) -> None:
    rig = random_rig(seed, has_imu=has_imu)
    back = parse_calibration(format_calibration(rig), "text").calibration
    assert back.imu == rig.imu
    np.testing.assert_array_equal(back.base_from_body, rig.base_from_body)
    for a, b in zip(back.cameras, rig.cameras, strict=True):
        assert (a.model, a.width_px, a.height_px, a.imu_minus_cam_s) == (
            b.model,
            b.width_px,
            b.height_px,
            b.imu_minus_cam_s,
        )
        np.testing.assert_array_equal(a.intrinsics_px, b.intrinsics_px)
        np.testing.assert_array_equal(a.distortion, b.distortion)
        np.testing.assert_array_equal(a.body_from_cam, b.body_from_cam)


def test_kalibrs_chain_and_topics(tmp_path: Path) -> None:
    file = tmp_path / "camchain.yaml"
    file.write_text(
        kalibr_text() + "imu0: {gyroscope_noise_density: 1e-4, rostopic: /imu}\nbase_from_body: [[1, 0, 0, 0.2], "
        "[0, 1, 0, 0], [0, 0, 1, 0.3], [0, 0, 0, 1]]\n"
    )
    found = load_calibration(file)
    for ours, wanted in zip(found.calibration.cameras, calibration().cameras, strict=True):
        np.testing.assert_allclose(ours.body_from_cam, wanted.body_from_cam, atol=1e-12)
    assert found.calibration.imu is not None
    assert found.calibration.imu.gyro_noise_radps_rthz == 1e-4
    np.testing.assert_array_equal(found.calibration.base_from_body, se3(np.eye(3), np.array([0.2, 0, 0.3])))
    assert (found.topics["cam1"], found.topics["imu0"]) == ("/cam1/image_raw", "/imu")


def test_time_shift_is_kalibrs(tmp_path: Path) -> None:
    file = tmp_path / "camchain.yaml"
    file.write_text(kalibr_text().replace("  rostopic: /cam0", "  timeshift_cam_imu: 0.0125\n  rostopic: /cam0"))
    assert [camera.imu_minus_cam_s for camera in read_calibration(file).cameras] == [0.0125, 0.0125]


def test_the_real_chain_agrees_with_itself() -> None:
    """TUM-VI's file gives cam1 twice, by T_cam_imu and by T_cn_cnm1 after cam0."""
    file = real_data("tumvi_room1_fisheye_8") / "camchain.yaml"
    both = read_calibration(file)
    text = file.read_text()
    start = text.index("T_cam_imu", text.index("cam1:"))
    without = text[:start] + text[text.index("T_cn_cnm1") :]
    chained = parse_calibration(without, "without").calibration
    np.testing.assert_allclose(chained.cameras[1].body_from_cam, both.cameras[1].body_from_cam, atol=1e-6)
    assert both.cameras[0].model == "equidistant"
    assert both.imu is not None
    assert both.imu.gyro_noise_radps_rthz == pytest.approx(0.00016)


def test_the_real_euroc_camera() -> None:
    camera = read_euroc_camera(real_data("euroc_v101_keyframes") / "mav0/cam0/sensor.yaml")
    assert camera.body_from_cam[0, 3] == -0.0216401454975
    assert camera.intrinsics_px.tolist() == [458.654, 457.296, 367.215, 248.375]


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
    values: dict[str, Any] = {
        "camera_model": "pinhole",
        "intrinsics": [400.0, 410, 310, 230],
        "resolution": [640, 480],
    }
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
    read = read_euroc_camera if layout == "euroc" else lambda path: read_calibration(path).cameras[0]
    if isinstance(kept, str):
        with pytest.raises(CalibrationError, match=kept):
            read(file)
        return
    camera = read(file)
    assert coefficients is not None
    assert camera.distortion.tolist() == coefficients[:kept]
    assert camera.intrinsics_px.tolist() == [400, 410, 310, 230]
