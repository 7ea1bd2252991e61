"""Priors by visual markers: where the robot is by the pose of a listed one in its image, until the map has confirmed its place. Pure."""

from collections import Counter
from pathlib import Path

import numpy as np

from fleetmap.config import Section
from fleetmap.geometry import Array, se3_inverse
from fleetmap.messages import Status
from fleetmap.plugins.markers import CORNER_SIGMA_PX, MarkerList, corners_of, detector_of, poses_of, read_markers
from fleetmap.sensors.rectification import MountedCamera, RectifiedFrame
from fleetmap.sensors.samples import PositionPrior
from locclient.hooks import PriorHook
from locclient.localization.estimate import Estimate
from locclient.localization.place import Place, boxminus

_CHECK_NS = 500_000_000  # between two looks for markers while the robot knows its place
_GATE = 22.458  # squared Mahalanobis distance: 0.999 of chi-square, 6 degrees of freedom
_TURN_SIGMA_RAD = 0.02  # of a listed marker
_MOVED_LOOKS = 5  # in a row, at another place than listed


class MarkersSection(Section, frozen=True):
    """List of the site's markers."""

    file: str | None = None


class MarkerPriors:
    """Finds listed markers in the images of the first camera.

    A marker tells the robot's place once until the robot is TRACKING, and not again while it contradicts that: fixes must not be outvoted
    by repetition.
    """

    def __init__(self, listed: MarkerList, mounted: MountedCamera, base_from_body: Array) -> None:
        self._markers, self._detector = listed.by_id, detector_of(listed.dictionary)
        self._camera, self._cam_from_base = mounted.camera, se3_inverse(base_from_body @ mounted.body_from_cam)
        self._base_from_body = base_from_body
        self._is_known, self._looked_ns = False, -_CHECK_NS
        self._seen: dict[int, Place] = {}  # of the base, by each marker in the last frame
        self._told = set[int]()
        self._contradictions = Counter[int]()

    def priors(self, frame: RectifiedFrame) -> list[PositionPrior]:
        """Return the place of the base by the nearest marker, if the robot does not know it."""
        self._seen = {}
        if self._is_known and frame.stamp_ns - self._looked_ns < _CHECK_NS:
            return []
        self._looked_ns = frame.stamp_ns
        corners = {n: quad for n, quad in corners_of(frame.left, self._detector).items() if n in self._markers}
        self._seen = {number: self._place_of_base(number, quad) for number, quad in corners.items()}
        new = [number for number in self._seen if number not in self._told and not self._is_moved(number)]
        if self._is_known or not new:
            return []
        best = min(new, key=lambda number: float(np.trace(self._seen[number].cov_rot_trans[3:, 3:])))
        self._told.add(best)
        return [PositionPrior(frame.stamp_ns, *self._seen[best][:2], True, "", is_measured=True)]

    def judge(self, estimate: Estimate) -> str:
        """Compare the frame's markers with its estimate; return a text that names those that stand elsewhere than listed."""
        self._is_known = estimate.map_from_body is not None and estimate.status in {Status.TRACKING, Status.DEGRADED}
        if estimate.status is Status.TRACKING and estimate.is_at_home:
            assert estimate.map_from_body is not None and estimate.cov_rot_trans is not None
            claimed = Place(estimate.map_from_body, estimate.cov_rot_trans).of_point(se3_inverse(self._base_from_body))
            for number, place in self._seen.items():
                is_elsewhere = claimed.innovation_of(place)[1] > _GATE
                self._contradictions[number] = self._contradictions[number] + 1 if is_elsewhere else 0
            self._told = {number for number in self._told if self._contradictions[number]}
        moved = [str(number) for number in sorted(self._markers) if self._is_moved(number)]
        return f"markers that stand elsewhere than listed: {', '.join(moved)}; measure them again" if moved else ""

    def _is_moved(self, number: int) -> bool:
        return self._contradictions[number] >= _MOVED_LOOKS

    def _place_of_base(self, number: int, corners: Array) -> Place:
        """Return the base by a marker's corners (4, 2); its covariance holds their noise, the list's, and the marker's other pose."""
        marker = self._markers[number]
        sides = poses_of(corners, marker.size_m, self._camera)
        map_from_marker = marker.map_from_marker.target_from_source

        def base(cam_from_marker: Array) -> Array:
            return np.asarray(map_from_marker @ se3_inverse(cam_from_marker) @ self._cam_from_base)

        best = base(sides[0][0])
        listed = np.diag([_TURN_SIGMA_RAD**2] * 3 + [marker.sigma_m**2] * 3)
        covariance = Place(map_from_marker, listed).of_point(se3_inverse(map_from_marker) @ best).cov_rot_trans
        for moved in CORNER_SIGMA_PX * np.eye(8).reshape(8, 4, 2):
            others = [
                boxminus(base(cam_from_marker), best)
                for cam_from_marker, _ in poses_of(corners + moved, marker.size_m, self._camera)
            ]
            off = min(others, key=lambda each: float(np.linalg.norm(each)))
            covariance = covariance + np.outer(off, off)
        for cam_from_marker, weight in sides[1:]:
            off = boxminus(base(cam_from_marker), best)
            covariance = covariance + weight * np.outer(off, off)
        return Place(best, covariance)


def _open(section: MarkersSection, mounted: MountedCamera, base_from_body: Array) -> MarkerPriors | None:
    return None if section.file is None else MarkerPriors(read_markers(Path(section.file)), mounted, base_from_body)


PRIORS = PriorHook(MarkersSection, _open)
