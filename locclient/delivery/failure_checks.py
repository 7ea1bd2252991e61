"""Validation of a decoded failure recording before use: robots write it, and a robot may be compromised.

ARRAYS lists every array by field name, or by class and field, with dtype, shape and a check of its values. Letters in a shape are
lengths shared by all arrays of one object.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import Enum
from itertools import pairwise
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from fleetmap.config import Section
from fleetmap.errors import RecordingError
from fleetmap.geometry import AnyArray
from fleetmap.sensors.rectification import StereoCamera
from locclient.localization.perception import QueryInput

MAX_ROWS = 10_000  # of an array, and members of a list
_MAX_INT, _MAX_SETTING, _MAX_SIDE_PX = 1 << 62, 1_000_000, 10_000
_ANGLE_TOLERANCE, _COVARIANCE_TOLERANCE = 1e-3, 1e-6
_MEMBERS = "__struct_fields__", "__dataclass_fields__", "_fields"  # of a struct, a dataclass, a named tuple
_MAY_BE_INFINITE = ("imu_minus_cam_sigma_s", "scene_depth_m", "sigma_m")  # the last one of a ride


class Kind(NamedTuple):
    """Required dtype and shape of an array. is_good: check of its values, given the camera."""

    dtype: str
    shape: tuple[int | str, ...]
    is_good: Callable[[AnyArray, StereoCamera], bool] = lambda *_: True


def _finite(values: AnyArray, _: StereoCamera) -> bool:
    return bool(np.isfinite(values).all())


def _rigid(target_from_source: AnyArray, _: StereoCamera) -> bool:
    if not np.isfinite(target_from_source).all() or np.abs(target_from_source).max() > 1e7:
        return False
    rotation = target_from_source[:3, :3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=_ANGLE_TOLERANCE) and np.linalg.det(rotation) > 0
    return bool(is_rotation and np.array_equal(target_from_source[3], [0.0, 0.0, 0.0, 1.0]))


def _covariance(matrix: AnyArray, _: StereoCamera) -> bool:
    if not np.isfinite(matrix).all():
        return False
    tolerance = _COVARIANCE_TOLERANCE * max(float(np.abs(matrix).max()), 1e-12)
    return bool(np.abs(matrix - matrix.T).max() <= tolerance and np.linalg.eigvalsh(matrix)[0] >= -tolerance)


def _prior_covariance(matrix: AnyArray, camera: StereoCamera) -> bool:
    """Check the covariance of a position prior; infinite variances are unconstrained axes."""
    known = np.isfinite(np.diagonal(matrix))
    is_good = not known.any() or _covariance(matrix[np.ix_(known, known)], camera)
    return is_good and not np.isnan(matrix).any()


def _within(pixels: AnyArray, camera: StereoCamera) -> bool:
    return bool(np.all((pixels > -1) & (pixels < (camera.width_px + 1, camera.height_px + 1))))


def _stereo_pixels(pixels: AnyArray, camera: StereoCamera) -> bool:
    right_px = pixels[:, 2]
    is_column = np.isnan(right_px) | (np.abs(right_px) <= 2 * camera.width_px)
    return _within(pixels[:, :2], camera) and bool(np.all(is_column))


_COVARIANCE = Kind("<f8", (6, 6), _covariance)
_TRANSFORMS = (
    "body_from_cam base_from_body body_from_now odom_from_body previous_from_body new_odom_from_old_odom "
    "map_from_body map_from_base cam_from_previous"
)
ARRAYS: Mapping[str, Kind] = {
    **dict.fromkeys(_TRANSFORMS.split(), Kind("<f8", (4, 4), _rigid)),
    **dict.fromkeys(("cov_rot_trans", "cov_bias_cam"), _COVARIANCE),
    **dict.fromkeys(("velocity_odom_mps", "gyro_bias_radps", "accel_bias_mps2"), Kind("<f8", (3,), _finite)),
    "PositionPrior.cov_rot_trans": _COVARIANCE._replace(is_good=_prior_covariance),
    "Features.pixels": Kind("<f8", ("n", 2), _within),
    "Features.octaves": Kind("|i1", ("n",), lambda octaves, _: bool(np.all((octaves >= 0) & (octaves < 32)))),
    "Features.angles_deg": Kind("<f4", ("n",), _finite),
    "Features.descriptors": Kind("|u1", ("n", 32)),
    "FrameFeatures.pixels": Kind("<f8", ("n", 3), _stereo_pixels),
    "clearance_px": Kind("|u1", ("h", "w"), lambda px, camera: px.shape == (camera.height_px, camera.width_px)),
    "track_ids": Kind("<i8", (0,)),  # of the odometry; recordings do not keep its tracks
}


def check_record(record: Any) -> None:
    """Raise RecordingError, naming the field, for an invalid LocalizerRecord."""
    cameras = [record.camera, *(mounted.camera for mounted in record.others)]
    for camera in cameras:
        sizes = camera.width_px, camera.height_px
        numbers = camera.focal_px, camera.cx_px, camera.cy_px, camera.baseline_m
        is_image = all(1 <= side <= _MAX_SIDE_PX for side in sizes)
        is_lens = all(abs(number) < 1e5 for number in numbers) and camera.focal_px > 0 and 0 <= camera.baseline_m < 10
        if not (is_image and is_lens):
            raise _refused("camera", f"{sizes[0]}x{sizes[1]} px, focal length, centre and baseline {numbers}")
    _Walk(cameras).check(record, "")
    stamps = [percept.odometry.stamp_ns for _, percept in record.frames]
    if any(later <= earlier for earlier, later in pairwise(stamps)):
        raise _refused("frames", "stamps that do not increase")
    for place, (_, percept) in enumerate(record.frames):
        if (query := percept.query) is None:
            continue
        if not 0 <= query.slices <= MAX_ROWS:
            raise _refused(f"frames[{place}].query.slices", f"{query.slices} of them")
        found = query.features
        if found is not None and (found.frame is not None or found.is_tried is not None):
            raise _refused(f"frames[{place}].query", "features with images")
        if found is not None and len(found.pixels) != len(found.features):
            raise _refused(f"frames[{place}].query", f"{len(found.pixels)} pixels of {len(found.features)} features")
    if (record.start.map_from_body is None) != (record.start.cov_rot_trans is None):
        raise _refused("start", "a pose without its covariance, or the other way round")


def _refused(where: str, what: str) -> RecordingError:
    return RecordingError(f"{where}: {what}; no robot writes that; Foxglove opens the recording")


class _Walk:
    """Traverses all values of a record; cameras: of each view. Pixels are within the image of the camera that comes last before them, in a
    query that of its view."""

    def __init__(self, cameras: Sequence[StereoCamera]) -> None:
        self._cameras, self._camera = cameras, cameras[0]

    def check(self, value: Any, where: str) -> None:
        if (names := next((getattr(value, kind) for kind in _MEMBERS if hasattr(value, kind)), None)) is not None:
            self._members(value, names, where)
        elif isinstance(value, Mapping | list | tuple):
            if len(value) > MAX_ROWS:
                raise _refused(where, f"{len(value)} of them, at most {MAX_ROWS} are read")
            for place, each in enumerate(value.items() if isinstance(value, Mapping) else value):
                self.check(each, f"{where}[{place}]")
        elif not (
            isinstance(value, bool | str | Enum | None)
            or (isinstance(value, int) and abs(value) <= _MAX_INT)
            or (isinstance(value, float) and (isfinite(value) or where.rpartition(".")[2] in _MAY_BE_INFINITE))
        ):
            raise _refused(where, f"{value!r:.80}")

    def _members(self, value: Any, names: Iterable[str], where: str) -> None:
        lengths: dict[str, int] = {}
        if isinstance(value, StereoCamera):
            self._camera = value
        elif isinstance(value, QueryInput):
            if not 0 <= value.view < len(self._cameras):
                raise _refused(f"{where}.view", f"{value.view} of a rig of {len(self._cameras)} cameras")
            self._camera = self._cameras[value.view]
        for name in names:
            member, at = getattr(value, name), f"{where}.{name}".lstrip(".")
            if isinstance(value, Section) and isinstance(member, int | float) and name != "seed":
                is_share = name.endswith("_share")  # by default all of them lie in between
                if not (isfinite(member) and abs(member) <= _MAX_SETTING) or (is_share and not 0 < member < 1):
                    raise _refused(at, f"{member}")
            if isinstance(member, np.ndarray):
                self._array(member, ARRAYS.get(f"{type(value).__name__}.{name}") or ARRAYS.get(name), at, lengths)
            else:
                self.check(member, at)

    def _array(self, array: AnyArray, kind: Kind | None, where: str, lengths: dict[str, int]) -> None:
        if kind is None:
            raise _refused(where, "an array where none belongs")
        expected = tuple(
            lengths.setdefault(size, length) if isinstance(size, str) else size
            for size, length in zip(kind.shape, array.shape, strict=False)
        )
        if array.dtype.str != kind.dtype or len(array.shape) != len(kind.shape) or array.shape != expected:
            raise _refused(
                where, f"an array {array.shape} of {array.dtype}, where {kind.shape} of {kind.dtype} belongs"
            )
        if max(array.shape) > MAX_ROWS or not kind.is_good(array, self._camera):
            raise _refused(where, f"values that cannot be, of shape {array.shape}")
