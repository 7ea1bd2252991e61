"""Visual markers, ArUco or AprilTag: their list with poses in `map`, and their poses in a camera's image.

A marker's frame has its origin in the middle, x to the right and y up as it is read, z towards the reader.
"""

from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.encoding import decode_json
from fleetmap.errors import UsageError, chosen, disk_errors
from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.messages import Placement
from fleetmap.sensors.rectification import StereoCamera

CORNER_SIGMA_PX = 0.4  # of a corner in a rectified image, in each direction
_ADVICE = "write a list as docs/markers.md shows it, or have the map server measure one"


class Marker(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A marker in `map`: number, length of a side of its black square, and pose with the sigma of its position."""

    id: Annotated[int, msgspec.Meta(ge=0, le=10_000)]
    size_m: Annotated[float, msgspec.Meta(gt=0, le=10)]
    map_from_marker: Placement
    sigma_m: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.02


class MarkerList(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The markers of a site. dictionary: OpenCV's name without DICT_."""

    markers: tuple[Marker, ...]
    dictionary: str = "APRILTAG_36h11"

    @property
    def by_id(self) -> dict[int, Marker]:
        return {marker.id: marker for marker in self.markers}


def read_markers(path: Path) -> MarkerList:
    """Read a list (JSON); UsageError that names the fault."""
    with disk_errors(f"the list of markers {path} cannot be read", "", UsageError):
        data = path.read_bytes()
    listed = decode_json(data, MarkerList, f"{path} is no list of markers ({{}}); {_ADVICE}", UsageError)
    for marker in listed.markers:
        numbers = np.array([*marker.map_from_marker.position_m, *marker.map_from_marker.quat_wxyz])
        if not np.isfinite(numbers).all() or not 0.99 < np.linalg.norm(numbers[3:]) < 1.01:
            raise UsageError(f"{path}: marker {marker.id} has no finite position and unit quaternion; {_ADVICE}")
    if len(listed.by_id) < len(listed.markers):
        raise UsageError(f"{path} names a marker twice; leave out one of them")
    detector_of(listed.dictionary)
    return listed


def detector_of(dictionary: str) -> cv2.aruco.ArucoDetector:
    """Return OpenCV's detector with corners refined below a pixel; UsageError for an unknown dictionary."""
    known = {name.removeprefix("DICT_"): number for name, number in vars(cv2.aruco).items() if name.startswith("DICT_")}
    number: int = chosen("dictionary of markers", dictionary, known)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(number), parameters)


def corners_of(image: NDArray[np.uint8], detector: cv2.aruco.ArucoDetector) -> dict[int, Array]:
    """Return the corners (4, 2) of the markers in an image by their numbers, from the top left, clockwise as they are read; none of a
    number that is seen twice: one of them is not the listed one."""
    corners, ids, _ = detector.detectMarkers(image)
    numbers: list[int] = [] if ids is None else [int(number) for number in ids.ravel()]
    found = zip(numbers, corners, strict=True)
    return {number: quad.reshape(4, 2).astype(float) for number, quad in found if numbers.count(number) == 1}


def poses_of(corners: Array, size_m: float, camera: StereoCamera) -> list[tuple[Array, float]]:
    """Return cam_from_marker (4, 4) by a marker's corners (4, 2), and how likely it is; the likelier first. A small or distant marker looks
    nearly the same from two sides. Source: Collins and Bartoli 2014 (IPPE)."""
    half = size_m / 2
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    _, turns, shifts, errors = cv2.solvePnPGeneric(
        square, corners, camera.matrix, np.zeros(4), flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    cost = 8 * np.square(
        np.asarray(errors).ravel() / CORNER_SIGMA_PX
    )  # `errors` is the root mean square of the 8 coordinates
    weights = np.exp(-0.5 * (cost - cost.min()))
    found = [
        (se3(so3_exp(turn.ravel().astype(float)), shift.ravel().astype(float)), float(weight))
        for turn, shift, weight in zip(turns, shifts, weights / weights.sum(), strict=True)
    ]
    return sorted(found, key=lambda each: -each[1])
