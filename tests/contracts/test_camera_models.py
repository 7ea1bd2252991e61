"""What every entry of CAMERA_MODELS must do, measured against OpenCV, and the spheres against published calibrations."""

import cv2
import numpy as np
import pytest

from fleetmap.errors import CalibrationError
from fleetmap.geometry import Array
from fleetmap.sensors.calibration import CameraCalibration, check_camera
from fleetmap.sensors.cameras import CAMERA_MODELS

INTRINSICS = np.array([458.6, 457.3, 367.2, 248.4])
DISTORTIONS = {
    "radial-tangential": [
        np.zeros(0),
        np.array([-0.283, 0.074, 2e-4, 1.8e-5]),
        np.array([-0.1, 0.02, 1e-3, -5e-4, 0.003]),
        np.array([0.42, 0.03, 2e-4, -1e-4, 1e-3, 0.72, 0.14, 4e-3]),
    ],
    "equidistant": [np.array([0.0102, -0.0108, 0.0059, -0.0017])],
    "omni": [np.array([-0.3, 0.1, 5e-4, -3e-4, 0.8]), np.array([0.0, 0.0, 0.0, 0.0, 1.2])],
    "eucm": [np.array([0.0, 0.0, 0.0, 0.0, 0.6, 1.1]), np.array([0.01, -0.004, 2e-4, 1e-4, 0.4, 0.9])],
    "double-sphere": [np.array([0.0, 0.0, 0.0, 0.0, -0.17, 0.59]), np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.45])],
}
# Parameters with which a sphere is a pinhole: those of OpenCV's cases
PINHOLES = {"omni": [0.0], "eucm": [0.0, 1.0], "double-sphere": [0.0, 0.0]}
CASES = [(name, d) for name, ds in DISTORTIONS.items() for d in ds]


def opencv_pixels(model: str, distortion: Array, rays: Array) -> Array:
    matrix = np.array([[INTRINSICS[0], 0, INTRINSICS[2]], [0, INTRINSICS[1], INTRINSICS[3]], [0, 0, 1.0]])
    zero = np.zeros(3)
    if model == "equidistant":
        return cv2.fisheye.projectPoints(rays.reshape(-1, 1, 3), zero, zero, matrix, distortion)[0].reshape(-1, 2)
    return cv2.projectPoints(rays, zero, zero, matrix, distortion if len(distortion) else None)[0].reshape(-1, 2)


def test_every_model_has_a_case_of_counts_that_it_names() -> None:
    assert set(DISTORTIONS) == set(CAMERA_MODELS)
    assert all(len(distortion) in CAMERA_MODELS[model].distortion_counts for model, distortion in CASES)


@pytest.mark.parametrize(
    ("model", "distortion"),
    [(name, d) for name, d in CASES if name not in PINHOLES]
    + [(name, np.array([-0.283, 0.074, 2e-4, 1.8e-5, *shape])) for name, shape in PINHOLES.items()],
)
def test_pixels_are_opencvs(model: str, distortion: Array) -> None:
    rng = np.random.default_rng(1)
    rays = np.column_stack([rng.uniform(-0.7, 0.7, (200, 2)), np.ones(200)]) * rng.uniform(0.5, 20, (200, 1))
    ours = CAMERA_MODELS[model].pixel_from_ray(INTRINSICS, distortion, rays)
    theirs = opencv_pixels(model, distortion[: 4 if model in PINHOLES else None], rays)
    np.testing.assert_allclose(ours, theirs, atol=1e-6)


@pytest.mark.parametrize(("model", "distortion"), CASES)
def test_rays_of_pixels_come_back_to_their_pixels(model: str, distortion: Array) -> None:
    u, v = np.meshgrid(np.linspace(0, 751, 31), np.linspace(0, 479, 21))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = CAMERA_MODELS[model].ray_from_pixel(INTRINSICS, distortion, pixels)
    known = np.isfinite(rays).all(axis=1)
    assert known.mean() > 0.99
    np.testing.assert_allclose(np.linalg.norm(rays[known], axis=1), 1.0, atol=1e-12)
    back = CAMERA_MODELS[model].pixel_from_ray(INTRINSICS, distortion, rays[known])
    np.testing.assert_allclose(back, pixels[known], atol=1e-4)


@pytest.mark.parametrize(("model", "distortion"), CASES)
def test_the_direction_straight_back_has_no_pixel(model: str, distortion: Array) -> None:
    assert np.isnan(CAMERA_MODELS[model].pixel_from_ray(INTRINSICS, distortion, np.array([[0.0, 0.0, -1.0]]))).all()


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("equidistant", DISTORTIONS["equidistant"][0]),
        ("omni", np.array([-0.01, 0.001, 1e-4, -1e-4, 1.7])),
        ("eucm", DISTORTIONS["eucm"][0]),
        *(("double-sphere", d) for d in DISTORTIONS["double-sphere"]),
    ],
)
def test_fisheyes_see_190_degrees(model: str, distortion: Array) -> None:
    """Rays up to 95 degrees from the axis come back, the image grows with the angle, and beyond it says NaN instead of folding."""
    lens = CAMERA_MODELS[model]
    degrees, around = (grid.ravel() for grid in np.meshgrid(np.linspace(0.0, 179.5, 360), np.linspace(0, 6, 9)))
    angle, sine = np.radians(degrees), np.sin(np.radians(degrees))
    rays = np.column_stack([sine * np.cos(around), sine * np.sin(around), np.cos(angle)])
    pixels = lens.pixel_from_ray(INTRINSICS, distortion, 3.0 * rays)
    seen = np.isfinite(pixels).all(axis=1)
    assert seen[angle <= np.radians(95.0)].all()
    np.testing.assert_allclose(lens.ray_from_pixel(INTRINSICS, distortion, pixels[seen]), rays[seen], atol=1e-7)
    radius = np.where(seen, np.linalg.norm((pixels - INTRINSICS[2:]) / INTRINSICS[:2], axis=1), np.nan).reshape(9, -1)
    assert not (np.diff(radius, axis=1) <= 0).any()


@pytest.mark.parametrize(("model", "distortion"), CASES)
def test_the_focal_length_on_the_axis_is_that_of_the_image(model: str, distortion: Array) -> None:
    camera = CameraCalibration(model, 752, 480, INTRINSICS, distortion, np.eye(4))
    ray = np.array([[1e-6, 2e-6, 1.0]])
    moved_px = (camera.pixel_from_ray(ray) - INTRINSICS[2:])[0]
    np.testing.assert_allclose(moved_px, camera.focal_px * ray[0, :2], rtol=1e-5)


# Rays whose pixels other implementations compute
RAYS = np.array([[0.3, -0.2, 1.0], [1.5, 0.8, 0.4], [-0.6, 1.9, -0.1]])
KALIBR_OMNI = (
    *("omni", [833.006, 830.345, 373.85, 253.749]),
    [-0.33518750, 0.13211436, 0.00055967, 0.00057686, 0.80065662],
)
BASALT_EUCM = (
    "eucm",
    [460.76484651566468, 459.4051018049483, 365.8937161309615, 249.33499869752445],
    [0.0, 0.0, 0.0, 0.0, 0.5903365915227143, 1.127468196965374],
)


@pytest.mark.parametrize(
    ("lens", "pixels"),
    [
        (  # cv2.omnidir of opencv-contrib 4.14, with the camera in Kalibr's documentation
            KALIBR_OMNI,
            [[507.187156886379, 165.171267274263], [935.305238516696, 552.422244744432], [100.421168941737, 1120.349917687527]],
        ),
        (  # dscamera 0.0.4, TUM-VI's camera with its values rounded
            ("double-sphere", [158.286, 158.274, 254.96, 256.89], [0.0, 0.0, 0.0, 0.0, -0.17213, 0.59312]),
            [[310.04074467918, 220.172287406541], [480.982836764377, 377.426374127996], [162.779787404404, 548.771876686031]],
        ),
        (  # ds-msp 0.22.2, EuRoC's camera
            BASALT_EUCM,
            [[498.579006084704, 161.139180230073], [916.463459828434, 542.105654348906], [137.298893743069, 971.082378972423]],
        ),
    ],
)  # fmt: skip
def test_spheres_are_those_of_other_implementations(lens: tuple[str, Array, Array], pixels: list[list[float]]) -> None:
    model, intrinsics, distortion = lens
    ours = CAMERA_MODELS[model].pixel_from_ray(np.array(intrinsics), np.array(distortion), RAYS)
    np.testing.assert_allclose(ours, pixels, atol=1e-9)


@pytest.mark.parametrize(
    ("model", "shape", "says"),
    [
        ("omni", [-0.2], "xi of omni is -0.2, outside of 0 to inf"),
        ("double-sphere", [-1.3, 0.6], "xi of ds is -1.3, outside of -0.99 to 1"),
        ("double-sphere", [0.6, -0.2], "alpha of ds is -0.2, outside of 0 to 1"),
        ("eucm", [1.2, 1.0], "alpha of eucm is 1.2, outside of 0 to 1"),
        ("eucm", [0.6, -1.0], "beta of eucm is -1"),
        ("double-sphere", [380.0, 381.0], "xi of ds is 380"),
    ],
)
def test_parameters_that_no_sphere_has_are_refused_by_name(model: str, shape: list[float], says: str) -> None:
    camera = CameraCalibration(model, 752, 480, INTRINSICS, np.array([0.0, 0.0, 0.0, 0.0, *shape]), np.eye(4))
    with pytest.raises(CalibrationError, match=f"cam1: {says}"):
        check_camera(camera, "cam1")
