"""Calibration files: Kalibr camchain, and the format that the project writes.

The form of `--calibration FILE` is Kalibr's camchain (cam0, cam1 with camera_model, intrinsics, distortion_model,
distortion_coeffs, resolution, T_cam_imu or T_cn_cnm1, timeshift_cam_imu), with these keys beside the cameras:

    imu0:                                  Kalibr's names, also accepted on the top level
      gyroscope_noise_density: 1.7e-4      rad/s/sqrt(Hz)
      gyroscope_random_walk: 1.9e-5        rad/s^2/sqrt(Hz)
      accelerometer_noise_density: 2.0e-3  m/s^2/sqrt(Hz)
      accelerometer_random_walk: 3.0e-3    m/s^3/sqrt(Hz)
    base_from_body: [[...], [...], [...], [...]]   4x4 rows, where the IMU sits on the robot

and in each camera

    mask: [[[0, 380], [639, 380], [639, 479], [0, 479]]]   polygons of pixels (u, v) that show the robot itself; one in another is a hole
    mask: robot.png                                        or an image of the camera's size beside the file, not 0 there
    has_depth: true                                        a depth camera beside a pair, with depth registered to these images

and `has_imu: false` for a rig described by its cameras alone, and inside a camera `body_from_cam` (4x4 rows), which
takes precedence over T_cam_imu: this project writes it, because inverting a matrix twice changes the
last bits.
"""

import reprlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from fleetmap.errors import CalibrationError, FleetmapError, RecordingError
from fleetmap.geometry import Array, se3_inverse
from fleetmap.recordings.files import read_text
from fleetmap.recordings.images import StoredImage, decode_grey
from fleetmap.recordings.limits import MAX_CALIBRATION_BYTES, MAX_IMAGE_BYTES
from fleetmap.sensors import calibration as rigs
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise, Polygon, RigCalibration, check_camera
from fleetmap.sensors.cameras import LENSES, PLANE, lens_of

_SAFE_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_MAX_WORD, _MAX_DEPTH, _MAX_EVENTS = 1000, 16, 80_000
_WORDS = reprlib.Repr()
_WORDS.maxlevel = 2
_NOISE_KEYS = {
    "gyro_noise_radps_rthz": "gyroscope_noise_density",
    "gyro_walk_radps2_rthz": "gyroscope_random_walk",
    "accel_noise_mps2_rthz": "accelerometer_noise_density",
    "accel_walk_mps3_rthz": "accelerometer_random_walk",
}
_MOUNTINGS = ("body_from_cam", "T_cam_imu", "T_imu_cam")
# IMU parameters of Kalibr and OpenVINS besides noise, and their neutral values
_IMU_INTRINSICS: dict[str, Any] = {
    **dict.fromkeys(("Tw", "Ta", "R_IMUtoGYRO", "R_IMUtoACC"), np.eye(3)),
    "T_i_b": np.eye(4),
    "Tg": np.zeros((3, 3)),
    "time_offset": 0.0,
}
_LARGEST_PX = 32_768
_MOST_CORNERS = 1000  # of a mask's polygons: those of 16 cameras are 64,000 values


class Section(dict[str, Any]):
    """A mapping in a file, whose values are checked where they are taken: CalibrationError with the place, the value and what to write.

    folder: of images of masks, None for a text without files.
    """

    def __init__(self, values: Mapping[str, Any], where: str, folder: Path | None = None) -> None:
        super().__init__(values)
        self.where, self.folder = where, folder

    def __missing__(self, key: str) -> Any:
        none = "; images without distortion have distortion_model: none" if key.startswith("distortion") else ""
        raise self.error(f"{key} is missing; it holds {', '.join(map(str, self))[:200]}{none}")

    def error(self, words: str) -> CalibrationError:
        """An error of this section."""
        return CalibrationError(f"{self.where}: {words}")

    def section(self, key: str) -> "Section":
        """The mapping in it."""
        if not isinstance(self[key], dict):
            mapping = "a mapping with camera_model, intrinsics, ... is expected"
            raise self.error(f"{key} is {_brief(self[key])}; {mapping}")
        return Section(self[key], f"{self.where}: {key}", self.folder)

    def numbers(self, key: str, count: int | None, names: str = "", default: Any = None) -> Array:
        """Finite numbers, (count,) unless None, in a list or in OpenCV's and ROS's {rows, cols, data}."""
        value = self[key] if default is None else self.get(key, default)
        data: Any = value.get("data") if isinstance(value, dict) else value
        key += f" ({names})" if names else ""
        try:
            if isinstance(data, str) or any(isinstance(each, bool) for each in data):
                raise ValueError
            numbers = np.array([float(each) for each in data], np.float64)  # YAML 1.1 reads 1e-5 as text
        except (TypeError, ValueError, OverflowError):
            raise self.error(f"{key}: {_brief(value)} are not numbers") from None
        if (count is not None and len(numbers) != count) or not np.isfinite(numbers).all():
            raise self.error(f"{key}: {_brief(value)}; {count or 'finite'} numbers are expected")
        return numbers

    def number(self, key: str, default: float) -> float:
        """One finite number."""
        return float(Section({key: [self.get(key, default)]}, self.where).numbers(key, 1)[0])

    def matrix(self, key: str) -> Array:
        """(4, 4) rigid transform from nested rows, 16 numbers or EuRoC's {rows, cols, data}."""
        value = self[key]
        data, shape = value, tuple[Any, ...]((4, 4))
        if isinstance(value, dict):
            data, shape = value.get("data"), (value.get("rows"), value.get("cols"))
        try:
            matrix = np.array(data, dtype=np.float64)
            if matrix.shape not in ((4, 4), (16,)) or shape != (4, 4):
                raise ValueError
            matrix = matrix.reshape(4, 4)
        except (TypeError, ValueError, OverflowError):
            raise self.error(f"{key}: {_brief(value)} is not a 4x4 matrix; write four rows of four") from None
        if fault := _fault_of(matrix):
            rows = np.round(matrix, 4).tolist()
            raise self.error(f"{key}: {rows} is not a rigid transform: {fault}; check its rows")
        return matrix


@dataclass(frozen=True, slots=True)
class CalibrationFile:
    """Calibration in a file, and the topics (`rostopic`) noted by Kalibr as cam0, cam1, imu0."""

    calibration: RigCalibration
    topics: Mapping[str, str]


def load_calibration(path: Path) -> CalibrationFile:
    """Load a Kalibr camchain with this module's extra keys.

    Kalibr's `imu*.yaml` or OpenVINS' `kalibr_imu_chain.yaml` beside a camchain that has no noise values is read too.
    CalibrationError for missing files and invalid values.
    """
    found = parse_calibration(_read(path), str(path), path.parent)
    if "imu" in found.calibration.assumed:
        for candidate in sorted([*path.parent.glob("imu*.yaml"), *path.parent.glob("kalibr_imu_chain.yaml")]):
            if noise := imu_noise(read_yaml(candidate)):
                rest = tuple(name for name in found.calibration.assumed if name != "imu")
                return replace(found, calibration=replace(found.calibration, imu=noise, assumed=rest))
    return found


def read_calibration(path: Path) -> RigCalibration:
    """Load only the calibration, as `load_calibration`."""
    return load_calibration(path).calibration


def calibration_files(path: Path) -> list[Path]:
    """Return a file of calibration and the images of its masks, for a recording's hash. Errors as of `read_yaml`."""
    values = read_yaml(path)
    masks = [part.get("mask") for part in (values, *values.values()) if isinstance(part, dict)]
    return [path, *(path.parent / mask for mask in masks if isinstance(mask, str))]


def parse_calibration(text: str, where: str, folder: Path | None = None) -> CalibrationFile:
    """Parse the text of a camchain; `where` names it in error messages. folder: of images of masks, None for a text without files."""
    file = Section(_parse_yaml(text, where), where, folder)
    if "camera_matrix" in file:
        return CalibrationFile(RigCalibration((_ros_camera(file),), assumed=("base_from_body",)), {})
    names = sorted((key for key in file if key[:3] == "cam" and key[3:].isdecimal()), key=lambda key: int(key[3:]))
    if not names:
        raise file.error(
            "no cam0 in it; the file must be a Kalibr camchain (cam0: camera_model, intrinsics, ...), or for a "
            "single camera ROS's camera_info file"
        )
    for number, name in enumerate(names):
        if name != f"cam{number}":
            raise file.error(f"cam{number} is missing, there is {', '.join(names)[:80]}; number cameras from cam0")
    noise = imu_noise(file)
    sections = [file.section(name) for name in names]
    is_mounted = any(key in sections[0] for key in _MOUNTINGS)
    has_imu = bool(file.get("has_imu", noise is not None or is_mounted))
    if has_imu and not is_mounted:
        raise file.error(
            "cam0: the mounting of the IMU is missing; add T_cam_imu (Kalibr's) or T_imu_cam (OpenVINS'), or take the "
            "IMU's noise out, to use the cameras alone"
        )
    cameras: list[CameraCalibration] = []
    for section in sections:
        previous = cameras[-1] if cameras else None
        camera = camera_of(section, "distortion_coeffs", _body_from_cam(section, previous))
        shift_s = section.number("timeshift_cam_imu", previous.imu_minus_cam_s if previous else 0.0)
        cameras.append(check_camera(replace(camera, imu_minus_cam_s=shift_s), section.where))
    if cameras[0].has_depth:
        raise file.error(
            "cam0: has_depth is for cameras beside the rig's first view; number a stereo pair cam0 and cam1. A depth camera "
            'without a pair needs no word here: its recording tells it, or [source] sensors = "rgbd"'
        )
    told = {"imu": noise or not has_imu, "base_from_body": "base_from_body" in file}
    base = file.matrix("base_from_body") if told["base_from_body"] else np.eye(4)
    imu = (noise or ImuNoise()) if has_imu else None
    noted = {name: file[name].get("rostopic") for name in (*names, "imu0") if isinstance(file.get(name), dict)}
    assumed = tuple(name for name, is_told in told.items() if not is_told)
    topics = {name: str(topic) for name, topic in noted.items() if topic}
    return CalibrationFile(RigCalibration(tuple(cameras), imu, base, assumed), topics)


def format_calibration(calibration: RigCalibration) -> str:
    """Format a calibration as YAML text, from which `parse_calibration` restores it bit for bit."""
    sections, imu = dict[str, Any](), calibration.imu
    for number, camera in enumerate(calibration.cameras):
        sphere = LENSES.get(camera.model)
        plane, shape = (camera.distortion[:PLANE], camera.distortion[PLANE:]) if sphere else (camera.distortion, ())
        plane = plane if plane.any() or not sphere else plane[:0]  # Kalibr has no ds and no eucm with distortion
        model = "equidistant" if camera.model == "equidistant" else "radtan"
        sections[f"cam{number}"] = {
            "camera_model": sphere.kalibr if sphere else "pinhole",
            "distortion_model": model if len(plane) else "none",
            "intrinsics": [*map(float, (*shape, *camera.intrinsics_px))],
            "distortion_coeffs": [*map(float, plane)],
            "resolution": [camera.width_px, camera.height_px],
            "timeshift_cam_imu": camera.imu_minus_cam_s,
            "line_delay": camera.line_delay_s or None,
            "has_depth": "true" if camera.has_depth else None,
            "mask": [[[float(u), float(v)] for u, v in polygon] for polygon in camera.mask] or None,
            "T_cam_imu": se3_inverse(camera.body_from_cam),
            "body_from_cam": camera.body_from_cam,
        }
    sections["has_imu"] = "false" if imu is None else None
    sections["imu0"] = None if imu is None else {key: getattr(imu, name) for name, key in _NOISE_KEYS.items()}
    sections["base_from_body"] = None if "base_from_body" in calibration.assumed else calibration.base_from_body
    return _mapping(sections)


def _mapping(values: Mapping[str, Any], indent: str = "") -> str:
    """Lines of YAML for the values that are not None, of matrices one for each row."""
    text = ""
    for key, value in values.items():
        if isinstance(value, dict):
            text += f"{indent}{key}:\n{_mapping(value, '  ')}"
        elif isinstance(value, np.ndarray):
            text += f"{indent}{key}:\n" + "".join(f"{indent}- {row}\n" for row in value.astype(np.float64).tolist())
        elif value is not None:
            text += f"{indent}{key}: {value}\n"
    return text


def read_yaml(path: Path) -> Section:
    """Read the mapping in a YAML file, with or without OpenCV's `%YAML:1.0` first line.

    CalibrationError for anything else.
    """
    return Section(_parse_yaml(_read(path), str(path)), str(path), path.parent)


def _fault_of(matrix: Array) -> str:
    """Reason why (4, 4) is not a rigid transform; empty if it is one."""
    if not np.isfinite(matrix).all():
        return "not all of it is finite"
    if not np.array_equal(matrix[3], [0, 0, 0, 1]):
        is_turned = np.array_equal(matrix[:, 3], [0, 0, 0, 1])
        return "it is transposed" if is_turned else "its last row is not 0 0 0 1"
    rotation, scale = matrix[:3, :3], float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
    if np.allclose(rotation @ rotation.T, np.eye(3), atol=2e-3):
        return "" if np.linalg.det(rotation) > 0 else "it mirrors, an axis has the wrong sign"
    if scale > 0 and np.allclose(rotation @ rotation.T, scale**2 * np.eye(3), atol=2e-3 * scale**2):
        return f"its rotation is scaled by {scale:.4g}"
    return "the rows of its rotation are not of unit length and at right angles"


def _ros_camera(values: Section) -> CameraCalibration:
    """The camera in a file of ROS's camera_calibration: for its raw images, not the rectified ones."""
    fx, _, cx, _, fy, cy, *_ = values.numbers("camera_matrix", 9).tolist()
    translated = {"camera_model": "pinhole", "intrinsics": [fx, fy, cx, cy]}
    translated["resolution"] = [values["image_width"], values["image_height"]]
    lens = {key: value for key, value in values.items() if key.startswith("distortion") and value is not None}
    return check_camera(camera_of(Section(translated | lens, values.where), "distortion_coefficients"), values.where)


def _body_from_cam(values: Section, previous: CameraCalibration | None) -> Array:
    if "body_from_cam" in values:
        return values.matrix("body_from_cam")
    mountings = []
    if "T_imu_cam" in values:  # OpenVINS: rotation from the camera to the IMU, position of the camera in the IMU
        mountings.append(values.matrix("T_imu_cam"))
    if "T_cam_imu" in values:
        mountings.append(se3_inverse(values.matrix("T_cam_imu")))
    if mountings:
        if not np.allclose(mountings[0], mountings[-1], atol=1e-3):
            raise values.error("T_cam_imu is not the inverse of T_imu_cam; keep the one that is right")
        return mountings[-1]
    if previous is None:
        return np.eye(4)
    if "T_cn_cnm1" not in values:
        raise values.error("neither T_cam_imu, T_imu_cam nor T_cn_cnm1 gives the pose of the camera; add one of them")
    return previous.body_from_cam @ se3_inverse(values.matrix("T_cn_cnm1"))


def camera_of(values: Section, distortion_key: str, body_from_cam: Array | None = None) -> CameraCalibration:
    """Return the camera in a section with Kalibr's names, its coefficients under `distortion_key`; not checked."""
    camera_model, name = str(values["camera_model"])[:80], str(values.get("distortion_model"))[:80]
    sphere_model = next((model for model, lens in LENSES.items() if lens.kalibr == camera_model.lower()), "")
    shape_names = tuple(LENSES[sphere_model].ranges) if sphere_model else ()
    if not sphere_model and camera_model.lower() != "pinhole":
        raise values.error(
            f"camera model {camera_model} with distortion {name} is not known; calibrate as pinhole with radtan, or "
            "a fisheye as pinhole with equidistant, omni with radtan, ds or eucm"
        )
    width, height = values.numbers("resolution", 2).tolist()
    if any(side != int(side) or not 0 < side <= _LARGEST_PX for side in (width, height)):
        raise values.error(f"resolution is {width:g} x {height:g}; write the images' width and height in pixels")
    order = " ".join((*shape_names, "fx fy cx cy"))
    shape, intrinsics = np.split(values.numbers("intrinsics", 4 + len(shape_names), order), [len(shape_names)])
    if values["distortion_model"] != "none":
        _ = values[distortion_key]
    model, distortion = lens_of(name, values.numbers(distortion_key, None, default=[]), values.where)
    if sphere_model:
        if model != "radial-tangential" or len(distortion) > PLANE:
            raise values.error(
                f"{camera_model} with {name} of {len(distortion)} coefficients is not supported; calibrate it as "
                f"{camera_model.lower()} with radtan of {PLANE}, or without"
            )
        model, distortion = sphere_model, np.concatenate([distortion, np.zeros(PLANE - len(distortion)), shape])
    delay_s = values.number("line_delay", 0.0)
    if not 0 <= delay_s * height < 1.0:
        rows = f"{delay_s * height:g} s for {height:g} rows"
        raise values.error(f"line_delay is {delay_s:g} s, {rows}; write the seconds from row to row")
    has_depth = values.get("has_depth", False)
    if not isinstance(has_depth, bool):
        raise values.error(f"has_depth is {_brief(has_depth)}; write true or false")
    size_px = int(width), int(height)
    lens = model, *size_px, intrinsics, distortion, np.eye(4) if body_from_cam is None else body_from_cam
    return CameraCalibration(*lens, line_delay_s=delay_s, mask=_mask(values, size_px), has_depth=has_depth)


def _mask(values: Section, size_px: tuple[int, int]) -> tuple[Polygon, ...]:
    value = values.get("mask", [])
    if isinstance(value, str):
        polygons = _outlines(values, value, size_px)
    else:
        try:
            polygons = tuple(tuple((float(u), float(v)) for u, v in polygon) for polygon in value)
        except (TypeError, ValueError):
            form = "write polygons [[[u, v], [u, v], [u, v]]] in pixels, or the name of a PNG"
            raise values.error(f"mask is {_brief(value)}; {form}") from None
    corners = np.array([corner for polygon in polygons for corner in polygon]).reshape(-1, 2)
    if len(corners) > _MOST_CORNERS:
        raise values.error(f"mask has {len(corners)} corners; the limit is {_MOST_CORNERS}, simplify its outline")
    if any(len(polygon) < 3 for polygon in polygons) or not (np.abs(corners) <= _LARGEST_PX).all():
        raise values.error(f"mask is {_brief(value)}; a polygon has three corners or more, near the image")
    for polygon in polygons:
        low, high = np.min(polygon, axis=0), np.max(polygon, axis=0)
        if (high < 0).any() or (low > np.array(size_px) - 1).any():
            where = f"the polygon from {low.tolist()} to {high.tolist()} lies outside of the {size_px[0]}x{size_px[1]} image"
            raise values.error(f"mask: {where}; is it for another resolution?")
    if rigs.hidden_pixels(polygons, size_px).all():
        raise values.error("mask hides the whole image; of an image as mask, 0 is what may be used")
    return polygons


def _outlines(values: Section, name: str, size_px: tuple[int, int]) -> tuple[Polygon, ...]:
    """The polygons around the pixels of an image that are not 0, to one pixel."""
    if values.folder is None or Path(name).is_absolute() or ".." in Path(name).parts:
        raise values.error(f"mask: {name[:80]!r} is not a file beside the calibration; write its polygons instead")
    file = values.folder / name
    try:
        if not file.is_file() or file.stat().st_size > MAX_IMAGE_BYTES:
            raise values.error(f"mask: {name} is not there, no file or too large for an image")
        stored = StoredImage("file", file.read_bytes(), str(file))
        width, height = decode_grey(stored).shape[::-1]  # within the limits of images
    except (OSError, RecordingError) as error:
        raise values.error(f"mask: {name} cannot be read: {error}") from error
    if (width, height) != size_px:
        raise values.error(f"mask: {name} is {width}x{height}, the camera's images are {size_px[0]}x{size_px[1]}")
    image = cv2.imdecode(np.frombuffer(stored.data, np.uint8), cv2.IMREAD_UNCHANGED)
    shown = np.atleast_3d(np.asarray(image))[:, :, :3].any(axis=2)
    areas = sum(cv2.connectedComponents(np.asarray(side, np.uint8))[0] for side in (shown, ~shown))
    if 3 * areas > _MOST_CORNERS:  # before their outlines are made: noise has millions
        raise values.error(f"mask: {name} has {areas} areas; the limit is {_MOST_CORNERS // 3}, simplify it")
    contours, _ = cv2.findContours(np.asarray(shown, np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    outlines = [_simplified(np.asarray(contour, np.int32).reshape(-1, 2)) for contour in contours]
    return tuple(tuple((float(u), float(v)) for u, v in outline) for outline in outlines)


def _simplified(contour: NDArray[np.int32]) -> NDArray[np.int32]:
    """A contour (N, 2) to one pixel; that of a thin line, which would vanish, as it is, with three corners or more."""
    fewer = cv2.approxPolyDP(contour, 1.0, closed=True).reshape(-1, 2)
    kept = fewer if len(fewer) > 2 else contour
    return np.concatenate([kept, np.repeat(kept[-1:], max(0, 3 - len(kept)), axis=0)])


def imu_noise(file: Section) -> ImuNoise | None:
    """Return the noise in a section, or in its imu0; None without one."""
    inner = file.get("imu0", file.get("imu", file))
    if not isinstance(inner, dict) or not any(key in inner for key in _NOISE_KEYS.values()):
        return None
    given = Section(inner, file.where)
    used = {name: given.number(key, 0.0) for name, key in _NOISE_KEYS.items() if key in given}
    unused = {key: (inner[key], neutral) for key, neutral in _IMU_INTRINSICS.items() if key in inner}
    scaled = [key for key in ("gyroscopes", "accelerometers") if isinstance(inner.get(key), dict)]
    for key, (value, neutral) in (unused | {f"{key}: M": (inner[key].get("M"), np.eye(3)) for key in scaled}).items():
        if not _is_near(value, neutral):
            raise given.error(
                f"{key} of the IMU is {_brief(value)}, which is not supported; correct the samples by it, and write "
                f"{np.asarray(neutral).tolist()}, or calibrate with --imu-models calibrated"
            )
    for name in (name for name, value in used.items() if not 0 < value < 10):
        raise given.error(f"{_NOISE_KEYS[name]} is {used[name]}; noise densities in SI units are small and positive")
    return ImuNoise(**used)


def _is_near(value: object, wanted: Any) -> bool:
    try:
        found = np.array(value, np.float64)
        return found.shape == np.shape(wanted) and bool(np.allclose(found, wanted, atol=1e-3))
    except (TypeError, ValueError):
        return False


class _RepeatedKeyError(ValueError):
    """A repeated key, which is the message."""


class _Loader(_SAFE_LOADER):  # type: ignore[misc]
    """Refuses repeated keys in a mapping; YAML's own loader takes the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        if repeated := [key for key, count in keys.items() if count > 1]:
            raise _RepeatedKeyError(_brief(repeated[0]))
        return dict(super().construct_mapping(node, deep))


def _brief(value: object) -> str:
    """A value of a file, in at most 80 characters."""
    return _WORDS.repr(value)[:80]


def _read(path: Path) -> str:
    expected = "a Kalibr camchain (YAML) is expected"
    return read_text(path, expected, most_bytes=MAX_CALIBRATION_BYTES, error_type=CalibrationError)


def _parse_yaml(text: str, where: str) -> dict[str, Any]:
    if len(text) > MAX_CALIBRATION_BYTES:
        raise CalibrationError(f"{where} has more than {MAX_CALIBRATION_BYTES} bytes; a calibration has a few thousand")
    lines = text.replace("!!opencv-matrix", "").splitlines()
    if lines and lines[0].startswith("%YAML"):
        lines[0] = ""
    plain = "\n".join(lines)
    try:
        check_yaml(plain, where)
        values = yaml.load(plain, Loader=_Loader)
    except _RepeatedKeyError as error:
        raise CalibrationError(f"{where} has the key {error} twice; keep the one that is right") from error
    # The loader's own constructors raise ValueError for 2026-02-30.
    except (yaml.YAMLError, ValueError) as error:
        mark, line = getattr(error, "problem_mark", None), ""
        if mark is not None:
            line = f" from line {mark.line + 1} on: {''.join(lines[mark.line : mark.line + 1])[:60]!r}"
        raise CalibrationError(f"{where} is not YAML{line}; is it cut off? Correct it, or copy it again") from error
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise CalibrationError(f"{where} holds {_brief(values)}; a calibration is a mapping of names to values")
    return values


def check_yaml(
    text: str, where: str, most_values: int = _MAX_EVENTS, error_type: type[FleetmapError] = CalibrationError
) -> None:
    """Raise error_type for YAML that no file of ours contains and that is expensive to load: aliases, tags, deep nesting, long scalars."""
    depth = 0
    for count, event in enumerate(yaml.parse(text, Loader=_SAFE_LOADER)):
        if count > most_values:
            raise error_type(f"{where} holds more than {most_values} values; check the file")
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise error_type(f"{where} uses YAML's aliases (& and *); write the values out")
        if (tag := getattr(event, "tag", None)) is not None:
            raise error_type(f"{where} uses the YAML tag {_brief(tag)}; write plain values")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _MAX_DEPTH:
            raise error_type(f"{where} is nested deeper than {_MAX_DEPTH} levels; check the file")
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > _MAX_WORD:
            raise error_type(f"{where} holds a value of {len(event.value)} characters; the limit is {_MAX_WORD}")
